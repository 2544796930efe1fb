"""Checkpoints every so many iterations: whatever a run is ahead of the last one when it ends, it goes on as if nothing had been."""

import itertools
import os
import signal
from pathlib import Path

import forked
import pytest
import torch
from learners import changed

import softmpm
from softmpm_learn import train
from softmpm_learn.command.seeds import split
from softmpm_learn.runs.loops import ClosedLoop
from softmpm_learn.settings import Settings, TrainConf
from softmpm_learn.storage import checkpoint
from softmpm_learn.storage.csv_log import Table
from softmpm_learn.training.optimisation import TrainingError


def every_third(settings: Settings) -> Settings:
    """A checkpoint every third iteration of seven, random goals, every episode recorded, and a buffer of only two simulations."""
    return changed(
        settings,
        learning=dict(simulations=2),
        optimizer=dict(retries=1),
        train=dict(iterations=7, save_every=3, record_every=1, goal_spread=[0.1, 0.05], endurance=1),
    )


@pytest.fixture
def conf(settings) -> Settings:
    return every_third(settings)


@pytest.fixture(scope="module")
def unbroken(task, model, make_settings, tmp_path_factory) -> Path:
    """Folder of that run with a checkpoint in every iteration, undisturbed; tests read it only."""
    out = tmp_path_factory.mktemp("unbroken")
    train.train(task, model, changed(every_third(make_settings()), train=dict(save_every=1)), out)
    return out


def assert_same(folder: Path, unbroken: Path) -> None:
    """Metrics and recorded numbers equal to the bit, and so are replay buffer, weights, moments and random streams."""
    assert (folder / "metrics.csv").read_bytes() == (unbroken / "metrics.csv").read_bytes()
    a, b = (checkpoint.load(f) for f in (folder, unbroken))
    assert torch.equal(a["goals"], b["goals"]) and a["iteration"] == b["iteration"]
    torch.testing.assert_close(a["optimizer"]["state"], b["optimizer"]["state"], rtol=0, atol=0)
    learners = a["learner"], b["learner"]
    assert learners[0].pop("replay") == learners[1].pop("replay")
    for part in ("policy", "design", "safe", "learner"):
        torch.testing.assert_close(a[part], b[part], rtol=0, atol=0)
    assert a["seals"]["run.h5"] == b["seals"]["run.h5"]


@pytest.fixture
def saved(monkeypatch) -> list[int]:
    """Iterations of the checkpoints that are written."""
    found, real = [], checkpoint.save

    def noted(folder, content):
        found.append(content["iteration"])
        return real(folder, content)

    monkeypatch.setattr(checkpoint, "save", noted)
    return found


def test_checkpoints_come_every_so_many_iterations(task, model, conf, unbroken, tmp_path, saved):
    """At the beginning, after every third iteration and after the last; everything else is as with one in every iteration."""
    train.train(task, model, conf, tmp_path / "out")
    assert saved == [0, 3, 6, 7]
    assert_same(tmp_path / "out", unbroken)
    train.train(task, model, conf, tmp_path / "out")
    assert saved == [0, 3, 6, 7]  # nothing was left to do


class Killed(BaseException):
    """Stands for a kill: nothing of ours catches it."""


@pytest.mark.parametrize(
    "where", ["optimise", "learn", "metrics", "rows", "checkpoint", "state_dict", "first iterations"]
)
def test_killed_between_two_checkpoints_it_goes_on(task, model, conf, unbroken, tmp_path, monkeypatch, where):
    """Up to three iterations after the checkpoint of the third: rows, episodes and simulations that it does not know are made anew."""
    out, count = tmp_path / "out", itertools.count()
    owner, name, nth = {
        "optimise": (train, "optimise", 5),
        "learn": (train, "learn", 5),
        "metrics": (Table, "append", 11),  # two tables
        "rows": (Table, "flush", 15),  # between the rows and the second checkpoint
        "checkpoint": (checkpoint, "save", 2),  # one save before the first iteration
        "state_dict": (train.Run, "state_dict", 2),
        "first iterations": (train, "learn", 2),
    }[where]
    real = getattr(owner, name)

    def dies(*args, **kwargs):
        if next(count) == nth:
            raise Killed
        return real(*args, **kwargs)

    monkeypatch.setattr(owner, name, dies)
    with pytest.raises(Killed):
        train.train(task, model, conf, out)
    monkeypatch.undo()
    last = 0 if where == "first iterations" else 3
    known = checkpoint.load(out)
    assert known["iteration"] == last
    for number in known["learner"]["replay"]:
        assert (out / "replay" / f"{number:08d}.h5").exists()
    assert len(list((out / "replay").iterdir())) > len(known["learner"]["replay"])  # it is ahead
    train.train(task, model, conf, out)
    assert_same(out, unbroken)


