"""Learning in the loop (2019): optimise by the gradient of whole simulations, learn from what they showed, and again.

for each iteration:
    optimise   simulate in closed loop, then step policy and design along the gradient of the loss,
               which passes through every substep, every activation and every encoder evaluation
    learn      every few iterations: train the autoencoder on the grid velocity of past simulations,
               and let the target network, which the policy uses, follow it
    save       metrics, recording, and every so many iterations a checkpoint

Runs with different seeds may go side by side in one simulation (see :mod:`softmpm_learn.runs.runs`). Or several processes may share the
worlds of one run (see :mod:`softmpm_learn.distributed`); the first of them alone learns, from the pictures of all, and saves. To learn
the same everywhere would take a replay buffer in each process, and bits that agree between GPUs.
"""

import contextlib
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from softmpm import Model
from softmpm_learn.distributed import Group
from softmpm_learn.learning.phase import learn_side_by_side
from softmpm_learn.loggers import Loggers
from softmpm_learn.modes import plain_torch
from softmpm_learn.runs.resuming import entered, resume
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.settings import Settings
from softmpm_learn.tasks.task import Task
from softmpm_learn.training.finishing import evaluate_ends, finish
from softmpm_learn.training.optimisation import optimise
from softmpm_learn.training.run_files import RunFiles
from softmpm_learn.training.threads import at_once
from softmpm_learn.training.timing import TIMING, clock


@dataclass(frozen=True)
class Result:
    """State of a run at its end."""

    run: Run
    """Observer, policy, design and learner as they are now."""
    finished: bool
    """False if it was stopped before the last iteration, or failed."""
    best_loss: float
    best_iteration: int
    examination: dict[str, float]
    """Findings of :func:`softmpm_learn.training.examination.examine`, in the first process once the run is finished."""
    seconds: dict[str, float]
    """Of its parts in this process since it began or was resumed, by the names of :mod:`softmpm_learn.training.timing`."""
    error: Exception | None = None
    """Why it failed: a :class:`softmpm_learn.training.optimisation.TrainingError`."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A run to begin, or to go on with."""

    settings: Settings
    out: Path
    """Folder for checkpoint.pt, metrics.csv, timing.csv, run.h5 and replay/."""
    begin: Callable[[], None] = lambda: None
    """Called once, in the first process only, when the folder is locked and what is in it was found to be of this run."""
    sketch: Callable[[Run, int, dict], None] = lambda run, iteration, frames: None
    """Called in the first process after an iteration whose episode was recorded, with its number and the frames."""
    loggers: Loggers | None = None
    """Those of ``settings.train.log``, for a caller who has pictures for them at the end and closes them then; None: they are made here
    and closed with the training."""


@dataclass
class _Work:
    """State of the training loop."""

    runs: Runs
    plans: Sequence[Plan]
    files: list[RunFiles]
    """One for each run in the first process, none in the others."""
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TIMING, 0.0))
    """Those of the parts of this iteration."""
    passed: Counter = field(default_factory=Counter)
    """Those of the iterations that have ended."""


