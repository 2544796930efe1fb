"""Pictures of scenes and states: places, scale, colours and walls, measured in pixels; and what is refused."""

import io
import subprocess
import sys

import numpy as np
import pytest
import torch
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.quiver import Quiver
from PIL import Image

import softmpm
from softmpm.pictures.camera import Camera
from softmpm.pictures.colouring import CATEGORIES, NAMED, PASSIVE, categories, of_names
from softmpm.pictures.panel import _pascal
from softmpm.recording import style
from softmpm.recording.surroundings import of_recording, of_scene

RUBBER = softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3)
FLOOR, SIDE = 0.1, 0.15


def scene_of(dim: int = 2, **changes) -> softmpm.Scene:
    """A box 0.05 m above a floor and beside a wall, and a ball 0.4 m to the right of it."""
    middle, depth = ((), ()) if dim == 2 else ((0.5,), (0.1,))
    low = (0.3, 0.15, *(m - d for m, d in zip(middle, depth, strict=True)))
    high = (0.5, 0.45, *(m + d for m, d in zip(middle, depth, strict=True)))
    box = softmpm.box(low, high, 1 / 40)
    ball = softmpm.ball((0.8, 0.3, *middle), 0.1, 1 / 40)
    axes = np.eye(dim)
    settings = dict(
        grid=softmpm.Grid(shape=(25, 21, 21)[:dim], spacing=1 / 20),
        bodies=[softmpm.Body(box, RUBBER), softmpm.Body(ball, RUBBER)],
        walls=[
            softmpm.Wall(normal=tuple(axes[1]), offset=FLOOR),
            softmpm.Wall(normal=tuple(axes[0]), offset=SIDE, contact="stick"),
        ],
        muscles=[softmpm.Muscle(particles=np.arange(len(box)), direction=tuple(axes[1]), strength=1e3)],
        gravity=tuple(-9.8 * axes[1]),
        dt=2e-4,
    )
    return softmpm.Scene(**(settings | changes))


@pytest.fixture(scope="module")
def model() -> softmpm.Model:
    return softmpm.build(scene_of(), device="cpu", worlds=2)


def test_nearly_equal_values_stand_at_the_bar_in_full(model):
    """An array of 50349 has ticks of that size, not of 0 and 1 beside an offset."""
    figure = softmpm.show(model, model.rest(), colour=np.full(model.particle_count, 50349.0))
    figure.draw_without_rendering()
    bar = next(axes for axes in figure.axes if axes.get_aspect() != 1.0)
    assert all(float(label.get_text()) > 50000 for label in bar.get_yticklabels())


def pixels(figure: Figure, dpi: int = 100) -> np.ndarray:
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=dpi)
    image = np.asarray(Image.open(png).convert("RGB")).astype(int)
    right = max(axes.get_position().x1 for axes in figure.axes if axes.get_aspect() == 1.0)
    return image[:, : int(right * image.shape[1])]  # without the key of the colours


