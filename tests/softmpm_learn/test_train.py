import contextlib
import dataclasses
import gc
import itertools
import json
import math
import os
import shutil
import signal
import time
import weakref
from pathlib import Path

import forked
import numpy as np
import pytest
import torch
from learners import changed, rows_of

import softmpm
from softmpm_learn import train
from softmpm_learn.command.pictures import design
from softmpm_learn.objective import Effort, Objective, Progress
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.settings import DesignConf, ObserverConf, Settings
from softmpm_learn.storage import checkpoint
from softmpm_learn.storage.csv_log import Table
from softmpm_learn.training.optimisation import TrainingError
from softmpm_learn.training.timing import clock


class Killed(BaseException):
    """Stands for a kill: nothing of ours catches it."""


@pytest.fixture(scope="module")
def five(task, model, make_settings, tmp_path_factory) -> Path:
    """A run of five iterations."""
    folder = tmp_path_factory.mktemp("five")
    train.train(task, model, make_settings(), folder)
    return folder


@pytest.fixture
def unbroken(five, tmp_path) -> Path:
    """Folder of a run of five iterations, undisturbed."""
    return shutil.copytree(five, tmp_path / "unbroken")


def assert_same(folder: Path, unbroken: Path) -> None:
    """Metrics equal to the byte, and final weights, replay and random streams to the bit."""
    assert (folder / "metrics.csv").read_bytes() == (unbroken / "metrics.csv").read_bytes()
    a, b = (checkpoint.load(f) for f in (folder, unbroken))
    assert torch.equal(a["goals"], b["goals"]) and a["learner"]["replay"] == b["learner"]["replay"]
    assert all(
        torch.equal(a["learner"]["streams"][k], b["learner"]["streams"][k]) for k in ("minibatches", "noise")
    )
    for part in ("policy", "design"):
        assert all(torch.equal(a[part][k], b[part][k]) for k in a[part])
    for part in ("autoencoder", "target"):
        assert all(torch.equal(a["learner"][part][k], b["learner"][part][k]) for k in a["learner"][part])


def test_every_iteration_is_a_row(unbroken, settings):
    """metrics.csv has a row for each iteration, learning phases where they are due, and a loss that is no nan."""
    found = rows_of(unbroken)
    assert [int(r["iteration"]) for r in found] == list(range(5))
    assert [bool(r["epochs"]) for r in found] == [
        True,
        True,
        False,
        True,
        False,
    ]  # after the first, and every 2
    assert all(abs(float(r["loss"])) < 1 for r in found)
    assert float(found[-1]["best"]) == min(float(r["loss"]) for r in found)
    header, *times = (unbroken / "timing.csv").read_text().splitlines()
    assert header == "iteration,episode,evaluate,learn,save,draw" and len(times) == 5
    assert all(float(line.split(",")[3]) > 0 for line in times)  # pictures are kept in every iteration


def test_times_are_summed(monkeypatch):
    """The clock adds the time of every block, also of one that raises an error."""
    ticks, seconds = itertools.count(1.0, 0.5), {}
    monkeypatch.setattr(time, "perf_counter", lambda: next(ticks))
    for error in (ValueError, None):
        with contextlib.suppress(ValueError), clock(seconds, "episode"):
            if error:
                raise error
    assert seconds == {"episode": 1.0}


def test_times_are_those_of_an_iteration(task, model, settings, tmp_path):
    """All rows together take no longer than the training: no time is in two of them. The result has their sums, with what followed."""
    begin = time.perf_counter()
    result = train.train(task, model, changed(settings, train=dict(record_every=1)), tmp_path)
    whole = time.perf_counter() - begin
    header, *lines = (tmp_path / "timing.csv").read_text().splitlines()
    columns = zip(*(map(float, line.split(",")) for line in lines), strict=True)
    sums = dict(zip(header.split(","), map(sum, columns), strict=True))
    del sums["iteration"]
    found, record, end = dict(result.seconds), result.seconds["record"], result.seconds["end"]
    assert 0 < sum(sums.values()) < sum(sums.values()) + end < whole
    assert 0 < record < found["episode"]
    for name in ("episode", "evaluate", "learn"):
        assert found[name] == pytest.approx(sums[name], rel=1e-9)
    assert found["save"] > sums["save"]  # and the last checkpoint


