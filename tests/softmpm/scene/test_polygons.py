"""Unions of polygons: their boundary, the particles in them and the outline around them."""

import math

import numpy as np
import pytest

import softmpm
from softmpm.scene.polygons import boundary_distance, nearest_on, ray_length, union_boundary

SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def area(boundary: list[np.ndarray]) -> float:
    """Area inside, holes taken off."""
    return sum(float(x @ np.roll(y, -1) - np.roll(x, -1) @ y) / 2 for x, y in (part.T for part in boundary))


def circle(center, radius, corners=400) -> np.ndarray:
    angle = 2 * np.pi * np.arange(corners) / corners
    return np.array(center) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def drops(seed: int, count: int = 6) -> list[np.ndarray]:
    """Random polygons that overlap in every way."""
    rng = np.random.default_rng(seed)
    return [
        rng.uniform(0, 1, 2) + rng.uniform(0.05, 0.3) * rng.normal(size=(rng.integers(3, 9), 2))
        for _ in range(count)
    ]


@pytest.mark.parametrize(
    "parts, parts_left, exact",
    [
        ([SQUARE], 1, 1.0),
        ([SQUARE[::-1]], 1, 1.0),
        ([SQUARE, SQUARE], 1, 1.0),
        ([SQUARE, SQUARE[::-1] * 0.5 + 0.25], 1, 1.0),
        ([SQUARE, SQUARE + (1.0, 0.0)], 1, 2.0),
        ([SQUARE, SQUARE + (1.0, 0.5)], 1, 2.0),
        ([SQUARE, SQUARE + (0.5, 0.0)], 1, 1.5),
        ([SQUARE, SQUARE + (0.5, 0.25)], 1, 1.625),
        ([SQUARE, SQUARE + (2.0, 0.0)], 2, 2.0),
        ([SQUARE * (3, 1), SQUARE * (3, 1) + (0, 2), SQUARE * (1, 3), SQUARE * (1, 3) + (2, 0)], 2, 8.0),
    ],
)
def test_unions_of_squares(parts, parts_left, exact):
    """Equal, nested, touching along a side or a part of it, overlapping and apart; four of them make a frame with a hole."""
    boundary = union_boundary(parts)
    assert len(boundary) == parts_left and area(boundary) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("angle", np.linspace(0.1, 6.0, 20))
def test_collinear_sides_in_any_direction(angle):
    """A frame of four bars and a T, whose sides lie on each other up to rounding."""
    R = np.array([(math.cos(angle), -math.sin(angle)), (math.sin(angle), math.cos(angle))])
    bars = [SQUARE * (3, 1), SQUARE * (3, 1) + (0, 2), SQUARE * (1, 3), SQUARE * (1, 3) + (2, 0)]
    letter = [SQUARE * (3, 1) + (0, 2), SQUARE * (1, 3) + (1, 0)]
    for parts, exact, left in ((bars, 8.0, 2), (letter, 5.0, 1)):
        boundary = union_boundary([part @ R.T + 0.3 for part in parts])
        assert len(boundary) == left and area(boundary) == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize("seed", range(12))
def test_the_area_of_a_union_is_that_of_its_points(seed):
    """Of random polygons that cross each other and themselves: against the share of a million points."""
    parts = drops(seed)
    low, high = np.concatenate(parts).min(axis=0), np.concatenate(parts).max(axis=0)
    points = np.random.default_rng(1).uniform(low, high, size=(200_000, 2))
    share = np.any([softmpm.inside(points, part) for part in parts], axis=0).mean()
    box = float(np.prod(high - low))
    assert area(union_boundary(parts)) == pytest.approx(
        share * box, abs=5 * box * math.sqrt(0.25 / len(points))
    )


def test_the_union_of_two_discs():
    """Two discs: the exact area of their union, and distances from its boundary alone."""
    parts, d = [circle((0.0, 0.0), 1.0), circle((1.0, 0.0), 1.0)], 1.0
    lens = 2 * math.acos(d / 2) - d / 2 * math.sqrt(4 - d**2)
    boundary = union_boundary(parts)
    assert area(boundary) == pytest.approx(2 * math.pi - lens, rel=1e-4)
    distance = boundary_distance(np.array([(0.5, 0.0), (-1.5, 0.0), (2.0, 0.0)]), boundary)
    assert distance == pytest.approx([math.sqrt(0.75), 0.5, 0.0], abs=1e-3)


