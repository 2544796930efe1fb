"""Last lines of the log of a run: its outcome, its folder, and the command that shows or continues it."""

import logging
import math
import os
import shutil
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import softmpm
from softmpm_learn import plugins
from softmpm_learn.command.pictures import last_episode
from softmpm_learn.runs.run import Run
from softmpm_learn.storage import sweep
from softmpm_learn.tasks import Task
from softmpm_learn.train import Result

logger = logging.getLogger("softmpm_learn")


def farewell(result: Result, task: Task, out: Path) -> str:
    """Summary of the result; its last line is the command to view the recording or to resume the run."""
    lines = []
    if math.isfinite(result.best_loss):
        what = "evaluation" if result.run.evaluated else "loss"
        best = result.best_iteration
        lines.append(f"Best {what} {result.best_loss:.5g}, in iteration {best}{_outcome(task, out, best)}.")
    if _is_beginning(result.run, result.best_iteration):
        lines.append(
            "Only the first iteration was evaluated, so that is the robot before it learned; train.evaluate_every=1 evaluates each."
        )
    if count := result.run.fallback.count:
        lines.append(f"It failed or fell far below its best and went back to it: {_times(count)}.")
    if count := result.run.restart.count:
        lines.append(f"It got nowhere and began anew: {_times(count)}.")
    if result.examination:
        lines.append(f"Examined: {_examined(result.examination)}.")
    shown = _relative(out)
    if not result.finished:
        lines.append(f"Stopped after {result.run.iteration} iterations.")
    if (out / "run.h5").exists():
        lines.append(f"Everything is in {shown}. To look at the recording: {convert(out)}")
    else:
        lines.append(f"Everything is in {shown}; train.record_every=0, so nothing was recorded.")
    if not result.finished:
        lines.append(f"To go on: {plugins.command()} {plugins.resume(shown)}")
    return "\n".join(lines)


def _is_beginning(run: Run, best: int) -> bool:
    """True if nothing but the beginning could be the best."""
    return run.evaluated and best == 0 and 1 < run.iteration < run.settings.train.evaluate_every


@dataclass(frozen=True)
class Ending:
    """End of the run of a seed, which its process passes to the others."""

    seed: int
    best_loss: float
    evaluated: bool
    """True if ``best_loss`` is that of an evaluation."""
    failed: bool
    finished: bool

    @classmethod
    def of(cls, result: Result) -> "Ending":
        run = result.run
        return cls(
            run.settings.train.seed, result.best_loss, run.evaluated, bool(result.error), result.finished
        )


def farewell_of_seeds(ends: Sequence[Ending], out: Path) -> str:
    """Summary of the seeds of all processes; its last line is what to do next."""
    ends = sorted(ends, key=lambda one: one.seed)
    losses = [one.best_loss for one in ends if math.isfinite(one.best_loss) and not one.failed]
    lines, place = [], _relative(out)
    if losses:
        middle, span = statistics.median(losses), f"{min(losses):.5g} to {max(losses):.5g}"
        what = "evaluations" if ends[0].evaluated else "losses"
        lines.append(f"Best {what} of {len(losses)} seeds: median {middle:.5g}, from {span}.")
    failed = [str(one.seed) for one in ends if one.failed]
    if failed:
        lines.append(f"Failed: seed {', '.join(failed)}.")
    stopped = any(not (one.finished or one.failed) for one in ends)
    has = "; those that have ended have" if stopped else ", and"
    lines.append(f"Each seed has a folder in {place}{has} a row in {place}/{sweep.TABLE}.")
    if failed or stopped:
        lines.append(f"To go on: {plugins.command()} {plugins.resume(place)}")
    return "\n".join(lines)


def _examined(examination: dict[str, float]) -> str:
    """Findings at the end of a run; see examination.py."""
    answers = {name: "none" if math.isnan(value) else f"{value:.3g}" for name, value in examination.items()}
    return ", ".join(f"{name} {answer}" for name, answer in answers.items())


def _outcome(task: Task, out: Path, iteration: int) -> str:
    """Achievement of the robot in an iteration, in words, if the last recorded simulation is that of it."""
    episode = last_episode(out / "run.h5")
    if episode is None or episode[0] != iteration:
        return ""
    words = task.objective.outcome(episode[1]["x"], task.body_length)
    return f"; {words}" if words else ""


def convert(out: Path) -> str:
    """Turn run.h5 into run.rrd; gives the command that opens the recording, or that converts it elsewhere."""
    recording, picture = out / "run.h5", out / "run.rrd"
    try:
        softmpm.to_rerun(recording, picture)
    except OSError as error:
        logger.warning("The run is whole, but not its Rerun file: %s", error)
        return f"python -m softmpm {_relative(recording)} && rerun {_relative(picture)} (once there is room)"
    except ImportError:
        return f"python -m softmpm {_relative(recording)} && rerun {_relative(picture)} (with rerun-sdk)"
    return f"rerun {_relative(picture)}" if shutil.which("rerun") else f"python -m rerun {_relative(picture)}"


def _relative(path: Path) -> str:
    """As short as it can be typed from here."""
    here = os.path.relpath(path)
    return str(path) if here.startswith("..") else here


def _times(count: int) -> str:
    return f"{count} time{'s' if count > 1 else ''}"