def test_equal_seeds_give_equal_runs(task, model, settings, unbroken, tmp_path):
    """The same seed repeats every bit, another seed does not."""
    train.train(task, model, settings, tmp_path / "again")
    assert_same(tmp_path / "again", unbroken)
    train.train(task, model, changed(settings, train=dict(seed=1)), tmp_path / "other")
    assert rows_of(tmp_path / "other")[0]["loss"] != rows_of(unbroken)[0]["loss"]


@pytest.mark.parametrize("where", ["optimise", "learn", "metrics", "checkpoint", "between renames", "prune"])
def test_interrupted_anywhere_it_goes_on_as_if_nothing_had_been(
    task, model, settings, unbroken, tmp_path, monkeypatch, where
):
    """Ended at any stage of the third iteration, a resumed run equals the unbroken one."""
    out, count = tmp_path / "out", iter(range(99))
    owner, name, nth = {
        "optimise": (train, "optimise", 2),
        "learn": (train, "learn", 2),
        "metrics": (Table, "append", 4),  # two tables
        "checkpoint": (checkpoint, "save", 3),  # one save before the first iteration
        "between renames": (os, "replace", None),
        "prune": (train.Run, "state_dict", 3),
    }[where]
    real = getattr(owner, name)

    def dies(*args, **kwargs):
        if nth is None:
            if str(args[0]).endswith(checkpoint.NAME + ".new") and next(count) == 3:
                raise Killed
        elif next(count) == nth:
            raise Killed
        return real(*args, **kwargs)

    monkeypatch.setattr(owner, name, dies)
    with pytest.raises(Killed):
        train.train(task, model, settings, out)
    monkeypatch.undo()
    train.train(task, model, settings, out)
    assert_same(out, unbroken)


def train_till(number: int, task, settings: Settings, out: Path) -> None:
    """A run in a process that kills itself when it calls the simulator for this time."""
    forked.kill_at_simulation(number)
    train.train(task, softmpm.build(task.scene, device="cpu"), settings, out)


def test_killed_processes_resume(task, model, settings, unbroken, tmp_path):
    """Killed by SIGKILL in the middle of three different iterations, the run ends as the unbroken one did."""
    out = tmp_path / "out"
    ends = [forked.exit_code(train_till, n, task, settings, out) for n in (8, 10)]
    assert ends == [-signal.SIGKILL, -signal.SIGKILL]
    train.train(task, model, settings, out)
    assert_same(out, unbroken)


def test_falls_back_to_the_previous_checkpoint(task, model, settings, tmp_path):
    """With the newest checkpoint damaged, the run goes on from the one before and ends the same; the replay buffer too."""
    small = changed(settings, learning=dict(simulations=2))
    train.train(task, model, small, tmp_path / "small")
    out = tmp_path / "out"
    train.train(task, model, changed(small, train=dict(iterations=3)), out)
    train.train(task, model, changed(small, train=dict(iterations=3)), out)  # resumed, nothing to do
    (out / checkpoint.NAME).write_bytes(b"spoilt")
    train.train(task, model, small, out)
    assert_same(out, tmp_path / "small")


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.fixture(scope="module")
def three_runs(task, model, make_settings, tmp_path_factory):
    """Recorded ones of three iterations with two seeds, and with five iterations."""
    folder = tmp_path_factory.mktemp("three")
    for name, seed, iterations in (("run", 0, 3), ("other", 1, 3), ("whole", 0, 5)):
        conf = dict(record_every=1, seed=seed, iterations=iterations)
        train.train(task, model, changed(make_settings(), train=conf), folder / name)
    return folder


@pytest.mark.parametrize("name", ["metrics.csv", "timing.csv", "run.h5", "replay/00000002.h5"])
@pytest.mark.parametrize("harm", ["flipped bit", "of another run", "empty"])
def test_files_that_are_not_those_of_the_checkpoint_are_refused(
    task, model, settings, three_runs, tmp_path, name, harm
):
    """A damaged file or that of another run is named; with the right one in its place the run goes on to the same end."""
    conf = changed(settings, train=dict(record_every=1, iterations=3))
    shutil.copytree(three_runs / "run", tmp_path / "run")
    path, right = tmp_path / "run" / name, (tmp_path / "run" / name).read_bytes()
    if harm == "flipped bit":
        flip(path)
    else:
        path.write_bytes((three_runs / "other" / name).read_bytes() if harm == "of another run" else b"")
    began = []
    with pytest.raises(ValueError, match=f"{path}"):
        train.train(task, model, conf, tmp_path / "run", begin=lambda: began.append(1))
    assert not began
    path.write_bytes(right)
    train.train(task, model, changed(conf, train=dict(iterations=5)), tmp_path / "run")
    assert_same(tmp_path / "run", three_runs / "whole")


