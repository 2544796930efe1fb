"""Colours, walls, arrows and the camera, without Rerun."""

import numpy as np
import pytest

from softmpm.recording import style

STATIC = {"muscle": np.array([[1, 1, 0, 0], [0, 1, 1, 0]], np.uint8), "body": np.array([0, 0, 0, 1])}


def unpack(colours: np.ndarray) -> np.ndarray:
    return np.stack([(colours >> shift) & 255 for shift in (24, 16, 8)], -1).astype(int)


def test_muscles_are_red_when_they_pull_and_blue_when_they_push():
    """One muscle tints its particles, two that overlap add, opposite ones cancel, a passive particle stays grey."""
    rest, contract, extend, both, against, none = unpack(
        style.activation_colours(
            STATIC, np.array([(0, 0), (1, 0), (-1, 0), (0.5, 0.5), (1, -1), (np.nan, np.nan)])
        )
    )
    red, blue = (colour.astype(int).tolist() for colour in (style.CONTRACT, style.EXTEND))
    assert contract[0].tolist() == red and extend[0].tolist() == blue
    assert both[1].tolist() == red and not np.array_equal(both[0], red)
    assert both[0, 0] - both[0, 2] == both[2, 0] - both[2, 2] > 50
    assert np.array_equal(against[1], rest[1])
    assert np.array_equal(none, rest) and np.ptp(rest[0]) < 20
    assert (rest[0] < rest[3]).all() and all(np.array_equal(c[3], rest[3]) for c in (contract, extend, both))


def test_strain_is_shown_from_dark_to_bright():
    """The scale is monotonous in brightness, saturates at its top, and marks what is not finite as the top."""
    ramp = unpack(style.strain_colours(np.array([[0.0, 0.1, 0.2, 0.3, 0.4, 9.0, np.nan]]), 0.4))[0]
    assert (np.diff(ramp[:5] @ (0.2126, 0.7152, 0.0722)) > 0).all()
    assert np.array_equal(ramp[4], ramp[5]) and np.array_equal(ramp[4], ramp[6])


def test_walls_end_where_the_grid_or_another_wall_does():
    """In 2D a floor and a side wall meet in their corner; a wall outside the grid or behind another is not drawn."""
    normals = np.array([(0, 1), (1, 0), (0, 1), (-0.6, 0.8)], float)
    offsets = np.array([0.1, 0.2, -0.5, -5.0])
    floor, side, below, outside = style.wall_outlines(normals, offsets, np.array([2.0, 1.0]))
    assert np.allclose(sorted(map(tuple, floor)), [(0.2, 0.1), (2.0, 0.1)], atol=1e-5)
    assert np.allclose(sorted(map(tuple, side)), [(0.2, 0.1), (0.2, 1.0)], atol=1e-5)
    assert len(below) == len(outside) == 0


def test_walls_in_3d_are_polygons_in_order():
    """The corners lie on the surface and in the grid, and go around: the fan of triangles has the polygon's area."""
    normal = np.ones(3) / np.sqrt(3)
    (outline,) = style.wall_outlines(normal[None], np.array([np.sqrt(3) / 2]), np.ones(3))
    assert np.allclose(outline @ normal, np.sqrt(3) / 2) and len(outline) == 6
    fan = np.cross(outline[1:-1] - outline[0], outline[2:] - outline[0]) / 2
    assert np.linalg.norm(fan, axis=1).sum() == pytest.approx(3 * np.sqrt(3) / 4, rel=1e-4)  # of the hexagon
    assert np.linalg.norm(fan.sum(0)) == pytest.approx(3 * np.sqrt(3) / 4, rel=1e-4)


def test_hatching_is_on_the_solid_side():
    """Every stroke starts on the wall and ends inside it."""
    normal = np.array([0.6, 0.8])
    (outline,) = style.wall_outlines(normal[None], np.array([0.5]), np.ones(2))
    strokes = style.hatch(outline, normal, 0.1)
    assert len(strokes) >= 5
    assert np.allclose(strokes[:, 0] @ normal, 0.5) and np.allclose(strokes[:, 1] @ normal, 0.4)


def test_arrows_stand_on_moving_nodes_and_keep_to_scale():
    """Length is proportional to speed up to the top, which is three cells; empty nodes have none; at most some thousand."""
    velocity = np.zeros((5, 4, 2))
    velocity[1, 2], velocity[3, 0], velocity[4, 3] = (0, 2), (-1, 0), (40, 0)
    origins, vectors, colours = style.arrows(velocity, 0.1, 2.0)
    assert np.allclose(origins, [(0.1, 0.2), (0.3, 0), (0.4, 0.3)])
    assert np.allclose(vectors, [(0, 0.3), (-0.15, 0), (0.3, 0)])
    assert colours[0] == colours[2] != colours[1]
    assert all(len(part) == 0 for part in style.arrows(np.zeros((3, 3, 3, 3)), 0.1, 1.0))
    many = style.arrows(np.ones((99, 99, 2)), 0.1, 1.0)[0]
    assert style.MOST_ARROWS / 2 < len(many) <= style.MOST_ARROWS


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0)])
def test_the_camera_stands_in_front_and_above(up):
    """The camera faces the middle from above, with the long horizontal axis x to the right."""
    up, low = np.array(up, float), np.zeros(3)
    high = np.array([3.0, 1.0, 1.0])
    position, target = style.eye(low, high, up)
    assert np.allclose(target, (1.5, 0.5, 0.5)) and (position - target) @ up > 0.5
    right = np.cross(target - position, up)
    assert right[0] / np.linalg.norm(right) > 0.8


@pytest.mark.parametrize(
    ("gravity", "up"), [((0, 0, -9.81), (0, 0, 1)), ((0, 0, 0), (0, 1, 0)), ((3, -4, 0), (-0.6, 0.8, 0))]
)
def test_up_is_against_gravity(gravity, up):
    """Whatever its axis; without any, up is y."""
    assert style.upward(np.array(gravity, float)) == pytest.approx(up)


def test_dots_grow_when_fewer_are_shown():
    """A quarter of the dots in 2D, an eighth in 3D, need twice the radius."""
    for dim in (2, 3):
        full, part = (style.radii(np.ones(1), shown, dim) for shown in (1.0, 0.5**dim))
        assert part == pytest.approx(2 * full)


def test_arrows_of_tractions():
    """The walls' tractions add up; those below a hundredth of the scale are left out, those above it are cut."""
    traction = np.array([[(0.0, 1.0), (0.001, 0.0), (3.0, 0.0)], [(0.0, 1.0), (0.0, 0.0), (0.0, 4.0)]])
    origins, vectors = style.traction_arrows(np.arange(6.0).reshape(3, 2), traction, 0.1, 4.0)
    np.testing.assert_allclose(origins, [(0, 1), (4, 5)])
    np.testing.assert_allclose(vectors, [(0, 0.15), (0.18, 0.24)])
