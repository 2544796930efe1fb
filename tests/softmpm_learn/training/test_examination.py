"""Examination of a finished run: each answer against simulations by hand, failures, and where the answers are written."""

import csv
import dataclasses
import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import softmpm
from softmpm_learn.episode import run_episode
from softmpm_learn.objective import Objective, Progress, Reach, Still, Tilt
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.term import Path, Term
from softmpm_learn.train import train
from softmpm_learn.training import examination, finishing
from softmpm_learn.training.examination import examine, motion, rubbed


@pytest.fixture
def run(task, model, settings, tmp_path) -> Run:
    settings.observer.name, settings.policy.gain = "centroids", 1.0
    return Run(task, model, settings, tmp_path)


def positions(run: Run, task, kick: float = 0.0) -> tuple[torch.Tensor, float]:
    """Mean position along x at each control step of a closed loop by hand, shape (step + 1,), and its period."""
    model = softmpm.build(task.scene, device="cpu")
    state, (params, inputs) = model.rest(), run.design()
    state = state._replace(v=state.v + torch.tensor([kick, 0.0]))
    found = [state.x[0, :, 0].double().mean()]
    with torch.no_grad():
        for k in range(task.control_steps):
            time = torch.tensor(k * task.control_period)
            activation = run.policy(run.observer(run.model, state), time, None)
            state = softmpm.simulate(
                model, state, activation[None], params, substeps=task.substeps, inputs=inputs
            )
            found.append(state.x[0, :, 0].double().mean())
    return torch.stack(found), task.control_period


