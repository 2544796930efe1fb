"""Learning in the loop (2019): optimise by the gradient of whole simulations, learn from what they showed, and again.

for each iteration:
    optimise   simulate in closed loop, then step policy and design along the gradient of the loss,
               which passes through every substep, every activation and every encoder evaluation
    learn      every few iterations: train the autoencoder on the grid velocity of past simulations,
               and let the target network, which the policy uses, follow it
    save       metrics, recording, checkpoint

Several processes may share the worlds (see :mod:`softmpm_learn.distributed`); the first of them alone learns, from the pictures of
all, and saves. To learn the same everywhere would take a replay buffer in each process, and bits that agree between GPUs.
"""

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from softmpm import Model
from softmpm_learn import checkpoint, files
from softmpm_learn.distributed import Group
from softmpm_learn.episode import run_episode
from softmpm_learn.examination import examine
from softmpm_learn.loggers import Loggers
from softmpm_learn.optimisation import clock, optimise
from softmpm_learn.replay import ReplayError
from softmpm_learn.run import Run, SettingsError
from softmpm_learn.run_logger import TIMING, RunLogger
from softmpm_learn.settings import Settings

logger = logging.getLogger("softmpm_learn")


@dataclass(frozen=True)
class Result:
    """State of a run at its end."""

    run: Run
    """Observer, policy, design and learner as they are now."""
    finished: bool
    """False if it was stopped before the last iteration."""
    best_loss: float
    best_iteration: int
    examination: dict[str, float]
    """What :func:`softmpm_learn.examination.examine` found, in the first process once the run is finished."""


def train(
    task,
    model: Model,
    settings: Settings,
    out: str | Path,
    *,
    progress: Callable[[int, dict[str, float]], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
    begin: Callable[[], None] = lambda: None,
    group: Group | None = None,
    finer=None,
    sketch: Callable[[Run, int, dict], None] = lambda run, iteration, frames: None,
    loggers: Loggers | None = None,
) -> Result:
    """Optimise a robot; goes on where the checkpoint in ``out`` ends, if there is one.

    On a CPU the metrics of a run that was killed and resumed equal those of an unbroken one, to the last bit.

    Args:
        task: A :class:`softmpm_learn.tasks.task.Task`.
        model: Built from ``task.scene`` with ``settings.train.worlds`` worlds, or with this process's share of them.
        out: Folder for checkpoint.pt, metrics.csv, timing.csv, run.h5 and replay/.
        progress: Called after each iteration with its number and metrics; in the first process only.
        stop: Asked after each iteration; once it says True in any process the run ends, ready to resume.
        begin: Called once, in the first process only, when the folder is locked and what is in it was found to be of this run.
        group: The processes that share the worlds, None for this one alone. Any number of them can resume a run.
        finer: The task on the next finer grid, on which the motion is examined; None leaves that out.
        sketch: Called in the first process after an iteration whose episode was recorded, with its number and the frames.
        loggers: Those of ``settings.train.log``, for a caller who has pictures for them at the end and closes them then; None closes
            them here.

    Raises:
        softmpm_learn.optimisation.TrainingError: A simulation or a gradient failed, in whichever process; names the iteration.
        softmpm_learn.distributed.OtherProcessError: The first process cannot go on, and says why.
        ValueError: Settings that do not go together, or with the checkpoint; a file in ``out`` that is a link, damaged or of another
            run.
        softmpm_learn.checkpoint.CheckpointError: Every checkpoint in ``out`` is damaged.
        softmpm_learn.checkpoint.LockedError: Another run writes to ``out``.
    """
    out = Path(out)
    group = group or Group()
    with contextlib.ExitStack() as held:
        group.once(lambda: held.enter_context(_entered(out)))
        with group.fail_together():
            run = Run(task, model, settings, out, group)
        seals = _resume(run, out)
        own = loggers or held.enter_context(Loggers(settings.train.log, out))
        run_logger = group.once(lambda: held.enter_context(RunLogger(run, out, seals, begin, own)))
        return _loop(run, run_logger, progress, stop, finer, sketch)


@contextlib.contextmanager
def _entered(out: Path) -> Iterator[None]:
    """The folder is there, has no links in it, and no other run writes to it."""
    with files.named("make the folder", out):
        out.mkdir(parents=True, exist_ok=True)
    files.check_folder(out)
    with checkpoint.locked(out):
        yield


def _resume(run: Run, out: Path) -> dict:
    """Go on where the checkpoint ends, if there is one; the replay buffer is for the first process. Gives what the checkpoint knows of
    the other files.
    """
    group = run.group
    content = group.broadcast(group.once(lambda: checkpoint.load(out) if checkpoint.exists(out) else None))
    if content is None:
        return {}
    with group.fail_together():
        seals = _restore(run, content, out)
    logger.info("Going on after iteration %d of %s.", run.iteration, out)
    return seals


def _restore(run: Run, content: dict, out: Path) -> dict:
    try:
        if content["learner"] and not run.group.first:
            content["learner"]["replay"] = {}
        run.load_state_dict(content)
        return dict(content["seals"])
    except SettingsError as error:
        raise SettingsError(
            f"the checkpoint in {out} was {error}; config.yaml and command line must be those of the run."
        ) from error
    except ReplayError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, RuntimeError) as error:
        text = " ".join(str(error).split())
        raise checkpoint.CheckpointError(
            f"the checkpoint in {out} does not hold this run: {text}."
        ) from error


