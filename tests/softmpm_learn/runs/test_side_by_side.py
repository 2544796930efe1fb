"""Seeds side by side: each is the run that it would be alone."""

import contextlib
import gc
import itertools
import math
import re
import signal
from pathlib import Path

import forked
import numpy as np
import pytest
import torch
from learners import changed, metrics
from torch import nn

import softmpm
from softmpm import rollout
from softmpm_learn import register
from softmpm_learn.command.seeds import split
from softmpm_learn.episode import run_episode
from softmpm_learn.observe import Observer, VelocityImage
from softmpm_learn.observer_check import probe
from softmpm_learn.runs.loops import ClosedLoop
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.settings import Settings, TrainConf
from softmpm_learn.storage import checkpoint
from softmpm_learn.train import Plan, Result, train, train_side_by_side
from softmpm_learn.training import optimisation
from softmpm_learn.training.optimisation import TrainingError

HERE = Path(__file__).parent
SEEDS = 3
CLOSE = 1e-9


def three_seeds(settings: Settings) -> Settings:
    """Three seeds of the crawler with a network as policy and every particle's material designed."""
    return changed(settings, policy=dict(name="mlp", hidden=[8]), train=dict(seeds=SEEDS, seed=4))


@pytest.fixture
def conf(settings) -> Settings:
    return three_seeds(settings)


def built(task, conf: Settings, runs: int = 1, device: str = "cpu") -> softmpm.Model:
    return softmpm.build(task.scene, device=device, dtype=torch.float64, worlds=runs * conf.train.worlds)


def alone(task, conf: Settings, out: Path, finer=None) -> list[Result]:
    """Each seed in a simulation of its own, in ``out/K``."""
    return [
        train(task, built(task, one), one, out / str(k), finer=finer) for k, one in enumerate(split(conf))
    ]


def together(task, conf: Settings, out: Path, device: str = "cpu", **options) -> list[Result]:
    """All seeds in one simulation, in ``out/K``."""
    plans = [Plan(settings=one, out=out / str(k)) for k, one in enumerate(split(conf))]
    return train_side_by_side(task, built(task, conf, len(plans), device), plans, **options)