def test_what_was_moved_away_is_begun_anew(task, model, settings, unbroken, tmp_path, caplog):
    """Tables and recording are not needed to go on: without them the rest is the same, and the log says what is lost."""
    conf = changed(settings, train=dict(record_every=1, iterations=3))
    train.train(task, model, conf, tmp_path / "run")
    (tmp_path / "run" / "run.h5").write_bytes(b"spoilt")
    with pytest.raises(ValueError, match=r"Move .*run\.h5 away to go on"):
        train.train(task, model, changed(conf, train=dict(iterations=5)), tmp_path / "run")
    for name in ("run.h5", "metrics.csv", "timing.csv"):
        (tmp_path / "run" / name).rename(tmp_path / name)
    train.train(task, model, changed(conf, train=dict(iterations=5)), tmp_path / "run")
    assert rows_of(tmp_path / "run") == rows_of(unbroken)[3:]
    for name in ("run.h5", "metrics.csv", "timing.csv"):
        assert f"{name} is missing" in caplog.text
    with softmpm.Recording(tmp_path / "run" / "run.h5") as recording:
        assert list(recording.episodes) == [3, 4, 5]


def test_a_recording_outlives_a_part_that_records_nothing(task, model, settings, tmp_path):
    """Earlier recordings still belong to the run afterwards."""
    for iterations, every in ((2, 1), (3, 0), (4, 1)):
        conf = changed(settings, train=dict(iterations=iterations, record_every=every))
        train.train(task, model, conf, tmp_path)
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        assert list(recording.episodes) == [0, 1, 3, 4]


@pytest.mark.parametrize("change", ["objective", "regions", "body_length", "goal"])
def test_another_task_does_not_resume(task, model, settings, unbroken, change):
    """Whatever of a task reaches the numbers is part of the run, not its scene alone."""
    other = {
        "objective": Objective(Progress(), Effort(weight=0.5)),
        "regions": task.regions | {"left": np.arange(11)},
        "body_length": 0.5,
        "goal": None,
    }
    with pytest.raises(ValueError, match=rf"task\.{change}.* then, .* now"):
        train.train(dataclasses.replace(task, **{change: other[change]}), model, settings, unbroken)


def test_a_checkpoint_of_something_else_is_refused(task, model, settings, tmp_path):
    """With a hash that is right, but another shape, a part that is missing or of another kind: named, in a sentence."""
    train.train(task, model, changed(settings, train=dict(iterations=2)), tmp_path)
    good = checkpoint.load(tmp_path)
    moments = good["optimizer"]["state"]
    bad = [
        {"iteration": -1},
        {"iteration": "2"},
        {"seals": 7},
        {"best": {"loss": 0.0, "iteration": 1}},
        {"safe": [torch.zeros(3)]},
        {"policy": {}},
        {"learner": None},
        {"about": "[]"},
        {"optimizer": good["optimizer"] | {"state": {k: v | {"exp_avg": torch.zeros(1)} for k, v in moments.items()}}},
    ]  # fmt: skip
    for change in bad:
        checkpoint.save(tmp_path, good | change)
        with pytest.raises(checkpoint.CheckpointError, match=f"the checkpoint in {tmp_path} does not hold"):
            train.train(task, model, settings, tmp_path)
    checkpoint.save(tmp_path, good)
    assert train.train(task, model, settings, tmp_path).finished


@pytest.mark.parametrize("name", [".lock", "metrics.csv.new", "checkpoint.pt", "replay"])
def test_a_folder_with_links_is_refused(task, model, settings, tmp_path, name):
    """Before anything is opened, written or removed where the link leads."""
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "00000000.h5").write_bytes(b"precious")
    (tmp_path / "run").mkdir()
    target = tmp_path / "other" if name == "replay" else tmp_path / "other" / "00000000.h5"
    (tmp_path / "run" / name).symlink_to(target)
    with pytest.raises(ValueError, match=f"{name} is a link"):
        train.train(task, model, settings, tmp_path / "run")
    assert (tmp_path / "other" / "00000000.h5").read_bytes() == b"precious"
    assert len(list((tmp_path / "other").iterdir())) == 1


