"""The pictures of a run: they are made, they have the right size and colours, and they tell their arrays."""

import dataclasses
import itertools
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import softmpm
from softmpm_learn.command import progress as progress_module
from softmpm_learn.command.pictures import curves
from softmpm_learn.command.progress import ProgressBar
from softmpm_learn.figures import VALUES, canvas, latent_figure, loss_figure, robot_figure
from softmpm_learn.training.timing import duration


@pytest.fixture(scope="module")
def scene():
    """A block with one muscle on a floor."""
    block = softmpm.box((0.3, 0.1), (0.6, 0.3), 0.02)
    muscle = softmpm.Muscle(particles=np.arange(20), direction=(0.0, 1.0), strength=1.0)
    return softmpm.Scene(
        grid=softmpm.Grid(shape=(26, 14), spacing=0.04),
        bodies=[softmpm.Body(block, softmpm.NeoHookean(density=1.0, young=10.0))],
        muscles=[muscle],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.08)],
        dt=1e-3,
    )


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """Figures that are saved."""
    found, save = [], canvas.save
    monkeypatch.setattr(
        canvas, "save", lambda figure, path, dpi: found.append(figure) or save(figure, path, dpi)
    )
    return found


def pixels(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def colour_count(image: np.ndarray, red_over_blue: int) -> int:
    """Pixels whose red is above their blue by more than so much (below, if negative)."""
    difference = image[..., 0] - image[..., 2]
    return int(
        (difference > red_over_blue).sum() if red_over_blue > 0 else (difference < red_over_blue).sum()
    )


def test_latent_figure_paints_negative_red_and_positive_blue(tmp_path):
    """A feature that only moves things to the left gives a picture with red and no blue, and the other way round."""
    for sign, name in ((-1.0, "red"), (1.0, "blue")):
        fields = np.zeros((2, len(VALUES), 12, 6, 2))
        fields[..., 0] = sign
        latent_figure(tmp_path / f"{name}.png", fields)
        image = pixels(tmp_path / f"{name}.png")
        some, none = (60, -60) if sign < 0 else (-60, 60)
        assert colour_count(image, some) > 1000
        assert colour_count(image, none) < 20


def test_latent_figure_has_a_row_for_each_feature(tmp_path):
    """More features make the picture higher and no wider; a 3D field gives its middle slice, the same picture."""
    rng = np.random.default_rng(0)
    fields = rng.standard_normal((6, len(VALUES), 10, 8, 2))
    latent_figure(tmp_path / "six.png", fields)
    latent_figure(tmp_path / "two.png", fields[:2])
    six, two = (pixels(tmp_path / f"{name}.png").shape for name in ("six", "two"))
    assert six[0] > 2 * two[0] and six[1] == two[1]
    solid = np.zeros((2, len(VALUES), 10, 8, 5, 3))
    solid[..., 2, :2] = fields[:2]
    latent_figure(tmp_path / "solid.png", solid)
    assert (pixels(tmp_path / "solid.png") == pixels(tmp_path / "two.png")).all()


def test_latent_figure_has_everything_in_its_place(tmp_path):
    """The first feature has a node in the upper right that moves upwards for its last value, and one in the opposite corner that hardly
    moves: blue is in the first row, in the last column, in its upper right quarter."""
    fields = np.zeros((3, len(VALUES), 12, 8, 2))
    fields[0, -1, 10, 6, 1], fields[0, :, 1, 1, 0] = 1.0, 0.2
    latent_figure(tmp_path / "place.png", fields)
    image = pixels(tmp_path / "place.png")
    y, x = np.argwhere(image[..., 2] - image[..., 0] > 90).mean(axis=0) / image.shape[:2]
    assert 0 < y < 0.25 and 0.95 < x < 1


def test_latent_figure_leaves_out_where_nothing_moves(tmp_path):
    """The frame is cut to the nodes that move, so that a small robot on a large grid fills the picture."""
    fields = np.zeros((1, len(VALUES), 60, 40, 2))
    fields[:, :, 20:30, 10:20, 0] = 1.0
    latent_figure(tmp_path / "large.png", fields)
    image = pixels(tmp_path / "large.png")
    assert colour_count(image, -60) > 0.15 * image.shape[0] * image.shape[1]


def test_features_that_change_nothing_are_named(tmp_path, drawn):
    """Their columns are equal, as those of an encoder that has hardly learned; of features that change something no word is said."""
    fields = np.ones((3, len(VALUES), 12, 8, 2)) * (1.0, -0.5)
    fields[1] *= np.reshape(VALUES, (-1, 1, 1, 1))
    fields[2] += 0.04 * np.reshape(VALUES, (-1, 1, 1, 1))
    for some in (fields, fields[:2], fields[1:2]):
        latent_figure(tmp_path / "latent.png", some)
    ends = [figure.get_supxlabel().split("\n")[1:] for figure in drawn]
    said = "nearly equal columns: the velocity hardly depends on feature"
    assert ends == [[f"{said}s 1, 3"], [f"{said} 1"], []]


def test_loss_figure_draws_what_has_numbers(tmp_path):
    """A curve without a finite number is left out; gaps and a single point do no harm."""
    loss_figure(tmp_path / "two.png", {"loss": ([0, 1, 2], [3.0, np.nan, 1.0]), "validation": ([2], [0.5])})
    loss_figure(tmp_path / "one.png", {"loss": ([0, 1, 2], [3.0, 2.0, 1.0]), "validation": ([], [])})
    loss_figure(tmp_path / "none.png", {"loss": ([], [])})
    two, one, none = (pixels(tmp_path / f"{name}.png") for name in ("two", "one", "none"))
    assert two.shape[0] > one.shape[0] >= none.shape[0]
    assert colour_count(one, -60) > 100


def test_values_between_gaps_are_dots(tmp_path, drawn):
    """A line does not show one between two that are not finite."""
    nan = np.nan
    loss_figure(tmp_path / "loss.png", {"loss": (range(8), [nan, 5.0, nan, 4.0, 3.0, nan, nan, 2.0])})
    (dots,) = (line for line in drawn[0].axes[0].lines if line.get_marker() == "o")
    assert list(dots.get_xdata()) == [1, 7] and list(dots.get_ydata()) == [5.0, 2.0]


def test_the_loss_and_its_lowest_value_are_both_seen(tmp_path, drawn):
    """Of a loss that falls all the time, where they are the same curve, and each has its name."""
    loss_figure(tmp_path / "loss.png", {"loss": ([0, 1, 2, 3], [4.0, 3.0, 2.0, 1.0])})
    legend = drawn[0].axes[0].get_legend()
    assert {text.get_text() for text in legend.get_texts()} == {"loss", "lowest so far"}
    image = pixels(tmp_path / "loss.png")[
        :, : pixels(tmp_path / "loss.png").shape[1] * 2 // 3
    ]  # without the legend
    assert colour_count(image, 60) > 1000 and colour_count(image, -60) > 500


def test_evaluations_have_a_title_that_needs_no_goals(tmp_path):
    """A walker is evaluated too, over a longer motion."""
    (tmp_path / "metrics.csv").write_text("iteration,loss,evaluation\n0,1.0,2.0\n1,0.5,\n")
    found = curves(tmp_path / "metrics.csv")
    assert found["loss in evaluations"] == ([0], [2.0]) and found["loss"] == ([0, 1], [1.0, 0.5])


def test_losses_over_decades_are_drawn_as_logarithms(tmp_path):
    """Where all are positive; a loss of both signs and one of a single decade are not."""
    assert [
        canvas.scale(v) for v in ([1.0, np.nan, 200.0], [1.0, 50.0], [-1.0, 200.0], [0.0, 200.0], [])
    ] == [*("log", "linear", "linear", "linear", "linear")]


FALL = -1.0 + np.exp(-np.arange(100) / 4.0)


@pytest.mark.parametrize(
    "values, scale, expected",
    [
        (FALL, "linear", None),
        (1e3 * FALL, "linear", None),
        ([1.0] * 99 + [5.0], "linear", None),
        (np.append(np.linspace(0.0, 1.0, 101), np.nan), "linear", None),
        (np.append(np.linspace(0.0, 1.0, 101), 5e4), "linear", (-0.05, 1.05)),
        (np.append(np.linspace(0.0, 1.0, 101), -5e4), "linear", (-0.05, 1.05)),
        (10.0 ** np.append(np.linspace(0.0, 1.0, 101), 50.0), "log", (10.0**-0.05, 10.0**1.05)),
        ([], "linear", None),
    ],
)
def test_an_axis_leaves_out_what_would_flatten_it(values, scale, expected):
    """And not the fall at the beginning of a run. Where it does, the others have all of it."""
    found = canvas.limits(values, scale)
    if expected is None:
        assert found is None
    else:
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_values_outside_of_an_axis_are_marked(tmp_path, drawn):
    """A triangle at each place, and the farthest value above the axes; without such values there is neither."""
    spikes = FALL + np.where(np.isin(np.arange(100), (40, 70)), 5e4, 0.0)
    spikes[80] = -700.0
    loss_figure(tmp_path / "loss.png", {"loss": (range(100), spikes), "evaluation": (range(100), FALL)})
    loss, other = drawn[0].axes
    marks = {
        line.get_marker(): list(line.get_xdata()) for line in loss.lines if line.get_marker() in ("^", "v")
    }
    assert marks == {"^": [40, 70], "v": [80]}
    assert loss.get_title(loc="right") == "▲ up to 5e+04  ▼ down to -700" and loss.get_ylim()[1] < 0.1
    assert other.get_title(loc="right") == "" and not any(line.get_marker() == "^" for line in other.lines)


def test_robot_figure_shows_activation_and_design(tmp_path, scene):
    """A muscle that pulls is red, one that pushes is blue, a row is added for each frame and one for the design."""
    rest = scene.bodies[0].particles.positions
    sizes = {}
    for name, activation, some in (("pull", 1.0, 60), ("push", -1.0, -60)):
        frames = [("start", rest, None), ("end", rest + (0.1, 0.05), np.array([activation]))]
        robot_figure(tmp_path / f"{name}.png", scene, frames, {})
        image = pixels(tmp_path / f"{name}.png")
        sizes[name] = image.shape
        assert colour_count(image, some) > 100 and colour_count(image, -some) < 30
    design = {"young": (np.linspace(5.0, 20.0, len(rest)), "Pa"), "poisson": (np.full(len(rest), 0.3), "")}
    robot_figure(
        tmp_path / "design.png", scene, [("start", rest, None)] * 2, design, goal=np.array([0.7, 0.3])
    )
    assert pixels(tmp_path / "design.png").shape[0] > sizes["pull"][0] + 150


def test_uniform_materials_are_words(tmp_path, scene, drawn):
    """A panel of one colour tells nothing but a number; without co-design there is no panel of a material."""
    rest, muscle = scene.bodies[0].particles.positions, np.arange(len(scene.bodies[0].particles)) < 20
    young, poisson = np.full(len(rest), 5e4), np.float32(0.3) * np.ones(len(rest), dtype=np.float32)
    off = {
        "young": (young, "Pa"),
        "poisson": (poisson, ""),
        "strength": (np.where(muscle, 6e3, np.nan), "Pa"),
    }
    designed = off | {"young": (young * (1 + 1e-3 * muscle), "Pa")}
    for design in (off, designed):
        robot_figure(tmp_path / "robot.png", scene, [("start", rest, None)], design)
    titles = [[axes.get_title() for axes in figure.axes if axes.get_title()] for figure in drawn]
    assert titles == [[], ["young [Pa]"]]
    plain, panels = drawn
    assert plain.axes[0].title.get_window_extent().y1 < plain.bbox.y1
    assert plain.get_supxlabel().endswith("\nuniform: young 50000 Pa, poisson 0.3, strength 6000 Pa")
    assert panels.subfigs[0].get_supxlabel().endswith("\nuniform: poisson 0.3, strength 6000 Pa")


def test_robot_figure_shows_fibres(tmp_path, scene):
    """Strokes over the muscle: dark at rest, and light over the dark colours of one that works. A pressure has none."""
    rest, counts = scene.bodies[0].particles.positions, {}
    pressure = softmpm.Pressure(particles=scene.muscles[0].particles, strength=1.0)
    other = dataclasses.replace(scene, muscles=[pressure])
    for name, one, activation in (("none", other, 1.0), ("rest", scene, 0.0), ("works", scene, 1.0)):
        robot_figure(tmp_path / "robot.png", one, [("", rest, np.array([activation]))], {})
        image = pixels(tmp_path / "robot.png")[200:-100, 100:-20]
        counts[name] = [(np.abs(image - level).max(-1) < 30).sum() for level in ((44, 44, 52), (250,) * 3)]
    dark, light = np.transpose(list(counts.values()))
    assert dark[0] == dark[2] == 0 and dark[1] > 50 and light[2] > light[0] + 50


def test_a_goal_is_drawn_as_a_black_cross(tmp_path, scene, drawn):
    """With white edges and over the robot, so that it is seen on muscles at work, and with its name below."""
    rest, goal = scene.bodies[0].particles.positions, np.array([0.8, 0.3])
    for place in (goal, None):
        robot_figure(tmp_path / "robot.png", scene, [("", rest, None)], {}, goal=place)
    panels = [figure.axes[0] for figure in drawn]
    (cross,), none = ([line for line in axes.lines if line.get_marker() == "X"] for axes in panels)
    assert (cross.get_xdata(), cross.get_ydata()) == (0.8, 0.3) and not none
    assert (cross.get_color(), cross.get_markeredgecolor()) == ("black", "white")
    assert cross.zorder > panels[0].collections[0].zorder
    words = [figure.get_supxlabel() for figure in drawn]
    assert words[0].endswith("cross: goal") and "goal" not in words[1]


def test_pictures_of_a_robot_in_3d_show_its_near_side(tmp_path, drawn):
    """Of two muscles, one behind the other, the near one has the colour and the strokes, and its material is drawn last."""
    block = softmpm.box((0.3, 0.2, 0.2), (0.5, 0.4, 0.4), spacing=0.025)
    order = np.argsort(-block.positions[:, 2], kind="stable")  # the far ones last
    block = softmpm.Particles(block.positions[order], block.volume[order])
    near = block.positions[:, 2] > 0.3
    sides = ((near, (1.0, 0.0, 0.0)), (~near, (0.0, 1.0, 0.0)))
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(20, 12, 12), spacing=0.05),
        bodies=[softmpm.Body(block, softmpm.NeoHookean(density=1e3, young=1e5, poisson=0.3))],
        muscles=[
            softmpm.Muscle(particles=np.flatnonzero(side), direction=along, strength=1.0)
            for side, along in sides
        ],
        dt=1e-5,
    )
    frame = ("", block.positions, np.array([0.5, -0.5]))
    robot_figure(tmp_path / "robot.png", scene, [frame], {"young": (near.astype(float), "Pa")})
    panels = {axes.get_title(): axes for axes in drawn[0].axes}
    robot, design = drawn[0].axes[0], panels["young [Pa]"]
    faces = robot.collections[0].get_facecolors()
    assert (faces[-1, 0] > faces[-1, 2]) and (faces[0, 0] < faces[0, 2])
    ends = np.array([line.get_xydata() for line in robot.lines])
    assert len(ends) > 3 and np.ptp(ends[..., 1], axis=1).max() < 1e-9 < np.ptp(ends[..., 0], axis=1).min()
    assert list(design.collections[0].get_array()) == sorted(near)


