"""Strokes along the fibres of muscles: their direction is measured in pixels."""

import dataclasses
import io
import math

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import find_objects, label

import softmpm
from softmpm.pictures.colouring import CATEGORIES
from softmpm.recording.fibres import DARK, LIGHT, Fibres, stroke_colours
from softmpm.recording.surroundings import of_recording, of_scene

RUBBER = softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3)
DIRECTION = {2: (math.cos(math.radians(30)), math.sin(math.radians(30))), 3: (0.0, 1.0, 0.0)}


def scene_of(dim: int, *, pressure: bool = False) -> softmpm.Scene:
    """A block whose left half is a muscle; in 2D with fibres 30 degrees from the x axis, in 3D with upright ones."""
    block = softmpm.box((0.3,) * dim, (0.7,) * dim, 1 / 30 if dim == 2 else 1 / 20)
    half = np.flatnonzero(block.positions[:, 0] < 0.5)
    actuator = (
        softmpm.Pressure(particles=half, strength=1.0)
        if pressure
        else softmpm.Muscle(particles=half, direction=DIRECTION[dim], strength=1.0)
    )
    return softmpm.Scene(
        grid=softmpm.Grid(shape=(21,) * dim, spacing=1 / 20),
        bodies=[softmpm.Body(block, RUBBER)],
        muscles=[actuator],
        gravity=tuple(-9.8 * np.eye(dim)[1]),
        dt=2e-4,
    )


def angles(figure, colour: np.ndarray) -> list[float]:
    """Angle of each stroke of this colour with the x axis [degrees], in [0, 180)."""
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=150)
    image = np.asarray(Image.open(png).convert("RGB")).astype(int)
    number, _ = label((np.abs(image - colour).max(-1) <= 3), np.ones((3, 3)))
    found = []
    for k, part in enumerate(find_objects(number), 1):
        row, column = (number[part] == k).nonzero()
        if 15 < len(row) < 500:
            points = np.stack([column - column.mean(), row.mean() - row], -1)
            _, sizes, axes = np.linalg.svd(points, full_matrices=False)
            if sizes[0] > 4 * sizes[1]:
                found.append(math.degrees(math.atan2(*axes[0, ::-1])) % 180)
    return found


@pytest.fixture(scope="module")
def model() -> softmpm.Model:
    return softmpm.build(scene_of(2), device="cpu")


@pytest.mark.parametrize("turn", [0.0, 40.0])
def test_strokes_turn_with_the_muscle(model, turn):
    """Strokes lie along the fibre of the scene, turned as the body is: dark on the grey of a muscle at rest."""
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    state = model.rest()
    state.x[0] = (state.x[0] - 0.5) @ torch.tensor([[c, s], [-s, c]]) + 0.5
    found = angles(softmpm.show(model, state, activation=torch.zeros(1)), DARK)
    assert len(found) > 20
    np.testing.assert_allclose(found, 30.0 + turn, atol=4.0)


def test_strokes_stretch_with_the_muscle(model):
    """Along the fibre by a half, across to none: the rows of dots have the deformation of the particles around them."""
    place = of_scene(model.scene)
    fibres, rest = Fibres(place, 0.05), place.rest
    along = np.array(DIRECTION[2])
    stretched = rest + 0.5 * np.outer(rest @ along, along)
    rows, longer = (dots[:, -1] - dots[:, 0] for dots in (fibres.dots(rest), fibres.dots(stretched)))
    np.testing.assert_allclose(rows, np.tile(0.7 * 0.05 * along, (len(rows), 1)), atol=1e-9)
    np.testing.assert_allclose(longer, 1.5 * rows, atol=1e-9)
    stretched[fibres.particle[0]] = np.nan
    assert np.isfinite(fibres.dots(stretched)).any() and not np.isfinite(fibres.dots(stretched)[0]).any()
    assert not np.isfinite(fibres.ends(np.full_like(stretched, np.inf), raised=0.01)).any()


def test_strokes_end_with_the_muscle():
    """In a muscle that is shorter than they are, and where it bends: a stroke that stuck out would look like another part."""
    scene = scene_of(2)
    block = softmpm.box((0.3, 0.4), (0.7, 0.46), spacing=0.01)
    muscle = softmpm.Muscle(particles=range(len(block)), direction=(0.0, 1.0), strength=1.0)
    body = softmpm.Body(block, RUBBER)
    fibres = Fibres(of_scene(dataclasses.replace(scene, bodies=[body], muscles=[muscle])), 0.1)
    dots = fibres.dots(block.positions)
    assert len(dots) > 2 and 0.399 < dots[..., 1].min() < 0.406 and 0.454 < dots[..., 1].max() < 0.461
    bent = block.positions + 0.05 * np.sin(20.0 * block.positions[:, 1:]) * (1.0, 0.0)
    x, y = np.moveaxis(fibres.dots(bent) - dots[:, :1] * (1.0, 0.0), -1, 0)
    np.testing.assert_allclose(x, 0.05 * np.sin(20.0 * y), atol=2.5e-3)