def _loop(run: Run, run_logger: RunLogger | None, progress, stop, finer, sketch) -> Result:
    group, last, seconds = run.group, run.settings.train.iterations, dict.fromkeys(TIMING, 0.0)
    examination: dict[str, float] = {}
    while run.iteration < last and not group.any(stop()):
        k = run.iteration
        row, observations = optimise(run, run_logger, seconds)
        with clock(seconds, "learn"):
            row |= learn(run, observations)
        with group.fail_together():
            if run_logger:
                run_logger.add(k, row, seconds)
        run.iteration += 1
        with clock(seconds, "save"), group.fail_together():
            if run_logger:
                run_logger.save()
        if progress and group.first:
            progress(k, row)
        if run_logger and run_logger.frames:
            sketch(run, k, run_logger.take_frames())
    if run.iteration >= last and run_logger and run.best["iteration"] >= 0:
        examination = finish(run, run_logger, finer)
    return Result(run, run.iteration >= last, run.best["loss"], run.best["iteration"], examination)


def learn(run: Run, observations: Tensor | None) -> dict[str, float]:
    """Add the observations to the replay buffer and run a learning phase if one is due; in the first process alone.

    Returns its figures for metrics.csv.
    """
    if run.learner is None or observations is None:
        return {}
    pictures = run.group.gather(observations, dim=1)
    with run.group.fail_together():
        if pictures is not None:
            run.learner.add_observations(run.iteration * run.settings.train.worlds, pictures)
    row: dict[str, float] = {"replay": len(run.learner.replay.ids)}
    if run.iteration == 0 or (run.iteration + 1) % run.settings.learning.every == 0:
        row |= run.group.once(run.learner.learn) or {}
        run.group.broadcast_(t for network in run.learner.networks for t in network.state_dict().values())
    return row


@torch.no_grad()
def finish(run: Run, run_logger: RunLogger, finer) -> dict[str, float]:
    """Record the best policy and design once more, as the episode after the last, and examine them."""
    now, found = run.policy_snapshot(), {}
    run.load_policy(run.best)
    params, inputs = run.design()
    with run_logger.record(run.iteration, of=run.best["iteration"], kind="best") as on_frame:
        run_episode(
            run.task,
            run.model,
            run.observer,
            run.policy,
            params,
            inputs=inputs,
            goal=run.middle_goals(),
            on_frame=on_frame,
        )
    if run.settings.train.examine:
        found = examine(run, finer)
        run_logger.add_figures(run.iteration, found)
    run.load_policy(now)
    return found