def test_stops_when_asked_and_goes_on(task, model, settings, unbroken, tmp_path):
    """Asked to stop after two iterations, it returns unfinished; called again, it finishes as if never stopped."""
    done = []
    result = train.train(
        task,
        model,
        settings,
        tmp_path / "out",
        progress=lambda k, row: done.append(k),
        stop=lambda: len(done) == 2,
    )
    assert not result.finished and done == [0, 1]
    result = train.train(task, model, settings, tmp_path / "out")
    assert result.finished and result.best_loss == float(rows_of(unbroken)[-1]["best"])
    assert_same(tmp_path / "out", unbroken)


def test_other_settings_do_not_resume(task, model, settings, unbroken):
    """A checkpoint of other settings is refused, naming each difference; more iterations are welcome."""
    with pytest.raises(ValueError, match=r"policy\.gain: .* then, 0\.5 now"):
        train.train(task, model, changed(settings, policy=dict(gain=0.5)), unbroken)
    assert train.train(task, model, changed(settings, train=dict(iterations=6)), unbroken).finished
    assert len(rows_of(unbroken)) == 6


def test_a_checkpoint_that_is_older_than_a_setting_resumes(task, model, settings, unbroken):
    """It was made with the default of that setting: with the default it goes on, with another value it is refused."""
    old = checkpoint.load(unbroken)
    about = json.loads(old["about"])
    del about["design.strength"], about["design.strength_factor"]
    checkpoint.save(unbroken, old | {"about": json.dumps(about)})
    with pytest.raises(ValueError, match=r"design\.strength: False then, True now"):
        train.train(task, model, changed(settings, design=dict(strength=True)), unbroken)
    assert train.train(task, model, changed(settings, train=dict(iterations=6)), unbroken).finished


def test_inputs_are_designed_like_the_material(task, model, settings, tmp_path):
    """A run that designs the strength lowers the loss by it alone, reports its change, and resumes."""
    alone = dict(young=False, poisson=False, density=False, strength=True)
    conf = changed(settings, design=alone, optimizer=dict(policy_rate=1e-12), policy=dict(gain=1.0))
    conf = changed(conf, observer=dict(name="centroids"), train=dict(iterations=4))
    train.train(task, model, conf, tmp_path)
    result = train.train(task, model, changed(conf, train=dict(iterations=6)), tmp_path)
    found = rows_of(tmp_path)
    assert result.finished and list(found[0])[14:19] == [
        f"{n}_change" for n in ("young", "poisson", "density", "strength")
    ] + ["epochs"]
    assert float(found[0]["strength_change"]) == 0 < float(found[-1]["strength_change"])
    losses = [float(row["loss"]) for row in found]
    assert all(after < before for before, after in itertools.pairwise(losses)), losses
    drawn = design(result.run)
    assert list(drawn)[-1] == "strength of the muscles" and drawn["strength of the muscles"][0].shape == (32,)


def test_a_design_of_stiff_parts_is_drawn_over_that_of_the_scene(task, make_block, settings, tmp_path):
    """Beside the moduli of the parts, ten to one, among which a change of some percent cannot be seen."""
    scene = make_block()
    (body,) = scene.bodies
    stiff = dataclasses.replace(body.material, young=10 * body.material.young)
    halves = [
        softmpm.Body(softmpm.Particles(part, 0.05**2), material)
        for part, material in zip(np.split(body.particles.positions, 2), (body.material, stiff), strict=True)
    ]
    scene = dataclasses.replace(scene, bodies=halves, dt=1e-3)
    conf = changed(settings, observer=dict(name="centroids"))
    model = softmpm.build(scene, device="cpu")
    drawn = design(Run(dataclasses.replace(task, scene=scene), model, conf, tmp_path))
    values, unit = drawn["Young's modulus of the scene"]
    assert unit == "Pa" and values == pytest.approx(np.repeat([1.0, 10.0], 16) * body.material.young)
    values, unit = drawn["Young's modulus, over that of the scene"]
    assert unit == "" and values == pytest.approx(np.ones(32), rel=1e-5)
    assert drawn["density"][1] == "kg/m³" and drawn["density"][0] == pytest.approx(np.ones(32), rel=1e-5)