def test_answers_are_those_of_simulations_by_hand(run, task):
    """Quotients of mean speeds: from T to 3T over from T/2 to T; the worse of two kicks, and of two floors, over the episode."""
    found, n = examine(Runs([run]))[0], task.control_steps
    longer = dataclasses.replace(task, control_steps=3 * n)
    x, _ = positions(run, longer)
    later = (x[3 * n] - x[n]) / (2 * n) / ((x[n] - x[n // 2]) / (n - n // 2))
    assert found["later"] == pytest.approx(later.item(), rel=5e-3)
    own = (x[n] - x[0]).item()
    kicked = [positions(run, task, kick)[0] for kick in (0.1, -0.1)]
    assert found["kicked"] == pytest.approx(min((y[n] - y[0]).item() / own for y in kicked), rel=1e-3)
    rough = [positions(run, rubbed(task, factor))[0] for factor in (0.75, 1.25)]
    assert found["friction"] == pytest.approx(min((y[n] - y[0]).item() / own for y in rough), rel=1e-3)
    assert (
        abs(kicked[0][n] - kicked[1][n]) > 1e-4
        and math.isnan(found["finer"])
        and math.isnan(found["largest_tilt"])
    )


@dataclass(frozen=True, kw_only=True)
class Gap(Term):
    """Mean distance of the robot from a place ahead, above or below zero [m]."""

    place: float

    def value(self, path: Path):
        return self.place - path.x[-1, ..., 0].mean(dim=-1)


@pytest.mark.parametrize("place", [0.0, 1.0])
def test_the_worse_of_two_has_the_larger_value(run, task, place):
    """Whatever the sign of the values: behind the place and beyond it, the robot that comes less far is the worse."""
    run.task = dataclasses.replace(task, objective=Objective(Gap(place=place)))
    own, *kicked = (positions(run, task, kick)[0][-1].item() for kick in (0.0, 0.1, -0.1))
    assert max(kicked) - min(kicked) > 1e-4
    want = (place - min(kicked)) / (place - own)
    assert examine(Runs([run]))[0]["kicked"] == pytest.approx(want, rel=1e-5)


def test_the_finer_grid_replays_the_activations(run, task, make_block):
    """On the same grid the motion is the same: the answer is 1."""
    assert examine(Runs([run]), finer=task)[0]["finer"] == pytest.approx(1.0, rel=1e-4)


def test_miss_and_speed_are_the_largest_around_the_end(run, task, monkeypatch):
    """Of what should reach a place and rest there: from a while before the end of the episode to a while after it."""
    period, n = task.control_period, task.control_steps
    monkeypatch.setattr(examination, "BEFORE", 2 * period)
    monkeypatch.setattr(examination, "AFTER", 1 * period)
    part, place = task.regions["right"], np.array([0.3, 0.2])
    run.task = dataclasses.replace(
        task, objective=Objective(Reach(particles=part, target=place), Still(particles=part, end=period))
    )
    states, longer = [], dataclasses.replace(task, control_steps=n + 1)
    with torch.no_grad():
        design = run.design()[0]
        run_episode(
            longer, run.model, run.observer, run.policy, design, on_frame=lambda f: states.append(f.state)
        )
    around = states[n - 2 : n + 2]
    x, v = (torch.stack([getattr(one, name)[0, part].mean(dim=0).cpu() for one in around]) for name in "xv")
    found = examine(Runs([run]))[0]
    assert found["largest_miss"] == pytest.approx(
        (x - torch.tensor(place).to(x)).norm(dim=-1).max().item(), rel=1e-4
    )
    assert found["largest_speed"] == pytest.approx(v.norm(dim=-1).max().item(), rel=1e-3)


def test_the_tilt_is_the_largest_until_the_end(run, task):
    """In degrees, over three episodes."""
    rest = run.model.positions.cpu().double().numpy()
    tilt = Tilt(front=task.regions["right"], back=task.regions["left"], rest=rest)
    run.task = dataclasses.replace(task, objective=Objective(Progress(), tilt))
    states = []
    longer = dataclasses.replace(task, control_steps=3 * task.control_steps)
    with torch.no_grad():
        run_episode(
            longer,
            run.model,
            run.observer,
            run.policy,
            run.design()[0],
            on_frame=lambda f: states.append(f.state),
        )
    parts = np.concatenate([task.regions["right"], task.regions["left"]])
    first = np.column_stack([rest[parts], np.ones(len(parts))])
    lines = [np.linalg.lstsq(first, state.x[0, parts].double().numpy())[0][0] for state in states]
    want = max(math.degrees(math.atan2(abs(rise), run)) for run, rise in lines)
    early = dataclasses.replace(tilt, end=task.control_period)
    for one in (tilt, early):  # whatever the window of the term
        run.task = dataclasses.replace(task, objective=Objective(Progress(), one))
        assert examine(Runs([run]))[0]["largest_tilt"] == pytest.approx(want, rel=1e-4) and want > 0.1


def test_a_simulation_that_fails_has_no_answer(run, monkeypatch, caplog):
    """The others do; the log says which one failed."""
    monkeypatch.setattr(examination, "KICK", 1e6)
    with caplog.at_level("WARNING", logger="softmpm_learn"):
        found = examine(Runs([run]))[0]
    assert math.isnan(found["kicked"]) and math.isfinite(found["later"])
    assert len(caplog.messages) == 2  # kicks forwards and backwards
    for message in caplog.messages:
        assert message.startswith("Examination, kicked:") and "In control step 0 of " in message


def test_a_robot_that_fails_does_so_once(run, task, monkeypatch):
    """It goes on from rest; frozen before its failure it would fail in every control step."""
    collected = []

    class Kept(softmpm.Failures):
        def __init__(self, policy):
            super().__init__(policy)
            collected.append(self)

    monkeypatch.setattr(examination, "Failures", Kept)
    assert motion(Runs([run]), task, "kicked", kick=1e6) == [None]
    assert [len(failures) for failures in collected] == [1] and task.control_steps > 1


def test_a_replay_that_fails_names_its_control_step(run, task, caplog):
    """Far too strong an activation, from the second step on."""
    (path,) = motion(Runs([run]), task, "the episode itself")
    strong = path.activation.clone()
    strong[1:] = 1e6
    with caplog.at_level("WARNING", logger="softmpm_learn"):
        assert examination.replayed(Runs([run]), task, [SimpleNamespace(activation=strong)]) == [None]
    [message] = caplog.messages
    assert message.startswith("Examination, finer:") and "In control step 1 of " in message


def test_an_examination_that_fails_leaves_the_run_finished(
    task, model, settings, tmp_path, monkeypatch, caplog
):
    """As with a policy that knows the times of an episode alone: its columns are empty, and the log says why."""

    def fails(*_):
        raise IndexError("index 4 is out of bounds")

    monkeypatch.setattr(finishing, "examine", fails)
    settings.observer.name, settings.train.examine = "centroids", True
    with caplog.at_level("WARNING", logger="softmpm_learn"):
        result = train(task, model, settings, tmp_path / "run")
    assert (
        result.finished
        and math.isnan(result.examination["later"])
        and math.isfinite(result.examination["end"])
    )
    assert "The examination failed" in caplog.text and "index 4 is out of bounds" in caplog.text


def test_a_run_ends_with_its_examination(task, model, settings, tmp_path):
    """In the result, and in a last row of metrics.csv, for the episode after the last; not if it is switched off."""
    settings.observer.name, settings.train.examine = "centroids", True
    result = train(task, model, settings, tmp_path / "run")
    with open(tmp_path / "run" / "metrics.csv", newline="") as file:
        *rows, last = csv.DictReader(file)
    assert len(rows) == settings.train.iterations == int(last["iteration"]) and last["loss"] == ""
    assert float(last["later"]) == pytest.approx(result.examination["later"], rel=1e-6)
    assert all(row["later"] == "" for row in rows)
    settings.train.examine = False
    assert train(task, model, settings, tmp_path / "quick").examination == {}
