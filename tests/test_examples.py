"""The examples of the README and of the pages run as printed."""

import re
from pathlib import Path

import pytest
import torch
import warp
from helpers import bar
from PIL import Image, ImageSequence

import softmpm

README = Path(__file__).parents[1] / "README.md"
START = README.parent / "docs" / "start.md"
FORMULATIONS = README.parent / "docs" / "formulations.md"
QUANTITIES = README.parent / "docs" / "quantities.md"


def test_the_code_of_the_readme_runs():
    """They give a gradient for every control step; some of it is more than rounding."""
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names: dict = {}
    exec(code, names)
    gradient = names["activation"].grad
    assert gradient.shape == (25, 1, 1) and bool(torch.isfinite(gradient).all())
    assert gradient.abs().max() > 1e-4 and bool((gradient != 0).all())


def test_the_code_on_contact_forces_runs():
    """A block on a belt presses with its weight and is pulled by the friction, whose derivative is the weight."""
    (code,) = re.findall(r"```python\n(.*?)```", FORMULATIONS.read_text(), re.DOTALL)
    names: dict = {}
    exec(code, names)
    pull, push = names["forces"].total[0, 0].tolist()
    assert abs(push / 588 - 1) < 0.1 and abs(pull / push / 0.3 - 1) < 1e-3
    assert abs(names["friction"].grad.item() / 588 - 1) < 0.15


def test_the_code_of_the_first_page_runs(tmp_path, monkeypatch, capsys):
    """In one program, block after block: the tip learns, and a picture, a film, a recording and a Rerun file are written."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("warp.config.log_level", warp.config.log_level)
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", START.read_text(), re.DOTALL):
        exec(code, names)
    losses = [float(line.split()[1]) for line in capsys.readouterr().out.splitlines() if line[:1].isdigit()]
    assert len(losses) == 5 and losses[-1] < 0.1 * losses[0]
    wanted = {"scene.png", "end.png", "finger.gif", "finger.h5", "finger.rrd"}
    assert {path.name for path in tmp_path.iterdir()} == wanted
    with Image.open("finger.gif") as film:  # 0.1 s at a tenth of the speed, with equal pictures merged
        assert film.n_frames == len(names["states"]) == 11
        assert sum(frame.info["duration"] for frame in ImageSequence.Iterator(film)) == 26 * 40


PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    *(f"docs/{p.name}" for p in (README.parent / "docs").glob("*.md")),
]


@pytest.mark.parametrize("page", PAGES)
def test_every_file_that_a_page_names_is_there(page):
    """Links and pictures lead somewhere, also on a host that shows the files as they are."""
    text = re.sub(r"```.*?```|`[^`]*`", "", (README.parent / page).read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith("http"):
            assert (README.parent / page).parent.joinpath(target).exists(), target


def test_the_reference_has_every_public_name():
    """``docs/api.rst`` lists what ``softmpm`` exports, each once."""
    listed = re.findall(r"auto\w+:: ([\w.]+)", (README.parent / "docs" / "api.rst").read_text())
    names = [name.rpartition(".")[2] for name in listed if name != "Episode"]
    assert sorted(names) == sorted(softmpm.__all__)


def test_the_code_on_quantities_runs(tmp_path, monkeypatch):
    """A block that falls for 40 ms is 8 mm lower; a body that nothing holds is not strained."""
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", QUANTITIES.read_text(), re.DOTALL):
        exec(code, names)
    model, end, softmpm = names["model"], names["end"], names["softmpm"]
    fallen = softmpm.body_mean(model, softmpm.displacement(model, end))[0, 0]
    assert abs(fallen[1].item() / (-9.8 * 100 * 101 / 2 * 4e-4**2) - 1) < 1e-4
    assert softmpm.von_mises_strain(end).max() < 1e-4
    frames = names["way"].frames
    assert frames.shape == (10, 1, 2)
    assert abs(frames[-1] - softmpm.center_of_mass(model, end, names["params"])).max() < 1e-6
    assert abs(names["alone"].x - end.x).max() < 1e-6  # one of four worlds, in two calls
    assert names["succeeded"] == [0, 1, 2, 3] and torch.isfinite(names["loss"])
    assert torch.equal(names["resumed"].x, names["state"].x)


def test_the_code_on_inputs_runs(tmp_path, monkeypatch):
    """The block slides less far where the friction is greater, and says so by its gradient; the film of its walls is there."""
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    text = (README.parent / "docs" / "inputs.md").read_text()
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(code, names)
    assert (tmp_path / "lift.gif").exists()
    few, many = names["end"].x[..., 0].mean(1).tolist()
    assert few > many and (names["friction"].grad < 0).all()


def test_the_code_on_shapes_runs(capsys):
    """The particles of a disc and of a leg, and the outline of the whole robot."""
    names: dict = {}
    text = (README.parent / "docs" / "shapes.md").read_text()
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(code, names)
    assert [f"{float(line):.4f}" for line in capsys.readouterr().out.splitlines()] == ["0.0320", "0.0314"]
    assert 0 < len(names["muscular"]) < len(names["robot"]) and names["robot"].outline is not None


def test_the_code_on_graphs_runs():
    """With a scene, a policy and a loop of one's own, here one without a simulation."""
    text = (README.parent / "docs" / "performance.md").read_text()
    (code,) = re.findall(r"## Your own loop as one graph\n```python\n(.*?)```", text, re.DOTALL)
    policy = torch.nn.Linear(1, 1, bias=False, device=softmpm.build(bar()).device)
    names: dict = {"scene": bar(), "policy": policy, "closed_loop": lambda own: own.weight.square().sum()}
    exec(code, names)
    assert names["loss"] == policy.weight.square()
    assert names["gradients"][0] == 2 * policy.weight


def test_the_code_on_objectives_runs():
    """Three terms by name, the constraint among them; the term of the page has the value that it is said to have."""
    text = (README.parent / "docs" / "learning.md").read_text()
    code, *_ = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert names["objective"].names == ["progress", "effort", "spread_beyond"]
    x = torch.rand(5, 2, 7, 3)
    empty = torch.zeros(2, 7, 3, 3)
    states = [softmpm.State(one, torch.zeros(2, 7, 3), empty, empty) for one in x]
    path = names["Path"]([0.1 * k for k in range(5)], states, torch.zeros(4, 2, 1))
    want = x[2:, :, :, 0].var(dim=2).mean(dim=0)
    torch.testing.assert_close(names["Spread"](begin=0.2).value(path), want)
