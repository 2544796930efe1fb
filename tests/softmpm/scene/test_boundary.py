"""Outlines of boxes, ellipsoids, polygons and triangles: areas and volumes against formulas."""

import math

import numpy as np
import pytest

from softmpm import Outline, ball, box
from softmpm.scene.boundary import equal_arcs, polygon_outline, split_triangles, triangle_outline


def assert_closed(outline: Outline):
    """Unit normals, and Σ n A = 0."""
    assert np.linalg.norm(outline.normals, axis=1) == pytest.approx(1.0, abs=1e-14)
    assert np.linalg.norm(outline.areas @ outline.normals) < 1e-14 * outline.areas.sum()


@pytest.mark.parametrize("lower, upper", [((0.3, 0.1), (0.5, 0.3)), ((0.0, 0.0, -1.0), (0.33, 0.1, 0.27))])
@pytest.mark.parametrize("spacing", [0.1, 1 / 30, 0.0123])
def test_box_is_exact(lower, upper, spacing):
    """Area and volume of a box are exact, its points lie on its sides, and each normal is that of its side."""
    outline, sides = box(lower, upper, spacing).outline, np.subtract(upper, lower)
    assert outline is not None
    assert_closed(outline)
    assert outline.areas.sum() == pytest.approx(2 * (sides.prod() / sides).sum(), rel=1e-12)
    assert outline.enclosed_volume == pytest.approx(sides.prod(), rel=1e-12)
    for x, n in zip(outline.points, outline.normals, strict=True):
        axis = np.abs(n).argmax()
        assert n[axis] == pytest.approx(1 if x[axis] == upper[axis] else -1)
        assert x[axis] == pytest.approx((upper if n[axis] > 0 else lower)[axis], abs=1e-15)


def test_box_has_one_point_for_each_particle_of_a_side():
    """The points are the outer faces of the outermost particles' cells: 2 (3 + 2) in 2D, 2 (6 + 3 + 2) in 3D."""
    assert len(box((0, 0), (3, 2), 1.0).outline) == 10
    outline = box((0, 0, 0), (3, 2, 1), 1.0).outline
    assert len(outline) == 22 and (outline.areas == 1.0).all()
    assert (2.5, 1.5, 1.0) in {tuple(x) for x in outline.points}


def test_circle():
    """Perimeter 2πr, area πr², points on the circle in equal arcs of about one spacing, radial normals; all exact."""
    for spacing in (0.05, 0.0123):
        outline = ball((0.5, 0.2), 0.2, spacing).outline
        assert_closed(outline)
        radial = (outline.points - (0.5, 0.2)) / 0.2
        np.testing.assert_allclose(outline.normals, radial, atol=1e-14)
        np.testing.assert_allclose(outline.areas, 0.4 * math.pi / len(outline), rtol=1e-11)
        assert outline.areas[0] == pytest.approx(spacing, rel=0.1)
        assert outline.enclosed_volume == pytest.approx(0.04 * math.pi, rel=1e-13)


def test_ellipse_converges():
    """The perimeter is exact; equal arcs make the area converge faster than any power of the spacing."""
    perimeter, errors = 1.3364893220555, []  # 4 a E(1 − b²/a²) for a = 0.3, b = 0.1
    for spacing in (0.04, 0.02, 0.01):
        outline = ball((0.0, 0.0), (0.3, 0.1), spacing).outline
        assert_closed(outline)
        assert outline.areas.sum() == pytest.approx(perimeter, rel=1e-12)
        assert np.ptp(outline.areas) < 1e-11 * outline.areas[0]
        assert ((outline.points / (0.3, 0.1)) ** 2).sum(axis=1) == pytest.approx(1.0, abs=1e-13)
        errors.append(abs(outline.enclosed_volume / (0.03 * math.pi) - 1))
    assert errors[0] < 2e-3 and errors[1] < errors[0] / 100 and errors[2] < errors[1] / 100