def train(
    task: Task,
    model: Model,
    settings: Settings,
    out: str | Path,
    *,
    progress: Callable[[int, dict[str, float]], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
    begin: Callable[[], None] = lambda: None,
    group: Group | None = None,
    finer: Task | None = None,
    sketch: Callable[[Run, int, dict], None] = lambda run, iteration, frames: None,
) -> Result:
    """Optimise a robot; goes on where the checkpoint in ``out`` ends, if there is one.

    On a CPU the metrics of a run that was killed and resumed equal those of an unbroken one, to the last bit.

    Args:
        model: Built from ``task.scene`` with ``task.build`` and ``settings.train.worlds`` worlds, or this process's share of them.
            Evaluations of a walker and examinations build further models likewise.
        out, begin, sketch: See :class:`Plan`.
        progress: Called after each iteration with its number and metrics; in the first process only.
        stop: Asked after each iteration; once it says True in any process the run is saved and ends, ready to resume.
        group: The processes that share the worlds, None for this one alone. Any number of them can resume a run.
        finer: The task on the next finer grid, on which the motion is examined; None leaves that out.

    Raises:
        softmpm_learn.training.optimisation.TrainingError: A simulation or a gradient failed, in whichever process; names the iteration.
        softmpm_learn.distributed.OtherProcessError: The first process cannot go on, and says why.
        ValueError: A model of another scene; settings that do not go together, or with the checkpoint; a file in ``out`` that is a
            link, damaged or of another run.
        softmpm_learn.storage.checkpoint.CheckpointError: Every checkpoint in ``out`` is damaged.
        softmpm_learn.storage.checkpoint.LockedError: Another run writes to ``out``.
    """
    plan = Plan(settings=settings, out=Path(out), begin=begin, sketch=sketch)
    shown = (lambda rows: [progress(*row) for row in rows.values()]) if progress else None
    (result,) = train_side_by_side(task, model, [plan], progress=shown, stop=stop, group=group, finer=finer)
    if result.error:
        raise result.error
    return result


@plain_torch()
def train_side_by_side(
    task: Task,
    model: Model,
    plans: Sequence[Plan],
    *,
    progress: Callable[[dict[int, tuple[int, dict[str, float]]]], object] | None = None,
    stop: Callable[[], bool] = lambda: False,
    group: Group | None = None,
    finer: Task | None = None,
) -> list[Result]:
    """Optimise a robot several times in one simulation, with the results that :func:`train` gives one after another, up to rounding.

    A run that fails has an error in its result, and the others go on. Arguments and errors are those of :func:`train`, but for:

    Args:
        model: Built with ``settings.train.worlds`` worlds for each plan.
        plans: Their settings differ only in what :class:`softmpm_learn.runs.runs.Runs` allows.
        progress: Called after each iteration with (iteration, metrics) of each run that goes on, by its number.
        group: Of several processes only if there is one plan.
    """
    group = group or Group()
    if any(plan.settings.train.seeds != 1 for plan in plans):
        raise ValueError(
            "train.seeds must be 1 in the settings of a run; softmpm_learn.command.seeds.split gives those of each seed."
        )
    if len(plans) > 1 and group.size > 1:
        raise ValueError(
            "several processes share the worlds of one run, or each of them has runs of its own."
        )
    with contextlib.ExitStack() as held:
        for plan in plans:
            group.once(lambda plan=plan: held.enter_context(entered(plan.out)))
        with group.fail_together():
            runs = Runs([Run(task, model, plan.settings, plan.out, group, len(plans)) for plan in plans])
        seals = [resume(run, plan.out) for run, plan in zip(runs.all, plans, strict=True)]
        own = [
            plan.loggers or held.enter_context(Loggers(plan.settings.train.log, plan.out)) for plan in plans
        ]
        files = [
            group.once(
                lambda r=run, p=plan, s=seal, o=one: held.enter_context(RunFiles(r, p.out, s, p.begin, o))
            )
            for run, plan, seal, one in zip(runs.all, plans, seals, own, strict=True)
        ]
        work = _Work(runs, plans, [one for one in files if one is not None])
        return _loop(work, progress, stop, finer)


def _loop(work: _Work, progress, stop: Callable[[], bool], finer: Task | None) -> list[Result]:
    runs, group, seconds = work.runs, work.runs.group, work.seconds
    while runs.active and not group.any(stop()):
        rows, observations = optimise(runs, work.files, seconds)
        with clock(seconds, "learn"):
            learn(runs, rows, observations)
        ended = {k: (runs.all[k].iteration, row) for k, row in rows.items()}
        _end_iteration(work, ended)
        if progress and group.first and rows:
            progress(ended)
        with clock(seconds, "draw"):
            for k in ended if work.files else ():  # a run that failed may have frames, but of no iteration
                if work.files[k].frames:
                    work.files[k].flush()
                    work.plans[k].sketch(runs.all[k], ended[k][0], work.files[k].take_frames())
    _save_all(work)
    with clock(seconds, "end"):
        ends = evaluate_ends(runs)
    _save_all(work)  # with what became of the best
    with clock(seconds, "end"):
        found = finish(runs, work.files, finer, ends) if work.files else {}
    work.passed.update(seconds)
    return [
        Result(
            run,
            finished=k not in runs.errors and run.iteration >= run.settings.train.iterations,
            best_loss=run.best["loss"],
            best_iteration=run.best["iteration"],
            examination=found.get(k, {}),
            seconds=dict(work.passed),
            error=runs.errors.get(k),
        )
        for k, run in enumerate(runs.all)
    ]


def _end_iteration(work: _Work, ended: dict[int, tuple[int, dict[str, float]]]) -> None:
    """End an iteration of some runs: rows of the tables, new sums of the times, then the checkpoints that are due."""
    runs, group = work.runs, work.runs.group
    files = {k: work.files[k] for k in ended} if work.files else {}
    with group.fail_together():
        at_once(lambda k: files[k].add(*ended[k], work.seconds), files)
    work.passed.update(work.seconds)
    work.seconds.clear()
    work.seconds |= dict.fromkeys(TIMING, 0.0)
    for k in ended:
        runs.all[k].iteration += 1
    _save(work, [k for k, one in files.items() if one.is_due])


def _save_all(work: _Work) -> None:
    """Write the checkpoints of the runs that are not saved as they are."""
    _save(work, [k for k, one in enumerate(work.files) if not one.is_saved])


def _save(work: _Work, numbers: Collection[int]) -> None:
    """Write the checkpoints of some runs."""
    with clock(work.seconds, "save"), work.runs.group.fail_together():
        at_once(lambda k: work.files[k].save(), numbers)


def learn(runs: Runs, rows: dict[int, dict[str, float]], observations: Tensor | None) -> None:
    """Add the observations to the replay buffers and run the learning phases that are due; in the first process alone.

    Adds their figures to the rows of metrics.csv.
    """
    if observations is None:
        return
    pictures, due = runs.group.gather(observations, dim=1), []
    with runs.group.fail_together():
        if pictures is not None:
            at_once(lambda k: add_observations(runs, k, pictures), rows)
    for k, row in rows.items():
        run = runs.all[k]
        if run.learner is None:
            continue
        row["replay"] = len(run.learner.replay.ids)
        every = run.settings.learning.every
        if (run.iteration == 0 or (run.iteration + 1) % every == 0) and not run.settles:
            due.append((run.learner, row))
    learned = runs.group.once(learn_side_by_side, [learner for learner, _ in due]) or [{}] * len(due)
    for (learner, row), figures in zip(due, learned, strict=True):
        row |= figures
        runs.group.broadcast_(t for network in learner.networks for t in network.state_dict().values())


def add_observations(runs: Runs, k: int, pictures: Tensor) -> None:
    """Add those of a run, of the observations of all worlds."""
    run = runs.all[k]
    if run.learner is not None:
        first = run.iteration * run.settings.train.worlds
        run.learner.add_observations(first, runs.observations(k, pictures))
