"""Box and ball: where the particles are, how many, and what they weigh."""

import math

import numpy as np
import pytest

from softmpm.scene import shapes
from softmpm.scene.shapes import ball, box, polygons


@pytest.mark.parametrize("lower, upper", [((0.3, 0.1), (0.5, 0.3)), ((0.0, 0.0, -1.0), (0.33, 0.1, 0.27))])
def test_box_mass_is_exact(lower, upper):
    """Whatever the spacing, the particles' volumes add up to the box's own, and they share its centre."""
    volume, center = np.prod(np.subtract(upper, lower)), np.add(upper, lower) / 2
    for spacing in (0.1, 0.05, 1 / 30, 0.0123):
        particles = box(lower, upper, spacing)
        assert particles.volume.sum() == pytest.approx(volume, rel=1e-12)
        assert particles.positions.mean(axis=0) == pytest.approx(center, abs=1e-13)
        assert ((particles.positions > lower) & (particles.positions < upper)).all()


def test_box_lattice():
    """Particles start half a spacing off the lower corner; the last axis runs fastest; no call differs."""
    particles = box((1.0, 2.0), (1.75, 2.5), 0.25)
    want = [(1.125 + 0.25 * i, 2.125 + 0.25 * j) for i in range(3) for j in range(2)]
    np.testing.assert_allclose(particles.positions, want, atol=1e-15)
    assert (particles.volume == 0.0625).all()
    np.testing.assert_array_equal(particles.positions, box((1.0, 2.0), (1.75, 2.5), 0.25).positions)


def test_box_fits_its_spacing():
    """Sides of 2.6 and 1.2 spacings get three and one particles, each at the middle of its share."""
    particles = box((0.0, 0.0), (2.6, 1.2), 1.0)
    np.testing.assert_allclose(
        particles.positions, [(2.6 / 6, 0.6), (1.3, 0.6), (2.6 * 5 / 6, 0.6)], atol=1e-15
    )


@pytest.mark.parametrize("dim, unit", [(2, math.pi), (3, 4 / 3 * math.pi)])
@pytest.mark.parametrize("stretch", [(1.0, 1.0, 1.0), (1.0, 0.5, 0.7)])
def test_ball_volume_converges(dim, unit, stretch):
    """The lattice's volume tends to that of the ball or ellipsoid, and is count · spacingᵈ."""
    radius = 0.4 * np.array(stretch[:dim])
    for spacing, tolerance in ((0.05, 0.06), (0.0125, 0.01)):
        particles = ball((0.5,) * dim, radius, spacing)
        assert (particles.volume == spacing**dim).all()
        assert particles.volume.sum() == pytest.approx(unit * radius.prod(), rel=tolerance)


def test_ball_is_every_cell_whose_middle_is_inside():
    """The disc has exactly the lattice points of a wider box that lie within the radius, and no other."""
    particles = ball((0.2, -0.1), 0.33, 0.05)
    around = box((-0.3, -0.6), (0.7, 0.4), 0.05).positions  # the same lattice: half a spacing off the centre
    want = around[np.hypot(*(around - (0.2, -0.1)).T) <= 0.33]
    np.testing.assert_allclose(particles.positions, want, atol=1e-14)


def test_ball_mirrors_itself():
    """Mirroring an ellipsoid about its centre gives the same particles, so its centre of mass is exact."""
    offset = ball((0.0, 0.0, 0.0), (0.4, 0.3, 0.2), 0.1).positions
    assert {tuple(p) for p in offset} == {tuple(p) for p in -offset}


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: box((0, 0), (1, 1, 1), 0.1), "same number of axes"),
        (lambda: box((0, 0), (1, 0), 0.1), "upper must be above lower"),
        (lambda: box((0,), (1,), 0.1), "lower must be 2 or 3 finite numbers"),
        (lambda: box((0, np.nan), (1, 1), 0.1), "lower must be 2 or 3 finite numbers"),
        (lambda: box((0, 0), (1, 1), 0.0), "spacing must be > 0 m, got 0"),
        (lambda: box((0, 0), (1, 1), np.nan), "spacing must be > 0 m, got nan"),
        (lambda: box((0, 0), (1, 0.04), 0.1), "thinner than half its spacing"),
        (lambda: box((0, 0, 0), (100, 100, 100), 0.01), r"1e\+12 lattice cells.*metres"),
        (lambda: ball((0, 0), -0.1, 0.1), "radius must be one number > 0 m"),
        (lambda: ball((0, 0), (0.1, 0.1, 0.1), 0.1), "radius must be one number > 0 m, or 2 of them"),
        (lambda: ball((0, 0), 0.06, 0.1), "lies between its particles"),
        (lambda: ball((0, 0, 0), 1e6, 0.1), "lattice cells"),
    ],
)
def test_refuses(make, message):
    """A shape that cannot be meant, or holds no particle, is refused before any memory is taken."""
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("make", [lambda: box((0, 0), (1e30, 1e30), 0.1), lambda: ball((0, 0), 1e30, 0.1)])
def test_sizes_beyond_integers(make):
    """1e31 cells along an axis overflowed, and the box was called too thin."""
    with pytest.raises(ValueError, match="the shape spans 1e.31 lattice cells along an axis, at most 2e.08"):
        make()


@pytest.mark.parametrize(
    "make, name",
    [
        (lambda: ball((0.0, 0.0), "1", 0.1), "radius"),
        (lambda: ball((0.0, 0.0), True, 0.1), "radius"),
        (lambda: box(("0", "0"), (1.0, 1.0), 0.1), "lower"),
        (lambda: polygons([[("0", "0"), ("1", "0"), ("0", "1")]], 0.1), "polygon 0"),
        (lambda: box((0.0, 0.0), (1.0, 1.0), 0.1).moved((True, False)), "by"),
    ],
)
def test_texts_and_truths_are_no_numbers(make, name):
    """NumPy would read "1" and True as 1.0."""
    with pytest.raises(TypeError, match=f"{name} must be real numbers"):
        make()


def test_half_cells_do_not_depend_on_rounding():
    """A side of 2.5 spacings counts three particles, however the quotient is rounded."""
    for scale in (0.1, 0.3, 0.7, 1e-3):
        assert len(box((0.0, 0.0), (2.5 * scale, scale), scale)) == 3
    assert shapes.CELL_LIMIT >= 1e8  # room for the largest scenes that are simulated