def test_all_materials_are_drawn_on_the_whole_robot(tmp_path, scene, drawn):
    """With the same extent, also a strength that only muscles have, and with titles within the picture."""
    count = len(scene.bodies[0].particles)
    strength = np.where(np.arange(count) < 20, np.linspace(1.0, 2.0, count), np.nan)
    design = {
        name: (np.linspace(1.0, 2.0, count), "")
        for name in (
            "Young's modulus, over that of the scene",
            "Poisson's ratio, over that of the scene",
            "a",
            "b",
        )
    }
    rest = scene.bodies[0].particles.positions
    robot_figure(tmp_path / "robot.png", scene, [("", rest, None)], design | {"strength": (strength, "Pa")})
    panels = [axes for axes in drawn[0].axes[1:] if axes.get_title()]
    assert len(panels) == 5 and len({(*axes.get_xlim(), *axes.get_ylim()) for axes in panels}) == 1
    boxes = [axes.title.get_window_extent() for axes in panels]
    assert boxes[0].x0 > 0 and all(one.x1 < other.x0 for one, other in itertools.pairwise(boxes))


def test_figures_do_not_import_matplotlib_until_they_draw():
    """Importing the module is cheap and touches no global state of matplotlib."""
    code = "import sys, softmpm_learn.figures; sys.exit('matplotlib' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], env={"PYTHONPATH": ":".join(sys.path)}).returncode == 0
    )