@pytest.mark.parametrize("radii", [(0.2, 0.2, 0.2), (0.3, 0.1, 0.2), (0.1, 0.1, 0.3)])
def test_ellipsoid(radii):
    """The volume is exact at every spacing; the area is that of the ellipsoid, exact for a sphere, else to spacing²."""
    from scipy.special import elliprg

    products = [(radii[i] * radii[j]) ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
    area, errors = 4 * math.pi * elliprg(*products), []
    for spacing in (0.04, 0.02, 0.01):
        outline = ball((0.5, 0.5, 0.5), radii, spacing).outline
        assert_closed(outline)
        assert outline.enclosed_volume == pytest.approx(4 / 3 * math.pi * np.prod(radii), rel=1e-13)
        errors.append(abs(outline.areas.sum() / area - 1))
        assert len(outline) == pytest.approx(area / spacing**2, rel=0.15)
        inner = (outline.points - 0.5) / radii
        assert np.linalg.norm(inner, axis=1) == pytest.approx(1.0, abs=1e-13)
        slope = inner / radii
        np.testing.assert_allclose(
            outline.normals, slope / np.linalg.norm(slope, axis=1, keepdims=True), atol=1e-13
        )
    assert max(errors) < 1e-13 if radii == (0.2, 0.2, 0.2) else errors[0] < 0.01 and errors[2] < errors[0] / 8


def test_equal_arcs_of_a_long_ellipse():
    """Arcs of an ellipse of 1 : 100 are equal too: each is as long as many short chords."""
    edges, middle = equal_arcs(1.0, 0.01, 0.1)
    assert len(middle) % 4 == 0 and (np.diff(np.sort(np.concatenate([edges, middle]))) > 0).all()
    t = np.linspace(edges[:-1], edges[1:], 10_001)
    arcs = np.hypot(np.diff(np.cos(t), axis=0), 0.01 * np.diff(np.sin(t), axis=0)).sum(axis=0)
    np.testing.assert_allclose(arcs, arcs.mean(), rtol=1e-5)


def test_polygon():
    """A square with a square hole, walked with the inside to the left: normals leave the body on both; an islet is left out."""
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    hole = (0.3 + 0.4 * square)[::-1]
    outline = polygon_outline([square, hole, 0.01 * square], 0.1)
    assert outline is not None and len(outline) == 40 + 16
    assert_closed(outline)
    assert outline.areas.sum() == pytest.approx(5.6, rel=1e-12)
    assert outline.enclosed_volume == pytest.approx(1 - 0.16, rel=1e-12)
    assert polygon_outline([0.01 * square], 0.1) is None and polygon_outline([], 0.1) is None


@pytest.mark.parametrize("first", range(0, 40, 7))
def test_a_polygon_without_corners_keeps_its_mirror_symmetry(first):
    """Whichever vertex comes first: a bean, symmetric about x = 0.3, gets an outline symmetric about it, with normals and areas."""
    t = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
    radius = 1.0 + 0.4 * np.sin(t) + 0.1 * np.cos(4 * t)
    bean = np.stack([0.3 + radius * np.cos(t), 1.3 * radius * np.sin(t)], axis=1)
    outline = polygon_outline([np.roll(bean, first, axis=0)], 0.13)
    assert outline is not None
    mirrored = outline.points * (-1, 1) + (0.6, 0)
    apart = np.linalg.norm(outline.points[:, None] - mirrored, axis=2)
    other = apart.argmin(axis=1)
    assert apart.min(axis=1).max() < 1e-12
    np.testing.assert_allclose(outline.normals[other] * (-1, 1), outline.normals, atol=1e-12)
    np.testing.assert_allclose(outline.areas[other], outline.areas, rtol=1e-12)


@pytest.mark.parametrize("off", [0.0, 1e-17, -1e-17])
def test_an_edge_along_the_middle_keeps_the_mirror_symmetry(off):
    """Two steps, mirror images of each other, whose riser lies halfway between their ends, up to rounding."""
    step = np.array([(-1.0, 0.0), (1.0, 0.0), (1.0, 1.0), (off, 1.0), (-off, 2.0), (-1.0, 2.0)])
    outline = polygon_outline([step - (2.0, 0.0), (step * (-1, 1) + (2.0, 0.0))[::-1]], 0.13)
    assert outline is not None
    left, right = np.split(outline.points, 2)
    apart = np.linalg.norm(left[:, None] - right * (-1, 1), axis=2)
    assert apart.min(axis=1).max() < 1e-12


def test_polygon_converges():
    """Perimeter and area of a fine polygon around a circle tend to its own with spacing²."""
    t = np.linspace(0, 2 * np.pi, 10_000, endpoint=False)
    circle, errors = np.stack([np.cos(t), np.sin(t)], axis=1), []
    for spacing in (0.2, 0.1, 0.05):
        outline = polygon_outline([circle], spacing)
        assert outline is not None
        errors.append((1 - outline.areas.sum() / (2 * np.pi), 1 - outline.enclosed_volume / np.pi))
    assert (np.array(errors) > 0).all()
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 4.0, rtol=0.1)


def test_split_triangles():
    """Parts are small, cover the triangle's area exactly, and keep its normal; one that is small enough stays as it is."""
    needle = np.array([[(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, 0.1)]])
    large = np.array([[(0.0, 0.0, 0.0), (1.0, 0.0, 0.5), (0.2, 1.0, 0.0)]])
    for triangle in (needle, large):
        whole = triangle_outline(triangle)
        parts = triangle_outline(split_triangles(triangle, 0.1))
        assert parts.areas.sum() == pytest.approx(whole.areas.sum(), rel=1e-12)
        assert parts.areas.max() <= 0.01 * (1 + 1e-9)
        np.testing.assert_allclose(parts.normals, np.repeat(whole.normals, len(parts), axis=0), atol=1e-12)
        np.testing.assert_allclose(
            parts.areas @ parts.points / parts.areas.sum(), whole.points[0], atol=1e-12
        )
    np.testing.assert_array_equal(split_triangles(large, 2.0), large)