@pytest.mark.parametrize("cut_cells", [False, True])
def test_particles_and_outline_agree(cut_cells):
    """The outline closes; its volume is that of the union to spacing², as is that of cut cells; particles lie inside of it."""
    parts = [circle((0.5, 0.5), 0.3), np.array([(0.4, 0.0), (0.6, 0.0), (0.6, 0.6), (0.4, 0.6)])]
    exact, errors = area(union_boundary(parts)), []
    for spacing in (1 / 40, 1 / 80):
        shape = softmpm.polygons(parts, spacing, cut_cells=cut_cells)
        outline = shape.outline
        assert outline is not None
        assert np.linalg.norm(outline.areas @ outline.normals) < 1e-13
        assert outline.enclosed_volume == pytest.approx(exact, rel=1.5 * spacing**2)
        errors.append(abs(shape.volume.sum() / exact - 1))
        assert 0.9 < np.median(outline.areas) / spacing < 1.1
        assert np.any([softmpm.inside(shape.positions, part) for part in parts], axis=0).all()
    assert max(errors) < (2e-4 if cut_cells else 1e-2)
    if cut_cells:
        assert shape.volume.min() > 0.35 * spacing**2
    else:
        assert (shape.volume == spacing**2).all()


@pytest.mark.parametrize("thickness", [0.1, 0.5])
@pytest.mark.parametrize("angle", [0.0, 0.1, 0.7])
def test_a_thin_strip_has_its_area(thickness, angle):
    """Also where both sides cross the same sample of a cell: areas were 1.2 times as large at a tenth of the spacing."""
    turn = np.array([(math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))])
    strip = np.array([(0, 0), (0.5, 0), (0.5, 0.01 * thickness), (0, 0.01 * thickness)]) + (0, 0.0037)
    shape = softmpm.polygons([strip @ turn + 0.3], 0.01, cut_cells=True)
    assert shape.volume.sum() == pytest.approx(0.005 * thickness, rel=0.01)


def test_nearest_points_and_rays():
    """From within a square and from beyond a side and a corner; a ray along a side or away from all of them meets nothing."""
    boundary = [SQUARE]
    points = np.array([(0.2, 0.5), (0.5, -1.0), (2.0, 3.0)])
    nearest, left = nearest_on(points, boundary)
    np.testing.assert_allclose(nearest, [(0.0, 0.5), (0.5, 0.0), (1.0, 1.0)])
    np.testing.assert_allclose(left[:2], [(1.0, 0.0), (0.0, 1.0)], atol=1e-15)
    directions = np.array([(1.0, 0.0), (0.0, 1.0), (0.0, 1.0)])
    np.testing.assert_allclose(ray_length(points, directions, boundary), [0.8, 1.0, np.inf])


def test_sides_on_the_lattice_are_exact():
    """An L of two boxes has the volume, the perimeter and the corners of an L, with points on its sides only."""
    parts = [np.array([(0.1, 0.0), (0.4, 0.0), (0.4, 0.1), (0.1, 0.1)]), SQUARE * (0.1, 0.3) + (0.1, 0.0)]
    for cut_cells in (False, True):
        shape = softmpm.polygons(parts, 0.02, cut_cells=cut_cells)
        assert shape.outline is not None
        assert shape.volume.sum() == pytest.approx(0.05, rel=1e-12) and len(shape) == 125
        assert shape.outline.enclosed_volume == pytest.approx(0.05, rel=1e-12)
        assert shape.outline.areas.sum() == pytest.approx(1.2, rel=1e-12)
        assert sorted(set(np.abs(shape.outline.normals).round(12).ravel())) == [0.0, 1.0]


def test_moved_takes_the_outline_along():
    """A shape and its outline move by the same vector; a vector of another dimension is refused."""
    shape = softmpm.polygons([SQUARE], 0.25)
    moved = shape.moved((1.0, -2.0))
    assert (moved.positions == shape.positions + (1.0, -2.0)).all() and (moved.volume == shape.volume).all()
    assert shape.outline is not None and moved.outline is not None
    assert (moved.outline.points == shape.outline.points + (1.0, -2.0)).all()
    with pytest.raises(ValueError, match="moves by 2 numbers"):
        shape.moved((1.0, 2.0, 3.0))


def test_inside():
    """Points inside a square and no others."""
    points = np.array([(0.5, 0.5), (1.5, 0.5), (-0.1, 0.2), (0.99, 0.01)])
    assert softmpm.inside(points, SQUARE).tolist() == [True, False, False, True]


@pytest.mark.parametrize(
    "parts, message",
    [
        ([], "at least one polygon"),
        ([SQUARE, SQUARE[:2]], r"polygon 1 has shape \(2, 2\)"),
        ([np.zeros((4, 3))], r"polygon 0 has shape \(4, 3\)"),
        ([SQUARE * np.nan], "three finite vertices"),
        ([SQUARE * 0.0], "lies between its particles"),
        ([SQUARE * (1.0, 0.0)], "lies between its particles"),
        ([SQUARE * 1e-3], "lies between its particles"),
    ],
)
def test_what_is_no_polygon_is_refused(parts, message):
    """Named by its number."""
    with pytest.raises(ValueError, match=message):
        softmpm.polygons(parts, 0.1)
