"""Lasting: motions with known speeds and tilts, and the best of a run, which is one that lasts."""

import csv
import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

import softmpm
from softmpm_learn.episode import run_episode
from softmpm_learn.lasting import Lasting
from softmpm_learn.objective import Path, Progress, Tilt
from softmpm_learn.runs.loops import Evaluator
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.tasks import ArmConf, BipedConf, ElephantConf, make_task
from softmpm_learn.train import train
from softmpm_learn.training.evaluation import evaluate

T, PERIOD = 2.0, 0.25
"""Length of an episode and time between two states [s]."""
REST = np.array([(0.0, 0.0), (2.0, 0.1), (0.0, 0.2), (0.0, 0.5), (2.0, 0.3), (2.0, 0.8)])
"""Two soles, the hind and the front part of a robot that is not level at rest [m]."""
LASTING = Lasting(
    progress=Progress(particles=np.array([0, 1]), begin=5.0),
    tilt=Tilt(front=np.array([4, 5]), back=np.array([2, 3]), rest=REST),
    seconds=T,
)
LASTS = {
    (1.0, 1.0, 1.0, 1.0): True,
    (0.0, 1.0, 0.71, 0.71): True,
    (0.0, 1.0, 0.69, 0.69): False,
    (0.0, 1.0, 0.38, 1.04): True,
    (0.0, 1.0, 0.34, 1.04): False,
    (9.0, 0.1, 0.1, 0.1): True,
    (9.0, 0.0, 1.0, 1.0): False,
    (9.0, -1.0, -0.5, -0.5): False,
    (0.0, 0.0, 0.0, 0.0): False,
}
"""Whether a motion lasts, by its speeds from 0 to T/2, to T, to 2T and to 3T [m/s]."""


def path_of(speeds, tilts=0.0) -> Path:
    """Soles with these speeds, shape (world, 4), under a body that goes the other way and tilts [degrees], shape (state, world)."""
    parts = np.repeat(np.array(speeds).T, [4, 4, 8, 8], axis=0)
    way = PERIOD * np.concatenate([0 * parts[:1], parts]).cumsum(axis=0)
    rise = 2.0 * np.tan(np.radians(np.broadcast_to(tilts, way.shape)))
    moved = np.stack([way[..., None] * [1, 1, -1, -1, -1, -1], rise[..., None] * [0, 1, 0, 0, 1, 1]], axis=-1)
    x = torch.from_numpy(REST + moved).float()
    other = torch.zeros(x.shape[1], len(REST), 2, 2)
    states = [softmpm.State(one, torch.zeros_like(one), other, other) for one in x]
    return Path(PERIOD * np.arange(len(x)), states, torch.zeros(len(parts), len(speeds), 1))


def test_a_motion_that_lasts_keeps_its_speed():
    """At least 0.7 of that in the second half of the episode, in the mean after it and of the particles that count; forward."""
    assert LASTING(path_of(list(LASTS))).tolist() == list(LASTS.values())


def test_a_motion_that_lasts_does_not_tip_over():
    """Not even for an instant of the episode or after it, to neither side."""
    angles, instants = (29.0, -29.0, 31.0, -31.0), (1, 12, 24)
    tilts = np.zeros((25, 12))
    for world, (angle, instant) in enumerate(itertools.product(angles, instants)):
        tilts[instant, world] = angle
    assert LASTING(path_of(np.ones((12, 4)), tilts)).tolist() == [True] * 6 + [False] * 6


def test_the_best_lasts_if_any_does(task, model, settings, tmp_path):
    """Then it has the lowest loss; what is not known is never kept."""
    run, kept = Run(task, model, settings, tmp_path), []
    found = [
        *((math.nan, True, -1), (math.inf, True, -1), (-1.0, False, 2), (-2.0, False, 3), (-1.5, False, 3)),
        *((-0.1, True, 5), (-3.0, False, 5), (0.0, True, 5), (-0.2, True, 8), (-math.inf, True, 8)),
    ]
    for k, (loss, lasts, _) in enumerate(found):
        run.iteration = k
        for weights in run.policy.parameters():
            torch.nn.init.constant_(weights, k)
        run.keep(loss, lasts)
        kept.append(run.best["iteration"])
    assert kept == [best for *_, best in found] and (run.best["loss"], run.best["lasts"]) == (-0.2, True)
    assert all((weights == 8).all() for weights in run.best["policy"].values())


@pytest.fixture
def judge(monkeypatch):
    """Makes the answers of each simulation those of a list, for each world one from either start; gives that and the lengths of the
    motions [s]."""
    answers, lengths = [], []

    def answer(self, path: Path) -> torch.Tensor:
        lengths.append(path.times[-1])
        return torch.tensor(answers.pop(0))

    monkeypatch.setattr(Lasting, "__call__", answer)
    return answers, lengths


