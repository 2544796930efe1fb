"""The programs in ``examples/`` with a small budget, each of which leaves its picture; and the list of benchmarks."""

import ast
import dataclasses
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import softmpm

EXAMPLES = Path(__file__).parents[1] / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs an example in an empty folder; gives its names."""
    monkeypatch.chdir(tmp_path)

    def of(name: str) -> dict:
        monkeypatch.setattr("sys.argv", [f"{name}.py", "--quick"])
        names = runpy.run_path(str(EXAMPLES / f"{name}.py"))
        with Image.open(f"{name}.png") as picture:
            assert np.asarray(picture.convert("L")).std() > 5  # not blank
        return names

    return of


@pytest.mark.parametrize("name", NAMES)
def test_an_example_is_short_and_listed(name):
    """Below 60 lines, with a line and a small picture in the table of the folder."""
    text = (EXAMPLES / f"{name}.py").read_text()
    assert len(text.splitlines()) < 60 and ast.get_docstring(ast.parse(text))
    picture = EXAMPLES.parent / "docs" / "images" / "examples" / f"{name}.png"
    assert f"({name}.py)" in (EXAMPLES / "README.md").read_text() and picture.stat().st_size <= 40_000


def test_the_finger_reaches_its_target(run):
    """The tip comes within a quarter of its first distance, which is that of no activation to a few millimetres."""
    distances = run("gripper_finger")["distances"]
    assert distances[0] > 20.0 and min(distances) < 0.25 * distances[0]


def test_the_ball_is_identified(run):
    """E within 10 % although the data have another grid; the first guess is 60 % off."""
    names = run("bouncing_ball")
    assert abs(names["young"] / 3e4 - 1) < 0.1 and abs(names["viscosity"] / 20.0 - 1) < 0.2
    drop = (
        0.1 - 9.81 / 2 * (20 * names["period"]) ** 2
    )  # 0.1 s of free fall from 0.15 m, above a floor at 0.05 m
    assert abs(names["data"][19].item() - (0.05 + drop)) < 1e-3


def test_one_policy_reaches_many_goals(run):
    """On a row of goals the error is below half of that of a finger at rest, and it follows the goal to both sides."""
    names = run("worlds")
    goal, model, end = names["goal"][:, 0], names["model"], names["end"]
    reached = softmpm.displacement(model, end)[:, names["tip"], 1].mean(1)
    assert (reached - goal).square().mean() < 0.25 * goal.square().mean()
    assert reached[0] < -0.01 and reached[-1] > 0.01


def test_the_jump_gets_higher(run):
    """It rises higher than at the start, with E and without; E is learned and differs between the regions."""
    names = run("jump")
    assert all(curve[-1] > curve[0] + 1.0 for curve in names["curves"].values())
    assert len(names["young"].unique()) == 3 and bool(((names["young"] - 50).abs() > 0.1).all())


def test_the_robot_of_a_picture_moves(run):
    """Muscles are where the picture is red and blue, apart from each other; it gets further than with the first activation."""
    names = run("image_robot")
    red, blue = (names["shape"].positions[muscle.particles] for muscle in names["muscles"])
    assert red[:, 0].max() < 0.17 and blue[:, 0].min() > 0.25 and len(red) > 50
    assert names["distances"][-1] > names["distances"][0] + 10.0


def test_the_floor_carries_the_mesh(run):
    """The impulse of floor and weight is the momentum, the mass that of the mesh, and forces begin with the touch."""
    names = run("mesh_robot")
    assert abs(names["impulse"] - names["momentum"][-1]) < 1e-3 * names["momentum"].abs().max()
    fall = (2 * 0.02 / 9.81) ** 0.5
    time = names["period"] * torch.arange(1, 1 + len(names["force"]))
    assert bool((names["force"][time < 0.95 * fall] == 0).all()) and names["force"].max() > names["weight"]
    assert abs(names["weight"] / (9.81 * 1070 * names["ring"].volume) - 1) < 0.05


def test_fibres_follow_their_law(run):
    """Stretches under the loads agree with the closed form of uniaxial plane strain, with the fibres and without."""
    names = run("material_law")
    mu, lam = 2e4 / 2.6, 2e4 * 0.3 / (1.3 * 0.4)

    def load(a, k1):
        low, high = 0.3, 1.0  # bisection for the transverse stretch, at which the transverse stress vanishes
        for _ in range(60):
            b = (low + high) / 2
            low, high = (b, high) if mu * (b * b - 1) + lam * np.log(a * b) < 0 else (low, b)
        e = a * a - 1
        fibre = 2 * k1 * e * np.exp(names["k2"] * e * e) * a * a
        return (mu * (a * a - 1) + lam * np.log(a * b) + fibre) / a

    for name, k1 in (("without fibres", 0.0), ("with fibres", names["k1"])):
        for stretch, applied in zip(names["stretch"][name].tolist(), names["loads"].tolist(), strict=True):
            assert abs(load(stretch, k1) - applied) < 0.02 * names["loads"][-1], (name, stretch, applied)


def test_an_own_term_is_learned(run):
    """The term is a column of the metrics and part of the loss, has the value of its formula, and the loss falls."""
    names = run("objective")
    rows = [{key: float(value) for key, value in row.items() if value} for row in names["rows"]]
    assert abs(sum(rows[0][name] for name in names["task"].objective.names) / rows[0]["loss"] - 1) < 1e-4
    assert names["result"].best_loss < rows[0]["loss"] and Path("objective.gif").stat().st_size > 10_000


def test_the_tape_has_the_gradient(run):
    """The throw gets nearer, and the tape's gradient is that of simulate, which PyTorch differentiates."""
    names = run("warp_tape")
    assert names["errors"][-1] < 0.5 * names["errors"][0]
    model, rest = names["model"], names["model"].rest()
    velocity = torch.tensor(names["tried"], requires_grad=True)
    start = rest._replace(v=velocity.expand_as(rest.v))
    end = softmpm.simulate(model, start, None, model.params(), substeps=names["substeps"])
    (end.x - torch.tensor([*names["target"]])).square().sum(-1).mean().backward()
    assert torch.allclose(velocity.grad, torch.tensor(names["gradient"]), rtol=1e-2, atol=1e-4)