def where(image: np.ndarray, colour: np.ndarray, within: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels of a colour."""
    return (np.abs(image - np.asarray(colour, dtype=int)).max(-1) <= within).nonzero()


def upper_edge(figure: Figure, image: np.ndarray) -> int:
    """Row of pixels below which the first panel is."""
    return round((1.0 - figure.axes[0].get_position().y1) * len(image))


def test_bodies_and_walls_are_where_they_are_in_metres():
    """In pixels, the box, the distance to the ball and the gaps to both walls have the scale of the box's width, along both axes."""
    image = pixels(softmpm.show(scene_of(), colour="body"), dpi=200)
    rows, columns = where(image, CATEGORIES[0])
    out = 0.2 / 40  # [m] by which a dot is wider than its cell, on each side
    scale = (columns.max() - columns.min()) / (0.2 + 2 * out)  # pixels per metre
    slack = 0.004 * scale
    assert 300 < scale < 3000
    assert rows.max() - rows.min() == pytest.approx((0.3 + 2 * out) * scale, abs=slack)
    ball = where(image, CATEGORIES[1])
    assert ball[1].mean() - columns.mean() == pytest.approx(0.4 * scale, abs=slack)
    assert ball[0].mean() == pytest.approx(rows.mean(), abs=slack)
    floor, _ = where(image, style.WALL[b"separate"], within=1)
    assert np.median(floor) - rows.max() == pytest.approx((0.05 - out) * scale, abs=slack)
    _, side = where(image, style.WALL[b"stick"], within=1)
    assert columns.min() - np.median(side) == pytest.approx((0.15 - out) * scale, abs=slack)


@pytest.mark.parametrize(
    ("height", "width", "young"), [(0.2, 0.1, 1e4), (0.3, 0.2, 3e5), (0.6, 0.15, 3e5), (0.3, 0.3, 1e4)]
)
def test_labels_are_within_the_picture(height, width, young):
    """Of an upright body with numbers of up to six digits at the colours: nothing touches an edge."""
    block = softmpm.box((0.4, FLOOR), (0.4 + width, FLOOR + height), width / 8)
    floor = softmpm.Wall(normal=(0.0, 1.0), offset=FLOOR)
    scene = scene_of(bodies=[softmpm.Body(block, RUBBER)], walls=[floor], muscles=[])
    values = young * (1.0 + block.positions[:, 1])
    png = io.BytesIO()
    softmpm.show(scene, colour=values, label="young [Pa]").savefig(png, dpi=100)
    image = np.asarray(Image.open(png).convert("L"))
    for edge in (image[0], image[-1], image[:, 0], image[:, -1]):
        assert edge.min() > 250


def test_hatching_is_below_the_floor():
    """Pixels between white and the wall's colour are on the solid side."""
    image = pixels(
        softmpm.show(scene_of(walls=[softmpm.Wall(normal=(0.0, 1.0), offset=FLOOR)]), colour="body")
    )
    floor = int(np.median(where(image, style.WALL[b"separate"], within=1)[0]))
    part = image[:, image.shape[1] // 4 : image.shape[1] // 2]
    below, above = part[floor + 4 : floor + 20], part[floor - 8 : floor - 3]
    assert (above == 255).all() and (below < 255).all() and np.ptp(below[..., 0]) > 30


def test_colours_follow_the_speed(model):
    """The body that moves is dark, the one at rest is light; the scale ends at its speed or at given limits."""
    state = model.rest()
    moving = np.flatnonzero(model.body.numpy() == 1)
    state.v[0, moving, 0] = 3.0
    figure = softmpm.show(model, state)
    image = pixels(figure)
    dark, light = where(image, (12, 22, 64)), where(image, (206, 212, 220))
    assert len(dark[0]) > 500 and len(light[0]) > 500 and dark[1].min() > np.quantile(light[1], 0.99)
    (bar,) = (axes for axes in figure.axes if axes.get_ylabel() == "speed [m/s]")
    assert bar.get_ylim() == pytest.approx((0.0, 3.0))
    half = pixels(softmpm.show(model, state, limits=(0.0, 6.0)))
    assert len(where(half, (12, 22, 64))[0]) == 0 and len(where(half, (48, 124, 188))[0]) > 500


def test_strain_is_that_of_the_deformation_gradient(model):
    """A stretch of 1.2 along one axis has the Green strain (1.44 − 1)/2 at the upper end of the scale; a rotation has none."""
    state = model.rest()
    state.F[0, 0] = torch.tensor([[1.2, 0.0], [0.0, 1.0]])
    state.F[0, 1] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    figure = softmpm.show(model, state, colour="strain")
    (bar,) = (axes for axes in figure.axes if "strain" in axes.get_ylabel())
    assert bar.get_ylim() == pytest.approx((0.0, 0.22), rel=1e-5)


def test_activation_is_red_where_a_muscle_pulls(model):
    """The muscle of each world has the colour of its activation, and the ball, which has none, stays grey."""
    activation = torch.tensor([[1.0], [-1.0]])
    figure = softmpm.show(model, model.rest(), activation=activation, world=(0, 1))
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == ["world 0", "world 1"]
    image = pixels(figure)
    red, blue = where(image, style.CONTRACT), where(image, style.EXTEND)
    assert len(red[0]) > 300 and len(blue[0]) > 300
    assert red[1].max() < blue[1].min() or red[0].max() < blue[0].min()
    assert len(where(image, style.BODY[0])[0]) > 300


def test_own_values_have_a_labelled_scale(model):
    """An array with a row for each world shows the row of the world."""
    values = torch.arange(2.0)[:, None] + torch.linspace(0.0, 0.5, model.particle_count)
    figure = softmpm.show(model, model.rest(), colour=values, world=1, label="mass [kg]")
    (bar,) = (axes for axes in figure.axes if axes.get_ylabel() == "mass [kg]")
    assert bar.get_ylim() == pytest.approx((1.0, 1.5))


@pytest.mark.parametrize("count, height", [(12, 0.6), (14, 0.3), (14, 0.05), (30, 0.3), (70, 0.3)])
def test_each_of_many_muscles_has_a_colour_and_a_name(count, height):
    """Also more than the fixed colours: each is in the picture, the names are all there, and nothing touches an edge."""
    block = softmpm.box((0.1, FLOOR), (0.9, FLOOR + height), 1 / 240)
    strip = np.floor((block.positions[:, 0] - 0.1) / 0.8 * count)
    muscles = [
        softmpm.Muscle(particles=np.flatnonzero(strip == k), direction=(0.0, 1.0), strength=1.0)
        for k in range(count)
    ]
    figure = softmpm.show(scene_of(bodies=[softmpm.Body(block, RUBBER)], walls=[], muscles=muscles))
    image = pixels(figure)
    middles = [np.median(where(image, colour, 1)[1]) for colour in categories(count)]
    assert np.all(np.diff(middles) > 0)
    key = figure.axes[-1].get_legend()
    assert [text.get_text() for text in key.get_texts()] == [f"muscle {k}" for k in range(count)]
    box, whole = key.get_window_extent(), figure.bbox
    assert whole.x0 < box.x0 and box.x1 < whole.x1 and whole.y0 < box.y0 and box.y1 < whole.y1
    png = io.BytesIO()
    figure.savefig(png, dpi=100)
    every = np.asarray(Image.open(png).convert("L"))
    for edge in (every[0], every[-1], every[:, 0], every[:, -1]):
        assert edge.min() > 250


def test_a_pressure_is_called_one(tmp_path):
    """As in describe() and in Rerun, with its number among all actuators; of a recording too."""
    actuators = [
        softmpm.Muscle(particles=range(20), direction=(0.0, 1.0), strength=1.0),
        softmpm.Pressure(particles=range(20, 40), strength=1.0),
    ]
    scene = scene_of(muscles=actuators)
    key = softmpm.show(scene).axes[-1].get_legend()
    assert [text.get_text() for text in key.get_texts()] == ["muscle 0", "pressure 1"]
    model = softmpm.build(scene, device="cpu")
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(iteration=0) as episode:
        episode.frame(0.0, model.rest())
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        assert of_recording(recording).actuators == ("muscle 0", "pressure 1")


def test_names_are_in_the_key(model):
    """As given, also with signs that matplotlib has a meaning for; equal ones with their places. The figure has room for long ones."""
    given = ["_leg", r"$\foo$", "", "trunk", "trunk", 64 * "W"]
    muscles = [
        softmpm.Muscle(particles=range(20 * k, 20 * k + 20), direction=(0.0, 1.0), strength=1.0, name=name)
        for k, name in enumerate(given)
    ]
    figure = softmpm.show(scene_of(muscles=muscles))
    key = figure.axes[-1].get_legend()
    shown = [text.get_text() for text in key.get_texts()]
    assert shown == ["_leg", r"$\foo$", "muscle 2", "trunk (3)", "trunk (4)", 64 * "W"]
    figure.canvas.draw()
    assert key.get_window_extent().x1 < figure.bbox.x1


def test_a_muscle_called_by_a_colour_has_it():
    """Something red is not called blue; others get colours that differ from it, from paper and from the body."""
    names = ["Blue", "muscle 1", "red", "leg"]
    colours = of_names(names)
    np.testing.assert_array_equal(colours[[0, 2]], [NAMED["blue"], NAMED["red"]])
    for some in (names, list(NAMED), ["red"], ["Red", "red"]):
        every = np.vstack([of_names(some), np.full(3, 255.0), PASSIVE])
        assert (np.abs(every[:, None] - every[None]).max(-1) + 255.0 * np.eye(len(every))).min() >= 30
    np.testing.assert_array_equal(of_names(["a", "b"]), CATEGORIES[:2])
    assert of_names([]).shape == (0, 3)
    half = softmpm.Muscle(particles=range(20), direction=(0.0, 1.0), strength=1.0, name="red")
    image = pixels(softmpm.show(scene_of(muscles=[half])))
    assert len(where(image, NAMED["red"])[0]) > 50


@pytest.mark.parametrize("count, least", [(12, 30), (24, 30), (60, 30), (500, 10)])
def test_categories_can_be_told_apart(count, least):
    """From each other, from white and from the grey of no muscle, in at least one of red, green and blue."""
    colours = np.vstack([categories(count), np.full(3, 255.0), PASSIVE])
    apart = np.abs(colours[:, None] - colours[None]).max(-1) + 255.0 * np.eye(count + 2)
    assert apart.min() >= least
    np.testing.assert_array_equal(categories(count)[:12], CATEGORIES)


@pytest.mark.parametrize("world", [np.int64(1), torch.tensor(1), np.array(1), np.array([1]), [np.int64(1)]])
def test_a_world_is_any_whole_number(model, world):
    """Of NumPy and PyTorch too; a fraction is refused."""
    image = pixels(softmpm.show(model, model.rest(), world=world))
    np.testing.assert_array_equal(image, pixels(softmpm.show(model, model.rest(), world=1)))
    with pytest.raises(TypeError, match="whole number"):
        softmpm.show(model, model.rest(), world=1.5)  # pyright: ignore[reportArgumentType]


def test_tractions_are_green_arrows(model):
    """A force on one surface point draws an arrow there, upward, with white edges; without forces there is no green."""
    state = softmpm.simulate(model, model.rest(), None, model.params(), substeps=1)
    assert state.surface is not None
    green = pixels(softmpm.show(model, state))
    assert len(where(green, style.TRACTION)[0]) == 0
    points = model.surface.shown(state)[0]
    point = int(points[:, 0].argmin())
    force = torch.zeros_like(state.surface.force)
    force[0, 0, point] = torch.tensor([0.0, 5.0])
    pushed = state._replace(surface=state.surface._replace(force=force))
    image = pixels(figure := softmpm.show(model, pushed))
    rows, columns = where(image[upper_edge(figure, image) :], style.TRACTION)
    assert len(rows) > 30 and np.ptp(rows) > 2 * np.ptp(columns)
    arrows = [one for one in figure.axes[0].collections if isinstance(one, Quiver)]
    assert len(arrows) == 2 and all(isinstance(one.get_path_effects()[0], withStroke) for one in arrows)


@pytest.mark.parametrize("worlds, words", [(0, "traction 200 Pa"), ((0, 1), "200 Pa")])
def test_an_arrow_is_the_scale_of_the_tractions(model, worlds, words):
    """In pixels, the reference arrow and that of the one traction, which is not round, are as long as their values say."""
    state = softmpm.simulate(model, model.rest(), None, model.params(), substeps=1)
    point = int(model.surface.shown(state)[0][:, 0].argmin())
    force = torch.zeros_like(state.surface.force)
    force[0, 0, point, 1] = 320.0 * model.surface.areas[point]
    pushed = state._replace(surface=state.surface._replace(force=force))
    figure = softmpm.show(model, pushed, world=worlds)
    assert [text.get_text() for axes in figure.axes for text in axes.texts] == [words]
    image = pixels(figure, dpi=300)
    top = upper_edge(figure, image)
    length = np.ptp(where(image[:top], style.TRACTION)[1])
    assert length / np.ptp(where(image[top:], style.TRACTION)[0]) == pytest.approx(200 / 320, rel=0.05)
    assert not any(axes.texts for axes in softmpm.show(model, state).axes)


@pytest.mark.parametrize("count, rows, columns", [(1, 1, 1), (2, 1, 2), (3, 2, 2), (4, 2, 2), (5, 2, 3)])
def test_worlds_are_side_by_side(count, rows, columns):
    """Of nearly square pictures; the lowest one in each column has the numbers of its x axis, also above an empty place."""
    block = softmpm.box((0.3, 0.1), (0.7, 0.5), 1 / 40)
    floor = softmpm.Wall(normal=(0.0, 1.0), offset=0.1)
    scene = scene_of(bodies=[softmpm.Body(block, RUBBER)], muscles=[], walls=[floor])
    figure = softmpm.show(scene, world=range(count))
    panels = [axes for axes in figure.axes if axes.axison]
    assert panels[0].get_subplotspec().get_gridspec().get_geometry() == (rows, columns)
    lowest = [axes.get_xlabel() == "x [m]" and axes.xaxis.get_tick_params()["labelbottom"] for axes in panels]
    assert lowest == [False] * (count - columns) + [True] * columns


@pytest.mark.parametrize("stress, text", [(0.5, "0.5 Pa"), (999.0, "999 Pa"), (2e3, "2 kPa"), (5e6, "5 MPa")])
def test_a_stress_has_a_prefix(stress, text):
    """From a thousand on."""
    assert _pascal(stress) == text


def test_driven_particles_have_dark_edges():
    """They are told from the others, in a scene at rest."""
    scene = scene_of(walls=[], muscles=[])
    plain = pixels(softmpm.show(scene, colour="body"), dpi=200)
    driven = pixels(softmpm.show(scene_of(walls=[], muscles=[], driven=range(24)), colour="body"), dpi=200)
    left = slice(None, plain.shape[1] // 2)
    dark = [(image[:, left].sum(-1) < 200).sum() for image in (plain, driven)]
    assert dark[1] > dark[0] + 300


def test_a_solid_scene_is_drawn_in_perspective():
    """Both bodies are seen, shaded from above: the upper half of the ball is brighter than the lower."""
    figure = softmpm.show(scene_of(3), colour="body")
    image = pixels(figure)
    orange = (image[..., 0] > image[..., 2] + 60).nonzero()
    rows, columns = orange
    assert len(rows) > 1000
    bright = image[rows, columns].sum(-1)
    upper = rows < np.median(rows)
    assert bright[upper].mean() > 1.1 * bright[~upper].mean()
    assert "0.1 m" in figure.axes[0].get_xlabel()


@pytest.mark.parametrize("height", [0.05, 0.1])
def test_strokes_are_whole_and_on_the_faces_in_view(height):
    """No particle covers the middle of a dot, on a plate of two or four layers, and none belongs to a face that is turned away."""
    body = softmpm.box((0.2, 0.2, 0.2), (0.6, 0.2 + height, 0.5), spacing=0.025)
    muscle = softmpm.Muscle(particles=np.arange(len(body)), direction=(1.0, 0.0, 0.0), strength=1.0)
    scene = scene_of(3, bodies=[softmpm.Body(body, RUBBER)], walls=[], muscles=[muscle])
    axes = softmpm.show(scene).axes[0]
    (drawn,) = (one for one in axes.collections if isinstance(one, EllipseCollection))
    places, radii = np.asarray(drawn.get_offsets()), np.asarray(drawn.get_widths()) / 2
    strokes = np.flatnonzero(radii < 0.5 * radii.max())
    assert len(strokes) > 300
    for k in strokes:
        later = np.setdiff1d(np.arange(k + 1, len(places)), strokes)
        assert (np.linalg.norm(places[later] - places[k], axis=1) > radii[later]).all()
    place = of_scene(scene)
    camera = Camera(*place.window(place.rest, place.normals, place.offsets), place.up)
    bottom = place.rest[:, 1] < 0.2 + 0.02
    inner = (np.abs(place.rest[:, [0, 2]] - (0.4, 0.35)) < (0.15, 0.1)).all(1)
    assert not camera.sees(place, place.rest)[bottom & inner].any()
    assert camera.sees(place, place.rest)[(place.rest[:, 1] > 0.18 + height) & inner].all()


def test_particles_that_are_not_finite_are_left_out(model):
    """The picture of a failed world has the others, in their place."""
    state = model.rest()
    state.x[0, :5] = torch.nan
    assert (pixels(softmpm.show(model, state, colour="body")) != 255).any()


def test_given_axes_are_drawn_into(model):
    """A figure of the user's own, with other panels, stays as it is."""
    figure = Figure(figsize=(8, 4))
    left, right = figure.subplots(1, 2)
    left.plot([0, 1], [0, 1])
    assert softmpm.show(model, model.rest(), axes=right) is figure
    assert right.get_aspect() == 1.0 and len(left.lines) == 1


def test_a_figure_shows_itself_in_a_notebook(model):
    """By the method that Jupyter calls, as a PNG."""
    png = softmpm.show(model, model.rest())._repr_png_()
    assert Image.open(io.BytesIO(png)).format == "PNG"


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(colour="pressure"), "colour must be one of speed, strain"),
        (dict(colour=np.zeros(3)), "colour must have shape"),
        (dict(colour="activation"), "needs the activation of each muscle"),
        (dict(activation=torch.zeros(5, 2, 1)), "of many control steps it takes one"),
        (dict(world=2), "world must be between 0 and 1"),
        (dict(world=()), "world must be between 0 and 1"),
        (dict(limits=(1.0, 0.0)), "ascending order"),
        (dict(limits=np.array([0.0, 1.0, 2.0])), "limits must be two numbers"),
        (dict(axes=[]), "axes must be one for each world"),
    ],
)
def test_wrong_arguments_are_refused(model, changes, message):
    """By a sentence that names what is wanted."""
    with pytest.raises(ValueError, match=message):
        softmpm.show(model, model.rest(), **changes)