def rows_of(task, settings, out, **conf) -> dict[str, list[float]]:
    """Columns of metrics.csv of a run of two worlds that gets farther with every evaluation, which is every other iteration."""
    observer = dataclasses.replace(settings.observer, name="centroids")
    optimizer = dataclasses.replace(settings.optimizer, policy_rate=0.1)
    conf = dataclasses.replace(settings.train, worlds=2, evaluate_every=2, **conf)
    settings = dataclasses.replace(settings, observer=observer, optimizer=optimizer, train=conf)
    train(task, softmpm.build(task.scene, device="cpu", worlds=2), settings, out)
    with open(out / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name] or "nan") for row in rows] for name in rows[0]}


def test_the_best_of_a_run_lasts(task, settings, tmp_path, judge):
    """In all worlds, from all starts, over three episodes: it gives way to the next one that lasts, and not to those between."""
    answers, lengths = judge
    lasts = [True] * 4
    answers += [lasts, lasts, [True, True, True, False], lasts, lasts]
    found = rows_of(dataclasses.replace(task, lasting=LASTING), settings, tmp_path, endurance=3)
    assert found["lasts"] == pytest.approx([1, 0, math.nan, 1, math.nan], nan_ok=True)
    first, between, _, last, _ = found["evaluation"]
    assert max(last, between) < first and found["best"] == [first, first, first, last, last]
    assert lengths == pytest.approx([3 * task.seconds] * (2 + 1 + 2))


@pytest.mark.parametrize("spread, evaluated", [([], []), ([0.2, 0.1], [0, 1, 3])])
def test_a_single_episode_is_not_asked_to_last(
    task, settings, tmp_path, judge, monkeypatch, spread, evaluated
):
    """At random goals each evaluation counts as one that lasts and starts from rest only, and at a fixed one there is none."""
    starts, real = [], Evaluator.__call__

    def start(self, goal, kicks):
        starts.extend(kicks)
        return real(self, goal, kicks)

    monkeypatch.setattr(Evaluator, "__call__", start)
    conf = dict(endurance=1, goal_spread=spread, evaluation_goals=2)
    found = rows_of(dataclasses.replace(task, lasting=LASTING), settings, tmp_path, **conf)
    assert {k: v for k, v in enumerate(found["lasts"]) if not math.isnan(v)} == dict.fromkeys(evaluated, 1)
    assert judge == ([], []) and starts == [0.0] * len(evaluated)


def test_the_best_of_a_checkpoint_from_before_lasts(task, model, settings, tmp_path):
    """One that says that it does not is believed, and one of a run that had none is none."""
    run = Run(task, model, settings, tmp_path)
    other = Run(task, model, settings, tmp_path / "none")
    other.load_state_dict(run.state_dict() | {"best": {"loss": math.inf, "iteration": -1}})
    assert not other.best["lasts"]
    run.keep(-1.0, lasts=False)
    run.iteration = 1
    content = run.state_dict()
    before = {name: value for name, value in content["best"].items() if name != "lasts"}
    for best, lasts in ((before, True), (content["best"], False)):
        other = Run(task, model, settings, tmp_path / str(lasts))
        other.load_state_dict(content | {"best": best})
        assert other.best["lasts"] is lasts and other.best["loss"] == -1.0


@pytest.mark.parametrize("conf", [BipedConf, ElephantConf])
def test_walkers_should_last(conf):
    """After as many seconds as are simulated, by the terms that they learn from; an arm need not."""
    task = make_task(conf(seconds=1.01))
    progress, _, tilt, _ = task.objective.terms
    assert task.lasting.progress is progress and task.lasting.tilt is tilt
    assert task.lasting.seconds == task.seconds != 1.01
    assert make_task(ArmConf()).lasting is None


SPEEDS = 0.0, 0.05, -0.05, 0.025
"""Those of the starts: of every evaluation the first two, of what would be the best all [m/s]."""


def losses_of(runs: Runs) -> list[float]:
    """Loss of the first run with each of these starts, simulated without the evaluator."""
    task, (params, inputs), losses = runs.task, runs.design(), []
    longer = dataclasses.replace(task, control_steps=3 * task.control_steps)
    for speed in SPEEDS:
        start = runs.model.rest()
        start.v[..., 0] += speed
        about = dict(inputs=inputs, start=start)
        episode = run_episode(longer, runs.model, runs.observer, runs.policy, params, **about)
        losses.append(episode.loss[0].item())
    return losses


def runs_of(task, model, settings, out, count: int = 1) -> Runs:
    """Runs, with weights of their own, whose motions should last."""
    settings = dataclasses.replace(settings, train=dataclasses.replace(settings.train, endurance=3))
    task = dataclasses.replace(task, lasting=LASTING)
    each = [
        dataclasses.replace(settings, train=dataclasses.replace(settings.train, seed=k)) for k in range(count)
    ]
    return Runs([Run(task, model, one, out / str(k), runs=count) for k, one in enumerate(each)])