def test_a_film_is_made(run):
    """GIF, MP4 and Rerun file of one recording; the film shows all of it at a quarter of the speed."""
    names = run("film")
    with Image.open("film.gif") as film:
        assert film.n_frames == round(names["seconds"] / 0.25 * 25) + 1
    assert Path("film.mp4").stat().st_size > 5_000 and Path("film.rrd").stat().st_size > 50_000
    with softmpm.Recording("film.h5") as recording:
        assert len(recording.frames(0)["time"]) == round(names["seconds"] / names["period"]) + 1


def test_every_benchmark_is_listed():
    """With its program in a table of ``bench/README.md``; each page that is named there exists."""
    folder = EXAMPLES.parent / "bench"
    text = (folder / "README.md").read_text()
    names = {path.name for path in folder.glob("*.py")}
    names |= {f"{path.parent.name}/" for path in folder.glob("*/__init__.py")}
    assert names == set(re.findall(r"`([a-z_]+(?:\.py|/))`", text)) - {"results/"}
    for page in re.findall(r"\]\((\S+?)(?:#\S+)?\)", text):
        assert (folder / page).is_file(), page


def test_benchmarks_of_walkers_begin(monkeypatch):
    """Their tasks, on grids that no resolution has and with weights of each world, are not refused."""
    monkeypatch.syspath_prepend(EXAMPLES.parent / "bench")
    from bench import episode, variants

    for _, cells, *rest in episode.CASES[:2]:
        task = episode.task_of("biped", cells, *rest)
        assert task.scene.grid.spacing == 1 / cells
    each = {name: torch.ones(1) for name in ("soles", "effort", "mean", "upright")}
    tilt = task.objective.terms[2]
    weighted = dataclasses.replace(task, objective=variants.weighted(task, tilt, each)).objective
    assert weighted.terms[-1].term is tilt
