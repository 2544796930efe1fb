"""The perspective camera against its definition, and shading against exact normals."""

import numpy as np
import pytest

import softmpm
from softmpm.pictures.camera import AMBIENT, Camera, round_length, tiles
from softmpm.recording.surroundings import of_scene

LOW, HIGH, UP = np.zeros(3), np.array([1.0, 0.6, 0.4]), np.array([0.0, 1.0, 0.0])


def test_projection_is_central():
    """Points on a ray from the pinhole coincide, lines stay straight, and the centre of the box is in the middle, at scale 1."""
    camera, rng = Camera(LOW, HIGH, UP), np.random.default_rng(0)
    points = rng.uniform(LOW, HIGH, (20, 3))
    places, scale = camera.project(points)
    nearer, larger = camera.project(camera.position + 0.5 * (points - camera.position))
    assert np.allclose(places, nearer) and np.allclose(2 * scale, larger)
    centre, one = camera.project((LOW + HIGH)[None] / 2)
    assert np.allclose(centre, 0, atol=1e-12) and np.allclose(one, 1)
    line, _ = camera.project(points[0] + np.linspace(0, 1, 5)[:, None] * (points[1] - points[0]))
    steps = np.diff(line, axis=0)
    assert np.allclose(steps[1:, 0] * steps[:-1, 1], steps[1:, 1] * steps[:-1, 0])


def test_projection_does_not_mirror():
    """Up is up, and a screw along the three axes that is right-handed in space is so in the picture, seen from outside."""
    camera = Camera(LOW, HIGH, UP)
    origin, x, y, z = camera.project(np.concatenate([np.zeros((1, 3)), 1e-3 * np.eye(3)]))[0]
    assert (y - origin)[1] > 0 and (x - origin)[0] > 0
    a, b, c = x - origin, y - origin, z - origin
    turn = [p[0] * q[1] - p[1] * q[0] for p, q in ((a, b), (b, c), (c, a))]
    assert min(turn) > 0  # the camera looks from where all three are positive


def test_magnification_is_that_of_small_lengths():
    """A short step across the view has its length times the magnification in the picture."""
    camera = Camera(LOW, HIGH, UP)
    point = np.array([0.9, 0.1, 0.3])
    view = (LOW + HIGH) / 2 - camera.position
    across = np.cross(view, UP) / np.linalg.norm(np.cross(view, UP))
    places, scale = camera.project(np.stack([point, point + 1e-6 * across]))
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(1e-6 * scale[0], rel=1e-4)


def test_the_frame_contains_the_box():
    """All of it, and no more than its corners need."""
    camera = Camera(LOW, HIGH, UP)
    low, high = camera.frame(LOW, HIGH)
    places, _ = camera.project(np.random.default_rng(0).uniform(LOW, HIGH, (5000, 3)))
    assert (places > low).all() and (places < high).all()
    assert (places.max(0) - places.min(0) > 0.8 * (high - low)).all()


def test_shading_follows_the_normals_of_a_ball():
    """At its surface the brightness is Lambert's with the exact normal and some one light, to a twentieth; a lattice has steps."""
    shape = softmpm.ball((0.5, 0.5, 0.5), 0.3, 1 / 40)
    body = softmpm.Body(shape, softmpm.NeoHookean(density=1.0, young=1.0))
    place = of_scene(softmpm.Scene(grid=softmpm.Grid(shape=(21,) * 3, spacing=0.05), bodies=[body], dt=1e-3))
    away = shape.positions - 0.5
    radius = np.linalg.norm(away, axis=1)
    surface = radius > 0.285
    shade = (Camera(LOW, HIGH, UP).shading(place, shape.positions) - AMBIENT) / (1 - AMBIENT)
    normal = away / np.maximum(radius, 1e-9)[:, None]
    lit = surface & (shade > 0.1)
    light = np.linalg.lstsq(normal[lit], shade[lit], rcond=None)[0]
    assert np.linalg.norm(light) == pytest.approx(1.0, abs=0.03) and light[1] > 0.3
    off = np.abs(shade[surface] - np.clip(normal[surface] @ light, 0, 1))
    assert off.mean() < 0.05 and off.max() < 0.3


def test_faces_of_a_box_are_evenly_bright():
    """Away from its edges, a face of a lattice has one brightness."""
    shape = softmpm.box((0.2, 0.2, 0.2), (0.8, 0.6, 0.6), 1 / 30)
    body = softmpm.Body(shape, softmpm.NeoHookean(density=1.0, young=1.0))
    place = of_scene(softmpm.Scene(grid=softmpm.Grid(shape=(21,) * 3, spacing=0.05), bodies=[body], dt=1e-3))
    shade = Camera(LOW, HIGH, UP).shading(place, shape.positions)
    x = shape.positions
    top = (x[:, 1] > 0.58) & (abs(x[:, 0] - 0.5) < 0.2) & (abs(x[:, 2] - 0.4) < 0.1)
    assert top.sum() > 30 and np.ptp(shade[top]) < 1e-9


def test_tiles_lie_on_the_wall():
    """Lines at multiples of the length, in the plane and up to the edges."""
    outline = np.array([(0.05, 0.2, 0.0), (1.05, 0.2, 0.0), (1.05, 0.2, 0.5), (0.05, 0.2, 0.5)])
    lines = tiles(outline, 0.1)
    assert np.allclose(lines[..., 1], 0.2)
    along = lines[np.isclose(lines[:, 0, 0], lines[:, 1, 0])]
    assert np.allclose(np.sort(along[:, 0, 0]), np.arange(1, 11) / 10)
    assert np.allclose(np.abs(np.diff(along[..., 2], axis=1)), 0.5)


@pytest.mark.parametrize(
    "extent, length", [(1.0, 0.2), (0.99, 0.1), (0.26, 0.05), (25.0, 5.0), (0.03, 0.005)]
)
def test_round_lengths(extent, length):
    """1, 2 or 5 times a power of ten, at most a fifth of the extent."""
    assert round_length(extent) == pytest.approx(length)
