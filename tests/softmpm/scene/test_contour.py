"""Marching squares against fields whose contours are known."""

import numpy as np
import pytest

from softmpm.scene.contour import contours


def area(polygon: np.ndarray) -> float:
    """Positive if the inside is to the left."""
    x, y = polygon.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


def test_circle():
    """A cone's contour is a circle around its inside, whose area converges with the square of the nodes."""
    errors = []
    for nodes in (40, 80, 160):
        axis = np.linspace(-1, 1, nodes)
        (polygon,) = contours(1 - np.hypot(axis[:, None], axis), 0.4)
        places = polygon * 2 / (nodes - 1) - 1
        assert np.hypot(*places.T) == pytest.approx(0.6, abs=0.5 / nodes)
        errors.append(abs(area(places) / (0.36 * np.pi) - 1))
    assert errors[0] < 2e-3 and errors[2] < errors[0] / 10


def test_closed_at_the_border():
    """A field that is inside everywhere is closed half a node beyond its border, as zeros around it would."""
    (polygon,) = contours(np.ones((3, 2)), 0.5)
    assert polygon.min(axis=0).tolist() == [-0.5, -0.5] and polygon.max(axis=0).tolist() == [2.5, 1.5]
    assert area(polygon) == 3 * 2 - 4 / 8


def test_hole_and_parts():
    """Two islands and a lake: three polygons, the lake's turned the other way."""
    field = np.zeros((12, 6))
    field[1:4, 1:4] = 1.0
    field[6:11, 1:6] = 1.0
    field[8, 3] = 0.0
    areas = sorted(area(polygon) for polygon in contours(field, 0.5))
    assert areas == [-0.5, 8.5, 24.5]


@pytest.mark.parametrize("between, parts", [(0.0, 2), (0.4, 1)])
def test_saddle(between, parts):
    """Two corners are joined where the mean of the four reaches the level, in both diagonals; else they are apart."""
    for field in (np.array([[1, between], [between, 1]]), np.array([[between, 1], [1, between]])):
        assert len(contours(field, 0.6)) == parts


def test_noise():
    """Every contour of a random field is closed, with steps of at most a cell's diagonal, and each crossing is used once."""
    field = np.random.default_rng(0).random((30, 40))
    polygons = contours(field, 0.5)
    for polygon in polygons:
        assert np.abs(np.roll(polygon, -1, axis=0) - polygon).max() <= 1.0
    padded = np.pad(field >= 0.5, 1)
    crossed = (padded[1:] != padded[:-1]).sum() + (padded[:, 1:] != padded[:, :-1]).sum()
    assert sum(map(len, polygons)) == crossed


def test_nothing_inside():
    """A field below the level has no contour."""
    assert contours(np.zeros((4, 4)), 0.5) == []