def assert_same(folder: Path, want: Path, tolerance: float = CLOSE) -> None:
    """Metrics, weights, encoder, moments, best and random streams agree."""
    rows = metrics(folder)
    assert len(rows) == len(metrics(want))
    for row, other in zip(rows, metrics(want), strict=True):
        assert row == pytest.approx(other, rel=tolerance, abs=tolerance, nan_ok=True)
    now, then = checkpoint.load(folder), checkpoint.load(want)
    assert torch.equal(now["goals"], then["goals"]) and now["iteration"] == then["iteration"]
    assert now["about"] == then["about"] and now["best"]["iteration"] == then["best"]["iteration"]
    for part in ("policy", "design", "safe"):
        torch.testing.assert_close(now[part], then[part], rtol=tolerance, atol=tolerance)
    close = dict(rtol=1e-6, atol=1e-6) if tolerance == CLOSE else dict(rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(now["optimizer"]["state"], then["optimizer"]["state"], **close)
    if then["learner"]:
        for part in ("autoencoder", "target"):
            torch.testing.assert_close(
                now["learner"][part], then["learner"][part], rtol=tolerance, atol=tolerance
            )


CASES = {
    "latent": dict(),
    "two worlds": dict(train=dict(seeds=SEEDS, worlds=2, goal_spread=[0.2, 0.1], evaluation_goals=4, evaluate_every=2)),
    "centroids": dict(observer=dict(name="centroids"), design=dict(per="region", strength=True)),
    "control only": dict(design=dict(enabled=False), policy=dict(name="knots"), observer=dict(name="kmeans", clusters=3)),
    "posture": dict(observer=dict(posture=True)),
    "untrained": dict(observer=dict(name="untrained"), policy=dict(clock=False)),
    "nothing": dict(observer=dict(name="nothing")),
    "constant": dict(observer=dict(name="nothing"), policy=dict(clock=False)),
    "no target": dict(learning=dict(target_network=False, variational=False)),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_three_seeds_side_by_side_are_three_runs(task, conf, tmp_path, case):
    """Five iterations with learning phases: metrics and weights agree to 1e-9, whatever is observed, designed or drawn."""
    conf = changed(conf, **CASES[case])
    results = together(task, conf, tmp_path / "together")
    learners = [result.run.learner for result in results]
    seeds = [f"seed {conf.train.seed + k}" for k in range(SEEDS)]
    assert [learner.name for learner in learners if learner] in (seeds, [])  # for the log
    alone(task, conf, tmp_path / "alone")
    losses = [metrics(tmp_path / "together" / str(k))[-1]["loss"] for k in range(SEEDS)]
    assert len(set(losses)) == SEEDS
    for k in range(SEEDS):
        assert_same(tmp_path / "together" / str(k), tmp_path / "alone" / str(k))


MIXED = (
    dict(),
    dict(observer=dict(name="centroids"), policy=dict(clock=False)),
    dict(observer=dict(name="untrained"), design=dict(enabled=False)),
    dict(learning=dict(epochs=2, every=3), policy=dict(hidden=[4])),
    dict(observer=dict(name="kmeans", clusters=2), policy=dict(name="linear")),
    dict(observer=dict(name="nothing")),
    dict(observer=dict(posture=True)),
    dict(train=dict(seed=5), optimizer=dict(policy_rate=1e-2)),
)
"""Runs that differ in all that runs side by side may differ in."""


def mixed(conf: Settings, out: Path) -> list[Plan]:
    conf = changed(conf, train=dict(seeds=1, record_every=2, worlds=2, goal_spread=[0.2, 0.1]))
    return [Plan(settings=changed(conf, **change), out=out / str(k)) for k, change in enumerate(MIXED)]


def test_runs_of_many_kinds_side_by_side_are_single_runs(task, conf, tmp_path):
    """Observers, policies, designs and learning phases that differ: metrics, weights and recordings agree with those of each alone."""
    plans = mixed(conf, tmp_path / "together")
    train_side_by_side(task, built(task, plans[0].settings, len(plans)), plans)
    for k, plan in enumerate(mixed(conf, tmp_path / "alone")):
        train(task, built(task, plan.settings), plan.settings, plan.out)
        assert_same(tmp_path / "together" / str(k), plan.out)
        with (
            softmpm.Recording(plan.out / "run.h5") as want,
            softmpm.Recording(tmp_path / "together" / str(k) / "run.h5") as found,
        ):
            frames, others = found.frames(4), want.frames(4)
            assert frames.keys() == others.keys()
            assert all(
                np.allclose(frames[name], others[name], rtol=1e-5, atol=1e-6, equal_nan=True)
                for name in frames
            )


def test_what_one_kind_has_in_common_is_computed_at_once(task, conf, tmp_path, monkeypatch):
    """Encoders of three latents, policies of four, and the picture of all four but the one that shows the posture."""
    plans, real, seen = mixed(conf, tmp_path), VelocityImage.__call__, []
    model = built(task, plans[0].settings, len(plans))
    runs = Runs([Run(task, model, plan.settings, plan.out, runs=len(plans)) for plan in plans])
    assert sorted(len(stack.modules) for stack in runs.stacks) == sorted([3, 1, 1, 1, 1, 1] + [4, 1, 1, 1, 1])
    monkeypatch.setattr(VelocityImage, "__call__", lambda *given: seen.append(1) or real(*given))
    runs.observer(model, model.rest())
    assert len(seen) == 2


def test_weights_are_evaluated_at_once(task, conf, tmp_path):
    """Policies and encoders are batched, and a change of one run in place is what the batched evaluation sees."""
    model = built(task, conf, SEEDS)
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    assert [stack.batched for stack in runs.stacks] == [True, True]
    before = runs.loop(None)[0].loss
    with torch.no_grad():
        for p in runs.all[1].policy.parameters():
            p.add_(0.1)
    after = runs.loop(None)[0].loss
    assert torch.equal(before[[0, 2]], after[[0, 2]]) and before[1] != after[1]


def test_finished_seeds_are_recorded_and_examined(task, conf, tmp_path):
    """The answers of an examination and the recorded motion of each seed are those of its run alone."""
    conf = changed(
        conf, observer=dict(name="centroids"), train=dict(seeds=SEEDS, examine=True, record_every=2)
    )
    found = together(task, conf, tmp_path / "together", finer=task)
    want = alone(task, conf, tmp_path / "alone", finer=task)
    for k, (one, other) in enumerate(zip(found, want, strict=True)):
        assert one.finished and one.examination == pytest.approx(other.examination, rel=1e-6, nan_ok=True)
        assert one.examination["finer"] == pytest.approx(1.0, rel=1e-6)
        folders = [tmp_path / name / str(k) / "run.h5" for name in ("together", "alone")]
        with softmpm.Recording(folders[0]) as a, softmpm.Recording(folders[1]) as b:
            assert list(a.episodes) == list(b.episodes) == [0, 2, 4, 5]
            for name in ("x", "activation"):
                np.testing.assert_allclose(a.frames(5)[name], b.frames(5)[name], rtol=1e-5, atol=1e-6)


def test_what_equal_observers_see_is_computed_once_though_it_is_rounded(task, conf, tmp_path, monkeypatch):
    """On a GPU two equal pictures differ by rounding, which depends on the order of sums."""
    model, real = built(task, conf, SEEDS), VelocityImage.__call__
    seen, generator = [], torch.Generator().manual_seed(1)

    def rounded(self, model, state):
        seen.append(1)
        picture = real(self, model, state)
        return picture * (1 + 1e-14 * torch.randn(picture.shape, generator=generator, dtype=picture.dtype))

    monkeypatch.setattr(VelocityImage, "__call__", rounded)
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    seen.clear()
    runs.observer.observe(model, model.rest())
    assert len(seen) == 1


OWN = [
    *(dict(observer=dict(name=name)) for name, entry in register.OBSERVERS.items() if entry.is_own),
    *(dict(policy=dict(name=name)) for name, entry in register.POLICIES.items() if entry.is_own),
    *(dict(policy=dict(name="mlp", clock=False)), dict(learning=dict(target_network=False))),
]
"""Every observer and every policy of the package."""


@pytest.mark.parametrize("change", OWN, ids=str)
def test_what_the_package_has_is_evaluated_at_once(task, conf, tmp_path, change):
    """Seeds of each observer see once and are batched with their policies, goals drawn at random included."""
    conf = changed(conf, train=dict(seeds=SEEDS, goal_spread=[0.2, 0.1]), **change)
    model = built(task, conf, SEEDS)
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    assert len(runs.observer._eyes) == 1
    assert [(len(stack.modules), stack.batched) for stack in runs.stacks] == [(SEEDS, True), (SEEDS, True)]


# Failures


def diverges(monkeypatch, seed: int, iterations: set[int], forever: bool) -> None:
    """Simulations of a seed fail at the start of some iterations, once or always, as long as its robot moves."""
    real, failed = softmpm.simulate, set()

    def simulate(model, state, activation, *args, **kwargs):
        for k, run in enumerate(RUNS):
            worlds = model.worlds // len(RUNS)
            moves = bool(activation[:, k * worlds : (k + 1) * worlds].abs().max() > 0)
            due = run.settings.train.seed == seed and run.iteration in iterations and moves
            if due and (forever or run.iteration not in failed) and run.model is model:
                failed.add(run.iteration)
                what = dict(kind="inverted", particle=3, substep=1, value=-1.0, limit="det F > 0")
                raise softmpm.UnstableError("particle 3 is inverted.", world=k * worlds, **what)
        return real(model, state, activation, *args, **kwargs)

    monkeypatch.setattr(softmpm, "simulate", simulate)
    optimise = optimisation.optimise

    def noted(runs, *args):
        RUNS[:] = runs.all
        return optimise(runs, *args)

    monkeypatch.setattr("softmpm_learn.train.optimise", noted)


RUNS: list[Run] = []


def test_a_retry_of_one_seed_leaves_the_others_as_they_are(task, conf, tmp_path, monkeypatch, caplog):
    """It goes halfway back as it would alone; the others neither count a retry nor change."""
    conf = changed(conf, observer=dict(name="centroids"))
    diverges(monkeypatch, seed=5, iterations={2}, forever=False)
    together(task, conf, tmp_path / "together")
    monkeypatch.undo()
    diverges(monkeypatch, seed=5, iterations={2}, forever=False)
    alone(task, conf, tmp_path / "alone")
    for k in range(SEEDS):
        assert_same(tmp_path / "together" / str(k), tmp_path / "alone" / str(k))
        retries = [row["retries"] for row in metrics(tmp_path / "together" / str(k))]
        assert retries == ([0, 0, 1, 0, 0] if k == 1 else [0] * 5)
    among, single = (text for text in caplog.messages if text.endswith("Going halfway back."))
    assert among.startswith("Iteration 2 of seed 5: ") and "World 1 is world 0 of seed 5." in among
    assert single.startswith("Iteration 2: ")


def test_seeds_that_fail_in_one_simulation_go_back_at_once(task, conf, tmp_path, monkeypatch):
    """One more simulation serves every seed that failed."""
    conf, calls = changed(conf, observer=dict(name="centroids")), []
    real = ClosedLoop.__call__

    def counted(self, goal, on_frames=None):
        calls.append(1)
        with pytest.MonkeyPatch.context() as patch:
            if len(calls) == 3:
                fails_in((0, 2), patch)
            return real(self, goal, on_frames)

    monkeypatch.setattr(ClosedLoop, "__call__", counted)
    together(task, conf, tmp_path)
    retries = [[row["retries"] for row in metrics(tmp_path / str(k))] for k in range(SEEDS)]
    assert retries == [[0, 0, 1, 0, 0], [0] * 5, [0, 0, 1, 0, 0]]
    assert len(calls) == 5 + 1


def fails_in(worlds: tuple[int, ...], monkeypatch) -> None:
    """Simulations in which these worlds fail at once, where failures are collected."""
    real = softmpm.simulate

    def simulate(*args, failures=None, **kwargs):
        for world in worlds if failures is not None and not failures else ():
            what = dict(kind="inverted", particle=3, substep=1, value=-1.0, limit="det F > 0")
            failures.errors.append(softmpm.UnstableError(f"world {world} is inverted.", world=world, **what))
        return real(*args, **kwargs)

    monkeypatch.setattr(softmpm, "simulate", simulate)


def test_seeds_that_fail_are_all_known(task, conf, tmp_path, monkeypatch):
    """Each has an error of its own."""
    model = built(task, conf, SEEDS)
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    fails_in((2, 0), monkeypatch)
    with pytest.raises(softmpm.UnstableError, match="world 2 is inverted"):
        runs.loop(None)
    assert {k: str(error) for k, error in runs.failed(runs.loop.errors).items()} == {
        k: f"world {k} is inverted." for k in (0, 2)
    }


def test_a_best_motion_that_fails_when_it_is_recorded_ends_no_run(task, conf, tmp_path, monkeypatch, caplog):
    """On a GPU it may, since sums have another order each time. The warning says whose it was, and the recording is whole."""
    real = run_episode

    def failing(*args, **kwargs):
        with pytest.MonkeyPatch.context() as patch:
            fails_in((1,), patch)
            return real(*args, **kwargs)

    monkeypatch.setattr("softmpm_learn.training.finishing.run_episode", failing)
    conf = changed(conf, observer=dict(name="centroids"), train=dict(record_every=1))
    assert all(result.finished for result in together(task, conf, tmp_path))
    assert "The best of seed 5 failed when it was recorded: world 1 is inverted." in caplog.text
    for k in range(SEEDS):
        with softmpm.Recording(tmp_path / str(k) / "run.h5") as recording:
            assert recording.attributes(recording.episodes[-1])["kind"] == "best"


def test_an_error_that_was_dealt_with_keeps_no_states(task, conf, tmp_path, monkeypatch):
    """Many runs side by side fill a GPU, so two simulations at a time do not fit: the failed one is freed with its error."""
    model = built(task, conf, SEEDS)
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    fails_in((2,), monkeypatch)
    gc.collect()
    gc.disable()
    try:
        with contextlib.suppress(softmpm.UnstableError):
            runs.loop(None)
        assert not [one for one in gc.get_objects() if type(one) is rollout.Trail]
    finally:
        gc.enable()


def test_a_world_that_failed_has_no_activation(task, conf, tmp_path, monkeypatch):
    """The others have theirs."""
    model, frames = built(task, conf, SEEDS), []
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    fails_in((1,), monkeypatch)
    about = dict(failures=softmpm.Failures("reset"), on_frame=frames.append)
    with torch.no_grad():
        episode = run_episode(task, model, runs.observer, runs.policy, runs.design()[0], **about)
    own = [frame.activation.abs().amax(dim=1) for frame in frames if frame.activation is not None]
    assert all(one > 0 for one in own[0]) and all(one[1] == 0 and one[0] > 0 for one in own[1:])
    assert torch.equal(episode.activation[1:, 1], torch.zeros_like(episode.activation[1:, 1]))


def test_a_seed_that_fails_ends_alone(task, conf, tmp_path, monkeypatch):
    """Its result has the error, its folder what was done before; the others are those of runs alone. Resumed, it is tried again."""
    conf = changed(conf, optimizer=dict(retries=1))
    alone(task, conf, tmp_path / "alone")
    diverges(monkeypatch, seed=5, iterations={2}, forever=True)
    first, failed, last = together(task, conf, tmp_path / "together")
    assert isinstance(failed.error, TrainingError) and failed.error.iteration == 2 and not failed.finished
    assert "iteration 2: particle 3 is inverted." in str(failed.error)
    assert first.finished and last.finished and first.error is None
    for k in (0, 2):
        assert_same(tmp_path / "together" / str(k), tmp_path / "alone" / str(k))
    assert len(metrics(tmp_path / "together" / "1")) == 2
    monkeypatch.undo()
    assert all(result.finished for result in together(task, conf, tmp_path / "together"))
    for k in range(SEEDS):
        assert_same(tmp_path / "together" / str(k), tmp_path / "alone" / str(k))


def test_a_robot_at_rest_has_the_material_of_the_scene(task, conf, tmp_path):
    """And no activation, so that a seed that failed cannot fail again; the worlds of the others are as before."""
    model = built(task, conf, SEEDS)
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    with torch.no_grad():
        for run in runs.all:
            for p in run.parameters:
                p.add_(0.3)
    before, params = runs.loop(None)[0], runs.design()[0]
    with torch.no_grad():
        for p in runs.all[1].parameters:
            p.fill_(math.nan)
    runs.move([0, 2])
    episode, gradients = runs.loop(None)
    assert (episode.activation[:, 1] == 0).all() and torch.equal(
        episode.activation[:, 0], before.activation[:, 0]
    )
    torch.testing.assert_close(runs.design()[0].young[1], model.params().young, rtol=1e-12, atol=0)
    assert torch.equal(runs.design()[0].young[[0, 2]], params.young[[0, 2]])
    assert all(g.isfinite().all() for k in (0, 2) for g in runs.split(gradients)[k])
    assert episode.loss.isfinite().all()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_gradient_that_is_not_finite_is_that_of_one_seed(task, conf, tmp_path, monkeypatch, value):
    """Its step is halved, those of the others are not."""
    conf = changed(conf, observer=dict(name="centroids"), train=dict(seeds=SEEDS, iterations=3))
    alone(task, conf, tmp_path / "alone")
    real, calls = Runs.split, itertools.count()

    def spoilt(runs, gradients):
        parts = real(runs, gradients)
        if next(calls) == 1:
            parts[1][0] = value * torch.ones_like(parts[1][0])
        return parts

    monkeypatch.setattr(Runs, "split", spoilt)
    together(task, conf, tmp_path / "together")
    assert [[row["retries"] for row in metrics(tmp_path / "together" / str(k))] for k in range(SEEDS)] == [
        [0, 0, 0],
        [0, 1, 0],
        [0, 0, 0],
    ]
    for k in (0, 2):
        assert_same(tmp_path / "together" / str(k), tmp_path / "alone" / str(k))


# Resuming


@pytest.fixture(scope="module")
def whole(task, make_settings, tmp_path_factory) -> Path:
    """Folder of the three seeds, undisturbed."""
    out = tmp_path_factory.mktemp("whole")
    together(task, three_seeds(make_settings()), out)
    return out


@pytest.mark.parametrize("nth", [0, 7, 8, 11])
def test_killed_between_two_checkpoints_it_goes_on(task, conf, whole, tmp_path, monkeypatch, nth):
    """Seeds may then be at different iterations; resumed, all end as they would have, to the last bit."""
    real, count = checkpoint.save, itertools.count()

    def dies(*args):
        if next(count) == nth:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(checkpoint, "save", dies)
    with pytest.raises(KeyboardInterrupt):
        together(task, conf, tmp_path / "killed")
    monkeypatch.undo()
    assert all(result.finished for result in together(task, conf, tmp_path / "killed"))
    for k in range(SEEDS):
        assert_same(tmp_path / "killed" / str(k), whole / str(k))
        one, other = (folder / str(k) / "metrics.csv" for folder in (tmp_path / "killed", whole))
        assert one.read_bytes() == other.read_bytes()


def together_till(number: int, task, conf: Settings, out: Path) -> None:
    """:func:`together` in a process that kills itself when it calls the simulator for this time."""
    forked.kill_at_simulation(number)
    together(task, conf, out)


def test_a_killed_process_resumes(task, conf, whole, tmp_path):
    """Killed by SIGKILL within an iteration, in the folder of a seed too, the seeds end as those that were not."""
    ends = [forked.exit_code(together_till, n, task, conf, tmp_path / "killed") for n in (9, 999)]
    assert ends == [-signal.SIGKILL, 0]
    for k in range(SEEDS):
        assert_same(tmp_path / "killed" / str(k), whole / str(k))


def test_a_seed_goes_on_alone(task, conf, tmp_path):
    """The folder of a seed is that of a run."""
    conf = changed(conf, train=dict(seeds=SEEDS, iterations=3))
    together(task, conf, tmp_path / "together")
    longer = changed(conf, train=dict(seeds=SEEDS, iterations=5))
    one = split(longer)[1]
    assert train(task, built(task, one), one, tmp_path / "together" / "1").finished
    alone(task, longer, tmp_path / "alone")
    assert_same(tmp_path / "together" / "1", tmp_path / "alone" / "1")


# Modules of a user


class Stubborn(nn.Module):
    """A policy that :func:`torch.vmap` cannot batch: it reads a number."""

    def __init__(self, size: int, muscles: int):
        super().__init__()
        self.layer = nn.Linear(size, muscles)

    def forward(self, z, time, goal=None):
        return torch.tanh(self.layer(z) * (1.0 if float(self.layer.weight.detach().sum()) < 1e9 else 2.0))


class Tuned(Stubborn):
    """One with a number of its own that is no weight."""

    def __init__(self, size: int, muscles: int):
        super().__init__(size, muscles)
        self.factor = torch.rand(()).item()

    def forward(self, z, time, goal=None):
        return torch.tanh(self.factor * self.layer(z))


class Delayed(Stubborn):
    """One with a number of its own that does not matter late in an episode."""

    def __init__(self, size: int, muscles: int):
        super().__init__(size, muscles)
        self.begin = 0.05 * torch.rand(()).item()

    def forward(self, z, time, goal=None):
        return torch.tanh(self.layer(z)) * ((time - self.begin) / 0.02).clamp(0.0, 1.0)[..., None]


@pytest.mark.parametrize("kind", [Stubborn, Tuned, Delayed])
def test_policies_that_cannot_be_batched_are_evaluated_in_turn(task, conf, tmp_path, monkeypatch, kind):
    """With the same values."""
    monkeypatch.setattr(register.POLICIES, "_entries", dict(register.POLICIES._all()))
    register.policy("odd")(lambda conf, space: kind(space.features, space.muscles))
    conf = changed(conf, policy=dict(name="odd"))
    model = built(task, conf, SEEDS)
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    assert [stack.batched for stack in runs.stacks] == [True, False]
    together(task, conf, tmp_path / "together")
    alone(task, conf, tmp_path / "alone")
    for k in range(SEEDS):
        assert_same(tmp_path / "together" / str(k), tmp_path / "alone" / str(k))


class Posture(Observer):
    """Random projections of displacements forward and up: numbers that are no buffers. The probe shows nothing of them."""

    size = 3

    def __init__(self, model: softmpm.Model, scale: float):
        super().__init__()
        self.rest, self.scale, self.seen = model.positions, scale, SEEN
        self.directions = torch.randn(model.positions.numel(), self.size, dtype=model.dtype)

    def observe(self, model, state):
        self.seen.append(1)
        return (state.x - self.rest).clamp(min=0.0).flatten(1) @ self.directions / self.scale

    def encode(self, observation):
        return observation


SEEN: list[int] = []


def test_observers_that_differ_where_the_probe_does_not_look(task, conf, tmp_path, monkeypatch):
    """An option and what is drawn from the seed: each run is what it is alone. What is equal in both is computed once."""
    monkeypatch.setattr(register.OBSERVERS, "_entries", dict(register.OBSERVERS._all()))
    register.observer("posture")(lambda conf, model, task, *, scale=0.1: Posture(model, scale))
    conf = changed(conf, observer=dict(name="posture"), train=dict(seeds=1, iterations=3))
    options = dict(observer=dict(name="posture", options=dict(scale=0.3)))
    changes = (dict(), options, dict(train=dict(seed=5)), dict(policy=dict(hidden=[4])))
    plans = [Plan(settings=changed(conf, **one), out=tmp_path / str(k)) for k, one in enumerate(changes)]
    model = built(task, conf, len(plans))
    runs = Runs([Run(task, model, plan.settings, plan.out, runs=len(plans)) for plan in plans])
    SEEN.clear()
    runs.observer.observe(model, model.rest())
    assert len(SEEN) == 3
    train_side_by_side(task, model, plans)
    for k, plan in enumerate(plans):
        train(task, built(task, conf), plan.settings, tmp_path / "alone" / str(k))
        assert_same(plan.out, tmp_path / "alone" / str(k))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_probe_is_a_motion_of_every_part_in_its_box(task, dtype):
    """All four tensors differ from world to world; F is the gradient of the places, C that of the velocity."""
    worlds = 3
    model = softmpm.build(task.scene, device="cpu", dtype=getattr(torch, dtype), worlds=worlds)
    state, rest = probe(model), model.rest()
    low, high = rest.x.amin(dim=(0, 1)), rest.x.amax(dim=(0, 1))
    assert bool(((state.x >= low) & (state.x <= high)).all())
    assert bool((torch.linalg.det(state.F) > 0.5).all())
    for part, still in zip(state[:4], rest[:4], strict=True):
        moved = (part - still).flatten(1)
        assert bool((moved.abs().amax(dim=1) > 1e-3).all()) and torch.pdist(moved).min() > 1e-3
    x, y = task.scene.bodies[0].particles.positions.T
    for axis, (near, far) in enumerate(((x == x[8], x == x[16]), (y == y[1], y == y[3]))):
        step = rest.x[0, far, axis].mean() - rest.x[0, near, axis].mean()
        for value, slope in ((state.x, state.F), (state.v, state.C)):
            got = (value[:, far] - value[:, near]) / step
            middle = (slope[:, far] + slope[:, near])[..., axis] / 2
            assert (got - middle).abs().max() < 0.1 * middle.abs().max()


# Settings


def test_rates_may_differ(task, conf, tmp_path):
    """A sweep over rates goes side by side as well; what is part of the simulation may not differ."""
    conf = changed(conf, observer=dict(name="centroids"), train=dict(seeds=1, iterations=3))
    rates = [changed(conf, optimizer=dict(policy_rate=rate)) for rate in (1e-3, 1e-2)]
    model = built(task, conf, 2)
    plans = [Plan(settings=one, out=tmp_path / f"rate{k}") for k, one in enumerate(rates)]
    train_side_by_side(task, model, plans)
    for k, one in enumerate(rates):
        train(task, built(task, one), one, tmp_path / str(k))
        assert_same(tmp_path / f"rate{k}", tmp_path / str(k))
    other = changed(conf, optimizer=dict(fade=0.1))
    plans = [Plan(settings=one, out=tmp_path / f"fade{k}") for k, one in enumerate((conf, other))]
    with pytest.raises(ValueError, match=r"runs side by side share optimizer\.fade; here it is inf and 0\.1"):
        train_side_by_side(task, model, plans)


def test_the_code_of_the_docs_sweeps_over_rates(task, conf, tmp_path):
    """Two rates give two runs, each with its own rate."""
    text, names = (HERE.parents[2] / "docs" / "learning.md").read_text(), {}
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "Plan(" in block)
    exec(code, names)
    conf = changed(conf, observer=dict(name="centroids"), train=dict(seeds=1, iterations=2))
    results = names["sweep_over_rates"](task, conf, tmp_path, [1e-3, 1e-2])
    assert [result.run.settings.optimizer.policy_rate for result in results] == [1e-3, 1e-2]
    assert all(result.finished for result in results) and (tmp_path / "0.01" / "checkpoint.pt").exists()


def test_the_number_of_seeds_is_checked(task, settings, tmp_path):
    """At least one; the settings of one run have one."""
    with pytest.raises(ValueError, match=r"train\.seeds must be > 0, got 0"):
        TrainConf(seeds=0)
    with pytest.raises(ValueError, match=r"train\.seeds must be 1 in the settings of a run"):
        train(task, built(task, settings), changed(settings, train=dict(seeds=2)), tmp_path)
    one, two = split(changed(settings, train=dict(seeds=2, seed=7)))
    assert [(c.train.seed, c.train.seeds) for c in (one, two)] == [(7, 1), (8, 1)]


@pytest.mark.gpu
@pytest.mark.parametrize("observer", ["latent", "untrained", "nothing"])
def test_seeds_go_through_one_captured_graph(task, conf, tmp_path, observer):
    """On a GPU the closed loop of all seeds is one CUDA graph, and they are the runs that they would be alone."""
    conf = changed(conf, observer=dict(name=observer), train=dict(seeds=SEEDS, iterations=5))
    model = built(task, conf, SEEDS, "cuda")
    runs = Runs([Run(task, model, one, tmp_path / str(k), runs=SEEDS) for k, one in enumerate(split(conf))])
    first = [runs.loop(None)[0].loss.clone() for _ in range(3)]
    assert runs.loop._graph._graph is not None
    torch.testing.assert_close(first[0], first[2], rtol=CLOSE, atol=CLOSE)
    with torch.no_grad():
        for p in runs.all[1].policy.parameters():
            p.add_(0.1)
    assert runs.loop(None)[0].loss[1] != first[2][1]
    together(task, conf, tmp_path / "together", "cuda")
    for k, one in enumerate(split(conf)):
        train(task, built(task, one, device="cuda"), one, tmp_path / "alone" / str(k))
        assert_same(tmp_path / "together" / str(k), tmp_path / "alone" / str(k), tolerance=1e-7)


@pytest.mark.gpu
def test_runs_of_many_kinds_go_through_one_captured_graph(task, conf, tmp_path):
    """Those that differ in observer, policy, design and learning phases are on a GPU, too, what they would be alone."""
    plans = mixed(conf, tmp_path / "together")
    train_side_by_side(task, built(task, plans[0].settings, len(plans), "cuda"), plans)
    for k, plan in enumerate(mixed(conf, tmp_path / "alone")):
        train(task, built(task, plan.settings, device="cuda"), plan.settings, plan.out)
        assert_same(tmp_path / "together" / str(k), plan.out, tolerance=1e-7)