@pytest.mark.parametrize("observer", ["latent", "centroids", "kmeans"])
@pytest.mark.parametrize("alone", ["policy", "design"])
def test_it_gets_better(task, model, settings, tmp_path, observer, alone):
    """Whatever it observes, gradient descent lowers the crawler's loss from each step to the next, by policy or design alone."""
    longer = dataclasses.replace(task, control_steps=12)
    off = dict(design=dict(enabled=False)) if alone == "policy" else dict(optimizer=dict(policy_rate=1e-12))
    conf = changed(settings, observer=dict(name=observer, clusters=3), learning=dict(every=99), **off)
    train.train(longer, model, changed(conf, train=dict(iterations=8)), tmp_path)
    losses = [float(row["loss"]) for row in rows_of(tmp_path)][1:]  # the encoder learned after the first
    assert all(after < before for before, after in itertools.pairwise(losses)), losses


def test_each_refinement_can_be_switched_off(task, model, settings, tmp_path):
    """Early stopping, replay, target network and the variational term: every switch runs and makes a different run."""
    ends = {}
    switches = ("early_stopping", "replay", "target_network", "variational")
    for switch in ("none", *switches):
        conf = changed(settings, learning={"patience": 1} | ({} if switch == "none" else {switch: False}))
        out = tmp_path / switch
        train.train(task, model, changed(conf, train=dict(iterations=7)), out)
        ends[switch] = [float(r["loss"]) for r in rows_of(out)]
    assert all(ends[s] != ends["none"] for s in switches if s != "early_stopping"), ends


def test_random_goals_are_drawn_anew(task, settings, tmp_path):
    """Each world and iteration has its own goal inside the box; a task without a goal refuses."""
    model = softmpm.build(task.scene, device="cpu", worlds=3)
    conf = changed(settings, train=dict(worlds=3, iterations=2, goal_spread=[0.1, 0.0], record_every=1))
    run = train.Run(task, model, conf, tmp_path)
    goals = torch.stack([run.goals.draw() for _ in range(200)])
    assert goals[..., 0].unique().numel() == 600 and ((goals[..., 0] - 0.6).abs() <= 0.1).all()
    assert goals[..., 0].std() > 0.04 and (goals[..., 1] == 0.3).all()
    assert train.train(task, model, conf, tmp_path / "out").finished
    with pytest.raises(ValueError, match="goal_spread needs a task with a goal"):
        train.Run(dataclasses.replace(task, goal=None), model, conf, tmp_path)
    with pytest.raises(ValueError, match=r"train\.worlds is 1, but the model was built with 3"):
        train.Run(task, model, settings, tmp_path)


def fails(real, at: set[int]):
    """``simulate`` that reports an inverted particle at some of its calls."""
    calls = iter(range(9999))

    def simulate(*args, **kwargs):
        if next(calls) in at:
            raise softmpm.UnstableError(
                "particle 3 is inverted.",
                kind=KIND,
                world=0,
                particle=3,
                substep=1,
                value=-1.0,
                limit="det F > 0",
            )
        return real(*args, **kwargs)

    return simulate


KIND = type("Kind", (), {"name": "INVERTED"})


def test_a_failed_simulation_is_tried_again_from_halfway_back(
    task, model, settings, tmp_path, monkeypatch, caplog
):
    """After a failure policy and design go halfway back to where the last simulation went well; it is counted and logged."""
    conf = changed(settings, observer=dict(name="centroids"), train=dict(iterations=2))
    first = train.train(task, model, changed(conf, train=dict(iterations=1)), tmp_path / "one").run
    halfway = [(p + s) / 2 for p, s in zip(first.parameters, first.safe, strict=True)]
    monkeypatch.setattr(softmpm, "simulate", fails(softmpm.simulate, at={8}))
    second = train.train(task, model, conf, tmp_path / "two").run
    for now, want in zip(second.safe, halfway, strict=True):
        torch.testing.assert_close(now, want.detach(), rtol=1e-6, atol=1e-9)
    assert [r["retries"] for r in rows_of(tmp_path / "two")] == ["0", "1"]
    at = "particle 3 is inverted. In control step 2 of 6, which began at 0.032 s. Going halfway back."
    assert at in caplog.text