def test_wrong_kinds_are_refused(model):
    """A state needs its model, and a model is no path."""
    with pytest.raises(TypeError, match="with its model"):
        softmpm.show(model.scene, model.rest())
    with pytest.raises(TypeError, match="needs a model or a scene"):
        softmpm.show("run.h5")  # pyright: ignore[reportArgumentType]


def test_without_matplotlib_the_remedy_is_named(model, monkeypatch):
    """The simulator works without it."""
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        softmpm.show(model, model.rest())


def test_pictures_leave_pyplot_alone():
    """No figure stays behind in the memory of pyplot, which is not even imported."""
    code = (
        "import sys, softmpm\n"
        "body = softmpm.Body(softmpm.box((0.2, 0.2), (0.4, 0.4), 0.05), softmpm.NeoHookean(density=1.0, young=1.0))\n"
        "scene = softmpm.Scene(grid=softmpm.Grid(shape=(9, 9), spacing=0.1), bodies=[body], dt=1e-3)\n"
        "softmpm.show(scene)._repr_png_()\n"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    subprocess.run(
        [sys.executable, "-c", code], check=True, env={"PYTHONPATH": ":".join(sys.path)}, timeout=120
    )


def test_a_body_outside_of_the_grid_is_in_the_picture(model):
    """As in the reference formulation, where it may fall out of it: the axes are upright, and hold all particles."""
    for shift in ((0.0, -3.0), (5.0, 0.0), (-5.0, 9.0)):
        state = model.rest()
        state = state._replace(x=state.x + torch.tensor(shift, dtype=state.x.dtype))
        axes = softmpm.show(model, state).axes[0]
        for limits, places in zip((axes.get_xlim(), axes.get_ylim()), state.x[0].T, strict=True):
            assert limits[0] <= places.min() < places.max() <= limits[1]


def test_any_style_leaves_letters_dark(model):
    """On white panels; axes of the user's own have the colours of their figure."""
    from matplotlib import rc_context
    from matplotlib.colors import same_color
    from matplotlib.text import Text

    look = {"text.color": "white", "axes.labelcolor": "white", "xtick.color": "white", "ytick.color": "white"}
    state = model.rest()
    with rc_context(look):
        for figure in (softmpm.show(model, state), softmpm.show(model)):
            letters = [text for text in figure.findobj(Text) if text.get_text()]
            assert letters and all(same_color(text.get_color(), "black") for text in letters)
        own = Figure().subplots()
        softmpm.show(model, state, axes=own)
        assert same_color(own.xaxis.label.get_color(), "white")


def test_muscles_of_a_scene_without_any_are_refused():
    """In place of an error of NumPy's; limits may be an array or a tensor."""
    model = softmpm.build(scene_of(muscles=[]), device="cpu")
    with pytest.raises(
        ValueError, match="colour 'muscle' needs a scene with muscles or pressures; take 'body'"
    ):
        softmpm.show(model, model.rest(), colour="muscle")
    for limits in (np.array([0.0, 2.0]), torch.tensor([0.0, 2.0])):
        assert softmpm.show(model, model.rest(), limits=limits).axes[-1].get_ylim() == (0.0, 2.0)