@pytest.mark.parametrize("gap", [0.0, -0.1, math.nan, math.inf])
def test_strokes_need_a_distance(gap):
    """Which was divided by, or gave a stroke that points backwards."""
    scene = scene_of(2)
    with pytest.raises(ValueError, match="gap must be > 0 m, got "):
        softmpm.fibre_strokes(scene, scene.bodies[0].particles.positions, gap)


def test_strokes_need_the_positions_of_one_world(model):
    """The error says how a state has them."""
    x = model.rest().x
    with pytest.raises(ValueError, match=r"shape \(144, 2\), but have shape \(1, 144, 2\); take x\[0\]"):
        softmpm.fibre_strokes(model.scene, x, 0.05)
    assert len(softmpm.fibre_strokes(model.scene, x[0], 0.05)[1]) > 2


def test_a_row_of_particles_has_strokes_across_it():
    """Where neighbours lie on one line, they tell nothing of the fibre across, which stays as at rest."""
    scene = scene_of(2)
    line = np.stack([np.linspace(0.3, 0.6, 12), np.full(12, 0.5)], -1)
    body = softmpm.Body(softmpm.Particles(positions=line, volume=np.full(12, 1e-3)), RUBBER)
    muscle = softmpm.Muscle(particles=range(12), direction=(0.0, 1.0), strength=1.0)
    place = of_scene(dataclasses.replace(scene, bodies=[body], muscles=[muscle]))
    dots = Fibres(place, 0.05).dots(line + 0.1)
    np.testing.assert_allclose(dots[:, -1] - dots[:, 0], np.tile((0.0, 0.035), (len(dots), 1)), atol=1e-9)


def test_strokes_are_told_from_dark_colours():
    """Of the colours of muscles, blue has light strokes; a scene shows them before anything is built, and names them."""
    figure = softmpm.show(scene_of(2))
    found = angles(figure, LIGHT)
    assert len(found) > 20
    np.testing.assert_allclose(found, 30.0, atol=4.0)
    assert figure.axes[-1].get_legend().get_title().get_text() == "strokes: fibres"
    np.testing.assert_array_equal(stroke_colours(CATEGORIES[:2]), [LIGHT, DARK])


def test_strokes_of_a_solid_are_at_its_surface():
    """Upright fibres are seen from the front."""
    found = angles(softmpm.show(scene_of(3)), LIGHT)
    assert len(found) > 5
    np.testing.assert_allclose(np.median(found), 90.0, atol=6.0)


def test_strokes_of_a_solid_are_near_its_surface():
    """Of a block only the outermost layer of particles has strokes; raised ones, as Rerun has them, stand outside of it, or the dots of
    the particles would hide them."""
    scene = scene_of(3)
    rest = scene.bodies[0].particles.positions
    fibres = Fibres(of_scene(scene), 0.05)
    np.testing.assert_allclose(np.abs(rest[fibres.particle] - 0.5).max(-1), 0.175)
    outside = np.abs(fibres.ends(rest, 0.1).mean(1) - 0.5).max(-1) - 0.175
    assert len(outside) > 50 and (outside > 0.05).all() and (outside < 0.1001).all()


@pytest.mark.parametrize("change", [dict(colour="speed"), dict(colour="body"), dict(pressure=True)])
def test_other_pictures_have_no_strokes(change):
    """Neither other colours than those of muscles, nor a pressure, which has no fibres."""
    figure = softmpm.show(scene_of(2, pressure="pressure" in change), colour=change.get("colour"))
    assert not angles(figure, LIGHT) and not angles(figure, DARK)
    legend = figure.axes[-1].get_legend()
    assert legend is None or not legend.get_title().get_text()


def test_a_muscle_without_recorded_particles_has_no_strokes(tmp_path):
    """Where only few of all are recorded."""
    block = softmpm.box((0.2, 0.2), (0.8, 0.8), 0.05)
    muscles = [softmpm.Muscle(particles=[k], direction=(1.0, 0.0), strength=1.0) for k in (0, len(block) - 1)]
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(11, 11), spacing=0.1),
        bodies=[softmpm.Body(block, RUBBER)],
        muscles=muscles,
        dt=1e-5,
    )
    model = softmpm.build(scene, device="cpu")
    with (
        softmpm.Recorder(tmp_path / "run.h5", model, max_particles=3) as recorder,
        recorder.episode(0) as episode,
    ):
        episode.frame(0.0, model.rest(), torch.zeros(2))
    with softmpm.Recording(tmp_path / "run.h5") as source:
        assert not source.static["muscle"].any(axis=1).all()
        shown = Fibres(of_recording(source), 0.1)
    assert len(shown.particle) == source.static["muscle"].any(axis=1).sum()