def test_a_run_without_a_retry_left_goes_back_to_its_best(
    task, model, settings, tmp_path, monkeypatch, caplog
):
    """Of the whole step and of its half: the policy is that of the best iteration again, and the rates fall as in a fallback."""
    optimizer = dict(retries=1, halving=None)
    conf = changed(settings, observer=dict(name="centroids"), optimizer=optimizer, train=dict(iterations=2))
    first = train.train(task, model, changed(conf, train=dict(iterations=1)), tmp_path / "one").run
    monkeypatch.setattr(softmpm, "simulate", fails(softmpm.simulate, at={8, 9}))
    second = train.train(task, model, conf, tmp_path / "two").run
    for now, want in zip(second.safe, first.safe, strict=True):
        assert torch.equal(now, want)
    assert "In control step 0 of 6, which began at 0 s. The run is going back to iteration 0." in caplog.text
    assert rows_of(tmp_path / "two")[1]["retries"] == "2"
    now, before = (run.optimizer.param_groups[0]["lr"] for run in (second, first))
    assert now == pytest.approx(before * conf.optimizer.fallback_rate)


@pytest.mark.parametrize("above, want", [(math.inf, ("1", "0")), (-100.0, ("0", "1"))])
def test_what_follows_failed_steps_is_counted(task, model, settings, tmp_path, monkeypatch, above, want):
    """A run without a retry left that goes back to its best, or begins anew, does so in the row of that iteration."""
    optimizer = dict(retries=1, restart_above=above)
    conf = changed(settings, observer=dict(name="centroids"), optimizer=optimizer, train=dict(iterations=3))
    monkeypatch.setattr(softmpm, "simulate", fails(softmpm.simulate, at={8, 9}))
    train.train(task, model, conf, tmp_path)
    found = [(row["fallbacks"], row["restarts"]) for row in rows_of(tmp_path)]
    assert found == [("0", "0"), want, ("0", "0")]


@pytest.mark.parametrize("at, iteration", [({0}, 0), (set(range(13, 99)), 2)])
def test_a_run_that_cannot_go_on_names_the_iteration(
    task, model, settings, tmp_path, monkeypatch, at, iteration
):
    """A failure that cannot backtrack ends with the iteration, the particle and advice; the run resumes from before it."""
    conf = changed(settings, optimizer=dict(retries=1))
    monkeypatch.setattr(softmpm, "simulate", fails(softmpm.simulate, at))
    with pytest.raises(
        TrainingError, match=f"iteration {iteration}: particle 3 is inverted. In control"
    ) as caught:
        train.train(task, model, conf, tmp_path)
    assert caught.value.iteration == iteration == checkpoint.load(tmp_path)["iteration"]
    monkeypatch.undo()
    assert train.train(task, model, conf, tmp_path).finished


def test_a_gradient_that_is_not_finite_ends_the_run(task, model, settings, tmp_path, monkeypatch):
    """No step is taken along nan: the error names the iteration and the weights are finite."""
    real = torch.autograd.grad
    monkeypatch.setattr(torch.autograd, "grad", lambda *a, **k: [g * float("nan") for g in real(*a, **k)])
    with pytest.raises(
        TrainingError, match="iteration 0: the loss or the norm of its gradient is not finite"
    ):
        train.train(task, model, settings, tmp_path)
    assert all(t.isfinite().all() for t in checkpoint.load(tmp_path)["policy"].values())


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_is_tried_again_from_halfway_back(
    task, model, settings, tmp_path, monkeypatch, caplog, value
):
    """As a simulation that fails: counted and logged, the step is halved, and the optimiser never sees such a gradient."""
    conf = changed(settings, observer=dict(name="centroids"), train=dict(iterations=2))
    first = train.train(task, model, changed(conf, train=dict(iterations=1)), tmp_path / "one").run
    halfway = [(p + s) / 2 for p, s in zip(first.parameters, first.safe, strict=True)]
    real, calls = torch.autograd.grad, itertools.count()

    def spoilt(*args, **kwargs):
        # The check of the policy has three, an attempt two: of the simulation, of the policy.
        factor = value if next(calls) == 5 else 1.0
        return [gradient * factor for gradient in real(*args, **kwargs)]

    monkeypatch.setattr(torch.autograd, "grad", spoilt)
    second = train.train(task, model, conf, tmp_path / "two").run
    assert next(calls) == 9
    for now, want in zip(second.safe, halfway, strict=True):
        torch.testing.assert_close(now, want.detach(), rtol=1e-6, atol=1e-9)
    assert [r["retries"] for r in rows_of(tmp_path / "two")] == ["0", "1"]
    assert "not finite" in caplog.text and "Going halfway back" in caplog.text
    moments = [v for state in second.optimizer.state.values() for v in state.values()]
    assert all(p.isfinite().all() for p in [*second.parameters, *moments])


