"""Objects are shown in a line, and in notebooks as a small table."""

import pytest
import torch
from helpers import busy_scene

import softmpm
from softmpm.summary import table


@pytest.fixture(scope="module")
def model() -> softmpm.Model:
    return softmpm.build(busy_scene(2), device="cpu", dtype=torch.float64)


def test_a_line_tells_the_sizes(model, tmp_path):
    """No tensor is printed, however many particles there are."""
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(3) as episode:
        episode.frame(0.0, model.rest())
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        shown = [model, model.scene, model.rest(), model.params(), recording]
        lines = [repr(thing) for thing in shown]
        tables = [thing._repr_html_() for thing in shown if not isinstance(thing, softmpm.Params)]
    assert all("\n" not in line and len(line) < 400 for line in lines)
    assert f"1 world of {model.particle_count} particles" in lines[0] and "plain scheme" in lines[0]
    assert "neo" in lines[1].lower() and f"of {model.particle_count} particles" in lines[1]
    assert f"x: (1, {model.particle_count}, 2) float64 on cpu" in lines[2] and lines[2].startswith("State(")
    assert "episodes: 1" in lines[4] and "frames: 1" in lines[4]
    assert all(text.startswith(("<pre>", "<b>")) for text in tables)


def test_html_is_escaped(model):
    """A file name may hold anything."""
    assert "<script>" not in table("<script>", {"<script>": "<script>"})