def test_progress_without_a_terminal_writes_a_few_lines(caplog):
    """The first and the last iteration and every so many in between, with the loss, the lowest one and the time left."""
    with caplog.at_level("INFO", logger="softmpm_learn"), ProgressBar(40, lines=4) as progress:
        for k in range(40):
            progress(k, float((k - 30) ** 2))
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 5
    assert lines[0] == "after 1 of 40 iterations: loss 900, lowest 900" and " left" in lines[1]
    assert lines[-1].startswith("after 40 of 40 iterations: loss 81, lowest 0")


def test_the_time_left_leaves_out_the_first_iteration(caplog, monkeypatch):
    """Which compiles kernels for 90 s here, while the others take 1 s each: after the second, 18 s are left of 20 iterations."""
    clock = iter((90.0, 91.0))
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: next(clock))
    with caplog.at_level("INFO", logger="softmpm_learn"), ProgressBar(20) as progress:
        progress(0, 1.0)
        progress(1, 1.0)
    first, second = (record.getMessage() for record in caplog.records)
    assert "left" not in first and second.endswith(f", {duration(18.0)} left")


def test_progress_of_runs_side_by_side_is_their_median_and_range(caplog):
    """And the lowest of all of them."""
    with caplog.at_level("INFO", logger="softmpm_learn"), ProgressBar(2) as progress:
        progress(0, 3.0, 1.0, 2.5)
        progress(1, 4.0, 2.0, 3.5)
    last = caplog.records[-1].getMessage()
    assert last.startswith("after 2 of 2 iterations: loss 3.5 (2 to 4), lowest 1")