def test_clipping_is_counted(task, model, settings, tmp_path):
    """A longer gradient is shortened to max_norm and counted; its full length is what the metrics show."""
    conf = changed(settings, optimizer=dict(max_norm=1e-9), train=dict(iterations=2))
    run = train.train(task, model, conf, tmp_path).run
    length = sum(p.grad.square().sum() for p in run.parameters).sqrt().item()
    assert length == pytest.approx(1e-9, rel=1e-3)
    assert all(r["clipped"] == "1" and float(r["gradient_policy"]) > 1e-6 for r in rows_of(tmp_path))


def test_the_recording_holds_the_run(task, model, settings, tmp_path):
    """First, every second, last (of either part) and best episode are in run.h5, all their frames, and every loss."""
    conf = changed(settings, train=dict(record_every=2))
    train.train(task, model, changed(conf, train=dict(iterations=2)), tmp_path)
    train.train(task, model, conf, tmp_path)
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        assert list(recording.episodes) == [0, 1, 2, 4, 5]
        assert recording.attributes(5)["kind"] == "best"
        frames = recording.frames(4)
        assert len(frames["time"]) == task.control_steps + 1
        iterations, losses = recording.scalars["loss"]
    assert list(iterations) == list(range(5)) and [
        float(r["loss"]) for r in rows_of(tmp_path)
    ] == pytest.approx(losses)


def test_the_last_frame_is_recorded(task, model, settings, tmp_path):
    """Where the frames do not divide the episode too: its end is what a picture and the last words show."""
    steps = task.control_steps
    conf = changed(settings, train=dict(iterations=1, record_every=1, frame_every=steps - 1))
    train.train(task, model, conf, tmp_path)
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        frames = recording.frames(0)
    assert np.allclose(frames["time"], task.control_period * np.array([0, steps - 1, steps]))
    assert np.isfinite(frames["activation"][:2]).all() and np.isnan(frames["activation"][2]).all()


def test_without_replay_a_phase_sees_every_world(task, settings, tmp_path):
    """The buffer has room for the simulations of all iterations between two phases, and takes them."""
    model = softmpm.build(task.scene, device="cpu", worlds=3)
    conf = changed(settings, learning=dict(replay=False, every=2), train=dict(worlds=3))
    run = train.Run(task, model, conf, tmp_path)
    assert run.learner is not None
    assert (run.learner.replay.capacity, run.learner.replay.per_iteration) == (6, 3)


def test_no_learning_without_a_learned_observer(task, model, settings, tmp_path):
    """Centroids need no replay buffer: none is written, and learning columns stay empty."""
    train.train(task, model, changed(settings, observer=dict(name="centroids")), tmp_path)
    assert not (tmp_path / "replay").exists() and all(
        r["replay"] == r["epochs"] == "" for r in rows_of(tmp_path)
    )


@pytest.mark.parametrize("observer", ["untrained", "nothing"])
@pytest.mark.parametrize("clock", [True, False])
def test_what_others_are_compared_with(task, model, settings, tmp_path, observer, clock):
    """A random encoder keeps its weights in learning phases; without a view activations are those of the clock, or constant. Stopped
    and resumed, such a run ends as an unbroken one, recorded and examined."""
    conf = changed(settings, observer=dict(name=observer), policy=dict(name="mlp", hidden=[8], clock=clock))
    conf = changed(conf, train=dict(record_every=4, examine=True))
    first = Run(task, model, conf, tmp_path / "first")
    done = []
    words = dict(progress=lambda k, row: done.append(k), stop=lambda: len(done) == 3)
    assert not train.train(task, model, conf, tmp_path / "run", **words).finished
    result, whole = (train.train(task, model, conf, tmp_path / name) for name in ("run", "whole"))
    assert rows_of(tmp_path / "run") == rows_of(tmp_path / "whole") and result.examination["later"]
    if observer == "untrained":
        assert result.run.learner.phases == 3
        for one in (result.run, whole.run):
            for name, parameter in one.observer.named_parameters():
                assert torch.equal(parameter, dict(first.observer.named_parameters())[name]), name
        return
    assert result.run.learner is None and not (tmp_path / "run" / "replay").exists()
    with softmpm.Recording(tmp_path / "run" / "run.h5") as recording:
        activation = recording.frames(recording.episodes[-1])["activation"][:-1]
    assert bool(np.ptp(activation, axis=0).max() > 1e-3) == clock and abs(activation).max() > 0