def train_till(number: int, task, conf: Settings, out: Path) -> None:
    """A run in a process that kills itself at the end of the update of this number."""
    calls, real = itertools.count(), train.optimise

    def optimise(*args):
        found = real(*args)
        if next(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return found

    train.optimise = optimise
    train.train(task, softmpm.build(task.scene, device="cpu"), conf, out)


def test_killed_processes_resume(task, model, conf, tmp_path):
    """Killed by SIGKILL one or two iterations after a checkpoint, the run ends as one that was not; its rows are those till then."""
    out, often = tmp_path / "out", changed(conf, train=dict(record_every=0, save_every=1))
    train.train(task, model, often, tmp_path / "unbroken")
    silent = changed(conf, train=dict(record_every=0))
    ends, lasts, lines = [], [], []
    for n in (4, 2):
        ends.append(forked.exit_code(train_till, n, task, silent, out))
        lasts.append(checkpoint.load(out)["iteration"])
        lines.append((out / "metrics.csv").read_text().count("\n"))
    assert ends == [-signal.SIGKILL, -signal.SIGKILL] and lasts == [3, 3] and lines == [4, 4]
    train.train(task, model, silent, out)
    assert checkpoint.load(out)["iteration"] == 7 and (out / "metrics.csv").read_text().count("\n") == 8
    assert_same(out, tmp_path / "unbroken")


def test_falls_back_to_the_previous_checkpoint(task, model, conf, unbroken, tmp_path):
    """Its simulations are still there, though the buffer has forgotten them in the iterations since."""
    out = tmp_path / "out"
    done = []
    train.train(task, model, conf, out, progress=lambda *row: done.append(1), stop=lambda: len(done) == 6)
    (out / checkpoint.NAME).write_bytes(b"spoilt")
    assert checkpoint.load(out)["iteration"] == 3
    train.train(task, model, conf, out)
    assert_same(out, unbroken)


def test_a_run_that_is_stopped_is_saved(task, model, conf, unbroken, tmp_path, saved):
    """Where it stops, so that no iteration is done twice; how often it saves may change."""
    done = []
    words = dict(progress=lambda k, row: done.append(k), stop=lambda: len(done) == 5)
    assert not train.train(task, model, conf, tmp_path / "out", **words).finished
    assert saved == [0, 3, 5] and (tmp_path / "out" / "metrics.csv").read_text().count("\n") == 1 + 5
    assert train.train(task, model, changed(conf, train=dict(save_every=10)), tmp_path / "out").finished
    assert saved == [0, 3, 5, 7]
    assert_same(tmp_path / "out", unbroken)


# Failures


def fails(monkeypatch, at: set[int], worlds: dict[int, int] | None = None) -> None:
    """Some calls of the closed loop report an inverted particle once all their frames were recorded: in world 0, or in another."""
    real, calls = ClosedLoop.__call__, itertools.count()

    def loop(self, *args):
        found, number = real(self, *args), next(calls)
        if number in at:
            what = dict(kind="inverted", particle=3, substep=1, value=-1.0, limit="det F > 0")
            world = (worlds or {}).get(number, 0)
            raise softmpm.UnstableError("particle 3 is inverted.", world=world, **what)
        return found

    monkeypatch.setattr(ClosedLoop, "__call__", loop)


def test_a_run_that_fails_is_saved_as_it_was_before(
    task, model, conf, unbroken, tmp_path, monkeypatch, saved
):
    """Before it drew its goals and went halfway back: if it does not fail again, it ends as if it never had."""
    fails(monkeypatch, at={5, 6, 7})
    with pytest.raises(TrainingError, match="iteration 5: particle 3 is inverted") as caught:
        train.train(task, model, conf, tmp_path / "out")
    assert caught.value.iteration == 5 and saved == [0, 3, 5]
    assert (tmp_path / "out" / "metrics.csv").read_text().count("\n") == 1 + 5
    monkeypatch.undo()
    train.train(task, model, conf, tmp_path / "out")
    assert_same(tmp_path / "out", unbroken)


def test_a_run_that_is_tried_again_goes_on(task, model, conf, tmp_path, monkeypatch, saved):
    """One more checkpoint where it failed, and the same metrics as with one in every iteration."""
    for name, every in (("out", 3), ("whole", 1)):
        fails(monkeypatch, at={4})
        train.train(task, model, changed(conf, train=dict(save_every=every)), tmp_path / name)
        monkeypatch.undo()
    assert saved[:5] == [0, 3, 4, 6, 7]
    assert_same(tmp_path / "out", tmp_path / "whole")


SEEDS = 3


@pytest.fixture
def seeds(task, conf, tmp_path) -> tuple[softmpm.Model, list[train.Plan]]:
    """Three seeds side by side."""
    several = split(changed(conf, train=dict(seeds=SEEDS)))
    plans = [train.Plan(settings=one, out=tmp_path / str(k)) for k, one in enumerate(several)]
    return softmpm.build(task.scene, device="cpu", worlds=SEEDS), plans


@pytest.fixture
def whole(task, conf, seeds, tmp_path) -> list[Path]:
    """Folders of these seeds with a checkpoint in every iteration, undisturbed."""
    model, plans = seeds
    often = [
        train.Plan(settings=changed(plan.settings, train=dict(save_every=1)), out=tmp_path / f"whole{k}")
        for k, plan in enumerate(plans)
    ]
    train.train_side_by_side(task, model, often)
    return [plan.out for plan in often]


def test_a_seed_that_fails_is_saved_at_once(task, seeds, whole, monkeypatch):
    """The others come to their next checkpoint; resumed, all end as if nothing had failed."""
    model, plans = seeds
    fails(monkeypatch, at={4, 5, 6}, worlds=dict.fromkeys(range(9), 1))
    results = train.train_side_by_side(task, model, plans)
    assert [result.finished for result in results] == [True, False, True]
    assert [checkpoint.load(plan.out)["iteration"] for plan in plans] == [7, 4, 7]
    monkeypatch.undo()
    train.train_side_by_side(task, model, plans)
    for plan, want in zip(plans, whole, strict=True):
        assert_same(plan.out, want)


def test_seeds_are_saved_before_a_robot_at_rest_ends_them(task, seeds, whole, monkeypatch):
    """A seed that failed fails again at rest, which ends them all: each is saved where it was."""
    model, plans = seeds
    fails(monkeypatch, at={4, 5, 6, 8}, worlds=dict.fromkeys(range(9), 1))
    with pytest.raises(TrainingError, match="iteration 4: particle 3 is inverted"):
        train.train_side_by_side(task, model, plans)
    assert [checkpoint.load(plan.out)["iteration"] for plan in plans] == [5, 4, 5]
    monkeypatch.undo()
    train.train_side_by_side(task, model, plans)
    for plan, want in zip(plans, whole, strict=True):
        assert_same(plan.out, want)


# Rows


def test_pictures_and_tables_at_the_end_have_all_rows(task, model, conf, tmp_path):
    """Who draws while a run goes on finds the row of the episode; the examination is a row of its own."""
    found = []

    def sketch(run, iteration, frames):
        found.append((tmp_path / "metrics.csv").read_text().count("\n") - 1 - iteration)

    examined = changed(conf, train=dict(examine=True))
    train.train(task, model, examined, tmp_path, sketch=sketch)
    assert found == [1] * 7
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert [line.partition(",")[0] for line in lines[1:]] == [*map(str, range(7)), "7"]


def test_an_interval_is_positive():
    with pytest.raises(ValueError, match=r"train\.save_every must be > 0, got 0"):
        TrainConf(save_every=0)