def test_progress_on_a_terminal_is_a_bar(monkeypatch, capsys):
    """It shows how many iterations of how many are done, and the loss; a resumed run starts where it is."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with ProgressBar(10) as progress:
        for k in range(4, 10):
            progress(k, 1.5)
    shown = capsys.readouterr().err
    assert "10/10" in shown and "loss 1.5" in shown


def test_a_bar_of_several_runs_fits_into_a_terminal(monkeypatch, capsys):
    """Of 80 columns, with the last digit of each number; the bar proper of ten columns may shrink to one."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with ProgressBar(100) as progress:
        progress(0, -0.0123456, -0.0987654, -0.0345678)
    line = capsys.readouterr().err.split("\r")[-1].rstrip()
    assert line.endswith("loss -0.0346 (-0.0988 to -0.0123), lowest -0.0988]") and len(line) - 9 < 80


def test_a_picture_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    """A run that ends while it draws leaves the picture before, and no half of one."""
    path = tmp_path / "loss.png"
    loss_figure(path, {"loss": ([0, 1], [2.0, 1.0])})
    before = path.read_bytes()

    def broken(self, target, **_):
        target.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(Figure, "savefig", broken)
    with pytest.raises(KeyboardInterrupt):
        loss_figure(path, {"loss": ([0, 1, 2], [2.0, 1.0, 0.5])})
    assert path.read_bytes() == before and [entry.name for entry in tmp_path.iterdir()] == ["loss.png"]