def test_old_simulations_leave_the_disk(task, model, settings, tmp_path):
    """The folder holds what the last two checkpoints name, and no more."""
    folder, small = tmp_path / "replay", changed(settings, learning=dict(simulations=2))
    train.train(task, model, small, tmp_path)
    kept = ["00000002.h5", "00000003.h5", "00000004.h5"]
    assert sorted(p.name for p in folder.iterdir()) == kept
    (folder / "00000000.h5").write_bytes(b"a kill before the last one was removed")
    train.train(task, model, small, tmp_path)
    assert sorted(p.name for p in folder.iterdir()) == kept


def test_control_only(task, model, settings, tmp_path):
    """With the design off the materials stay and only the policy has a gradient."""
    conf = changed(
        settings, observer=dataclasses.asdict(ObserverConf(name="centroids")), design={"enabled": False}
    )
    assert not DesignConf(enabled=False).enabled
    train.train(task, model, conf, tmp_path)
    assert all(float(r["young_change"]) == 0 == float(r["gradient_design"]) for r in rows_of(tmp_path))


def test_double_precision(task, settings, tmp_path):
    """A float64 model trains in float64 throughout; its first loss is the float32 one to single precision."""
    model = softmpm.build(task.scene, device="cpu", dtype=torch.float64)
    result = train.train(task, model, settings, tmp_path / "double")
    assert all(p.dtype == torch.float64 for p in result.run.parameters)
    train.train(
        task,
        softmpm.build(task.scene, device="cpu"),
        changed(settings, train=dict(iterations=1)),
        tmp_path / "single",
    )
    double, single = (float(rows_of(tmp_path / name)[0]["loss"]) for name in ("double", "single"))
    assert double != single and double == pytest.approx(single, rel=1e-3)


def test_a_run_that_nobody_uses_is_freed(task, settings, tmp_path):
    """At once, with its model and its loop, whose graph on a GPU is most of a run's memory: nothing waits for Python's collector."""
    run = train.Run(task, softmpm.build(task.scene, device="cpu"), settings, tmp_path)
    runs = Runs([run])
    runs.loop(None)
    seen = [weakref.ref(thing) for thing in (run, runs, runs.loop, runs.loop._graph, run.model)]
    gc.disable()
    try:
        del run, runs
        assert not [thing for ref in seen if (thing := ref()) is not None]
    finally:
        gc.enable()


def test_pictures_can_be_drawn_while_a_run_goes_on(task, model, settings, tmp_path):
    """After each recorded episode there is what it showed, of the first world: the frames of the recording."""
    settings.train.record_every, seen = 2, []

    def sketch(run, iteration, frames):
        seen.append((iteration, frames))

    train.train(task, model, settings, tmp_path, sketch=sketch)
    assert [iteration for iteration, _ in seen] == [0, 2, 4]
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        for row, (_, frames) in zip(recording.episodes, seen, strict=False):
            kept = recording.frames(row)
            for name in ("time", "x", "activation"):
                np.testing.assert_allclose(frames[name], kept[name], rtol=1e-6)


def test_an_episode_that_failed_is_no_picture(task, model, settings, tmp_path, monkeypatch):
    """It was drawn with the number of the iteration before."""
    conf = changed(
        settings, observer=dict(name="centroids"), optimizer=dict(retries=0), train=dict(record_every=1)
    )
    monkeypatch.setattr(softmpm, "simulate", fails(softmpm.simulate, at={8}))
    seen = []
    with pytest.raises(TrainingError, match="iteration 1: particle 3 is inverted"):
        train.train(task, model, conf, tmp_path, sketch=lambda run, iteration, frames: seen.append(iteration))
    assert seen == [0]


@pytest.mark.parametrize("halving, share", [(2.0, 0.25), (None, 1.0)])
def test_rates_fall_by_half_in_so_many_iterations(task, model, settings, tmp_path, halving, share):
    """A quarter is left after four iterations, also of a run that was stopped after the second."""
    optimizer = dataclasses.replace(settings.optimizer, policy_rate=0.02, halving=halving)
    for iterations in (2, 4):
        conf = dataclasses.replace(settings.train, iterations=iterations, examine=False)
        both = dataclasses.replace(settings, optimizer=optimizer, train=conf)
        run = train.train(task, model, both, tmp_path).run
    rates = [group["lr"] for group in run.optimizer.param_groups]
    assert rates == pytest.approx([share * optimizer.policy_rate, share * optimizer.design_rate])