@pytest.mark.parametrize("known, count", [(-math.inf, 2), (math.inf, 4)])
@pytest.mark.parametrize("failing", range(5))
def test_the_worst_start_counts(task, model, settings, tmp_path, judge, known, count, failing):
    """An evaluation has the largest of the losses from its starts, and a motion lasts that does from all of them: from two, and from
    four if it would be the best by the first two."""
    judge[0].extend([[k != failing for k in pair] for pair in ((0, 1), (2, 3))])
    runs = runs_of(task, model, settings, tmp_path)
    runs.all[0].motions.best |= {"loss": known, "lasts": not math.isfinite(known) and known < 0}
    losses, found = losses_of(runs), evaluate(runs, [0])[0]
    assert found.loss == pytest.approx(max(losses[:count]), rel=2e-5) and found.lasts == (failing >= count)
    assert len(judge[1]) == count // 2 and min(map(abs, np.diff(sorted(losses)))) > 1e-5


def test_a_motion_that_fails_from_a_further_start_is_no_best(task, model, settings, tmp_path, judge, caplog):
    """It would be the best by its first two starts; the run keeps what it had, and the log says why."""
    judge[0].extend([[True, True]] * 2)
    runs = runs_of(task, model, settings, tmp_path)
    evaluator, count = runs.evaluator, itertools.count()

    def fails(goal, kicks):
        found = Evaluator.__call__(evaluator, goal, kicks)
        if next(count) == 1:
            what = dict(kind="inverted", world=1, particle=3, substep=1, value=-1.0, limit="det F > 0")
            evaluator.failures.errors.append(softmpm.UnstableError("particle 3 is inverted.", **what))
        return found

    fails.starts, fails.further, fails.at_once = evaluator.starts, evaluator.further, evaluator.at_once
    fails.failures = evaluator.failures
    runs.evaluator = fails
    found = evaluate(runs, [0])[0]
    failed = "the evaluation failed, from a start with 0.025 m/s: particle 3 is inverted"
    assert math.isinf(found.loss) and failed in caplog.text
    runs.all[0].keep(found.loss, found.lasts)
    assert runs.all[0].best["iteration"] == -1 and next(count) == 2


def test_each_world_has_its_goal_from_every_start(task, settings, tmp_path, judge):
    """Of goals that are drawn: the worst of the means over the goals, as simulated one start after another."""
    judge[0].append([True] * 4)
    model = softmpm.build(task.scene, device="cpu", worlds=2)
    train = dict(worlds=2, goal_spread=[0.2, 0.1], evaluation_goals=2)
    settings = dataclasses.replace(settings, train=dataclasses.replace(settings.train, **train))
    runs = runs_of(task, model, settings, tmp_path)
    runs.all[0].motions.best |= {"loss": -math.inf, "lasts": True}
    (goals,), (params, inputs), losses = runs.evaluation_goals(), runs.design(), []
    longer = dataclasses.replace(task, control_steps=3 * task.control_steps)
    for order in (goals, goals.flip(0)):
        for speed in SPEEDS[:2]:
            start = model.rest()
            start.v[..., 0] += speed
            about = dict(inputs=inputs, start=start, goal=order)
            losses.append(run_episode(longer, model, runs.observer, runs.policy, params, **about).loss)
    assert evaluate(runs, [0])[0].loss == pytest.approx(
        max(one.mean().item() for one in losses[:2]), rel=2e-5
    )
    apart = torch.stack(losses[:2]) - torch.stack(losses[2:])  # another goal is another loss
    assert apart.abs().min() > 1e-4 * losses[0].abs().max()


def test_models_of_evaluations_are_as_deterministic_as_the_run_s(task, settings, tmp_path):
    for deterministic in (False, True):
        model = softmpm.build(task.scene, device="cpu", deterministic=deterministic)
        run = Run(task, model, settings, tmp_path / str(deterministic))
        assert run.model_of(task, 2).deterministic is deterministic


def test_further_starts_are_a_run_s_own(task, settings, tmp_path, judge):
    """Of two side by side, one that would be the best is evaluated as if it were alone, and so is the other."""
    model = softmpm.build(task.scene, device="cpu", worlds=2)
    judge[0].extend([[True] * 4, [False, True, False, True]])
    runs = runs_of(task, model, settings, tmp_path, count=2)
    runs.all[1].motions.best |= {"loss": -math.inf, "lasts": True}
    losses, found = losses_of(runs), evaluate(runs, [0, 1])
    assert found[0].loss == pytest.approx(max(losses), rel=1e-5) and not found[0].lasts and found[1].lasts
    runs.all[0].motions.best |= {"loss": -math.inf, "lasts": True}
    judge[0].append([True] * 4)
    assert evaluate(runs, [0, 1])[1] == found[1]


def test_a_motion_that_is_not_worth_it_need_not_last(task, settings, model, tmp_path):
    """A robot that trembles forward lasts, but a far one that does not is better."""
    optimizer = dataclasses.replace(settings.optimizer, restart_above=-0.1)
    run = Run(task, model, dataclasses.replace(settings, optimizer=optimizer), tmp_path)
    kept = []
    for loss, lasts in ((-0.05, True), (-1.0, False), (-0.2, True)):
        run.keep(loss, lasts)
        kept.append((run.best["loss"], run.best["lasts"]))
    assert kept == [(-0.05, False), (-1.0, False), (-0.2, True)]
