"""Outlines: what may be one, and what it encloses."""

import copy
import pickle

import numpy as np
import pytest

import softmpm
from softmpm import Outline, Particles

SQUARE = (
    np.array([(0.5, 0.0), (1.0, 0.5), (0.5, 1.0), (0.0, 0.5)]),
    [(0, -1), (1, 0), (0, 1), (-1, 0)],
    [1] * 4,
)


def test_encloses_a_volume():
    """One point for each side of a square is exact, wherever it is; normals that point inwards give a negative volume."""
    points, normals, areas = SQUARE
    outline = Outline(points + 100.0, normals, areas)
    assert len(outline) == 4 and outline.dim == 2 and repr(outline) == "Outline(4 points in 2D)"
    assert outline.enclosed_volume == pytest.approx(1.0, rel=1e-14)
    assert Outline(points, -np.array(normals), areas).enclosed_volume == pytest.approx(-1.0, rel=1e-14)


def test_float32_normals_become_exact():
    """Normals rounded to float32 are accepted, and are unit vectors in float64 afterwards."""
    normals = np.stack([np.cos(np.arange(50.0)), np.sin(np.arange(50.0))], axis=1).astype(np.float32)
    outline = Outline(normals, normals, np.ones(50, np.float32))
    assert np.abs(np.linalg.norm(outline.normals, axis=1) - 1).max() < 1e-15


@pytest.mark.parametrize(
    "again", [lambda o: o, copy.copy, copy.deepcopy, lambda o: pickle.loads(pickle.dumps(o))]
)
def test_cannot_be_written_to(again):
    """An outline copies its arrays and stays as it was checked, alone and within particles, also in copies."""
    points, normals, areas = SQUARE
    outline = Outline(points, normals, areas)
    particles = again(Particles([(0.5, 0.5)], 1.0, outline))
    for owner in (again(outline), particles.outline):
        for values in (owner.points, owner.normals, owner.areas):
            with pytest.raises(ValueError, match="read-only"):
                values[0] = 7
    points += 1.0
    assert outline.points.max() == 1.0
    points -= 1.0


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(points=np.zeros((4, 4))), r"points must have shape .point, 2. or .point, 3. .* got \(4, 4\)"),
        (dict(points=np.zeros((0, 2))), "at least one point, got"),
        (
            dict(normals=np.zeros((3, 2))),
            r"normals must have the shape \(4, 2\) of the points.* got \(3, 2\)",
        ),
        (dict(areas=1.0), r"areas must have shape \(4,\).* got \(\); np.full"),
        (dict(normals=[(0, -1), (2, 0), (0, 1), (-1, 0)]), "length 1, got 2 at point 1; divide"),
        (dict(areas=[1, 1, 0, 1]), "areas must be > 0, got 0.0 at point 2; leave out"),
        (dict(areas=[1, 1, 1, np.inf]), "areas must be finite; point 3 is not"),
        (dict(points=[(0, 0), (np.nan, 0), (0, 0), (0, 0)]), "points must be finite; point 1 is not"),
    ],
)
def test_refuses(changes, message):
    """What is no outline is refused with the rule, the value and a remedy."""
    settings = dict(zip(("points", "normals", "areas"), SQUARE, strict=True)) | changes
    with pytest.raises(ValueError, match=message):
        Outline(**settings)


def test_refuses_types():
    """Texts are no numbers, a box no outline, and a flat outline has no solid particles."""
    with pytest.raises(TypeError, match="outline points must be real numbers"):
        Outline("abc", *SQUARE[1:])
    with pytest.raises(TypeError, match="particles outline must be a Outline, got Particles"):
        Particles([(0.5, 0.5)], 1.0, softmpm.box((0, 0), (1, 1), 1.0))  # pyright: ignore
    with pytest.raises(ValueError, match="as many axes as its particles, got 2D and 3D"):
        Particles([(0.5, 0.5, 0.5)], 1.0, Outline(*SQUARE))


def test_particles_need_none():
    """Particles of positions and volumes alone have no outline."""
    assert Particles([(0.5, 0.5)], 1.0).outline is None
