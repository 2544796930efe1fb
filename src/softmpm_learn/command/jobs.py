"""Jobs: a run, or seeds of it side by side, in a folder, with an outcome. Jobs of a sweep go one after another or side by side.

A job that fails is a row of the sweep's table, and the next ones run. The same command goes on: it finds the outcomes in the folders.
"""

import dataclasses
import gc
import logging
import math
import os
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from softmpm_learn import plugins
from softmpm_learn.command import seeds
from softmpm_learn.command.experiment import run_experiment, run_side_by_side
from softmpm_learn.command.sentences import EXPECTED, end, give_up, sentence
from softmpm_learn.command.stop import Signals
from softmpm_learn.config import RunConf
from softmpm_learn.distributed import Group, OtherProcessError, is_lost
from softmpm_learn.runs.runs import shared
from softmpm_learn.storage import files, sweep
from softmpm_learn.storage.checkpoint import LockedError
from softmpm_learn.storage.log_file import log_file
from softmpm_learn.train import Result
from softmpm_learn.training.optimisation import TrainingError

logger = logging.getLogger("softmpm_learn")


class JobError(Exception):
    """A run that failed: the sentence for people, empty where another process has it, and the iterations done before."""

    def __init__(self, text: str = "", iterations: int = 0):
        super().__init__(text)
        self.iterations = iterations

    def outcome(self, about: dict) -> sweep.Outcome:
        """Outcome of a job that failed so; ``about`` as of :attr:`Job.about`."""
        return sweep.Outcome(status="failed", error=str(self), iterations=self.iterations, **about)


class RefusedError(JobError):
    """A run that is another's: its folder is left as it is."""


@dataclass(kw_only=True)
class Job:
    """A job of a sweep."""

    number: int
    settings: str
    """Its settings, as on the command line."""
    out: Path
    table: Path
    """Table of the sweep."""
    conf: RunConf = dataclasses.field(default_factory=RunConf)
    seed: int | None = None
    """Its seed, if it has one and could be configured."""

    @property
    def about(self) -> dict:
        """Its outcome besides the result."""
        return {"job": self.number, "seed": self.seed, "settings": self.settings, "folder": str(self.out)}


def side_by_side(jobs: Sequence[Job]) -> list[list[Job]]:
    """Jobs of one simulation each: with one task on one device and equal in what :func:`softmpm_learn.runs.runs.shared` names."""
    together: list[list[Job]] = []
    for one in jobs:
        room = (
            group
            for group in together
            if _common(group[0]) == _common(one) and len(group) < one.conf.train.side_by_side
        )
        if (group := next(room, None)) is None:
            together.append([one])
        else:
            group.append(one)
    return together


def _common(one: Job) -> tuple:
    return one.conf.task, one.conf.device, shared(one.conf.settings)


def run_jobs(jobs: Sequence[Job], group: Group, signals: Signals, failed: dict[int, Path]) -> list[float]:
    """Jobs of a sweep, side by side if there are several; gives their losses. Only a failure of their own lets the next ones run. If
    several fail together, such as for the settings of one or for want of memory, they go on one after another.
    """
    try:
        results = experiments([(one.conf, one.out) for one in jobs], group, signals)
    except JobError as failure:
        if len(jobs) == 1 or isinstance(failure, RefusedError) or group.size > 1:
            losses = fail(jobs, failure, group, failed)
            if group.size > 1:  # the processes may no longer be in step; the same command goes on
                raise SystemExit(1) from failure
            return losses
        problem = str(failure)
    except (ValueError, OSError) as error:
        give_up(error)
    else:
        losses = [_record(one, own, group, failed) for one, own in zip(jobs, results, strict=True)]
        if None in losses or (signals.wished and group.size == 1):
            logger.info("The same command goes on with the sweep.")
            raise SystemExit(0)
        return [loss for loss in losses if loss is not None]
    logger.warning("Jobs %s failed side by side and go on one after another: %s", _numbers(jobs), problem)
    gc.collect()  # the error and what it came through, the model among it, refer to each other
    return [run_jobs([one], group, signals, failed)[0] for one in jobs]


def outcome(
    conf: RunConf, out: Path, results: Sequence[Result], group: Group, about: dict
) -> sweep.Outcome | None:
    """Outcome of a run or of seeds side by side, None if it was stopped; arguments as of :func:`softmpm_learn.command.seeds.record`."""
    if conf.train.seeds > 1:
        return seeds.record(conf, out, results, group, about)
    return seeds.outcome(results[0], about) if results[0].finished or results[0].error else None


def _record(mine: Job, results: Sequence[Result], group: Group, failed: dict[int, Path]) -> float | None:
    """Write the outcome of a job, unless it was stopped; gives its loss."""
    found = outcome(mine.conf, mine.out, results, group, mine.about)
    if found is None:
        return None
    if found.status == "failed":
        said = found.error if group.first else ""  # all processes know it
        return fail([mine], JobError(said, found.iterations), group, failed)[0]
    _tabulate(mine, found, group)
    return found.loss


def _numbers(jobs: Sequence[Job]) -> str:
    return ", ".join(str(one.number) for one in jobs)


def fail(jobs: Sequence[Job], failure: JobError, group: Group, failed: dict[int, Path]) -> list[float]:
    """Jobs that failed have a row too; gives their losses, which are infinite."""
    if isinstance(failure, RefusedError):
        end(1, str(failure))
    if str(failure):
        print(f"softmpm_learn: job {_numbers(jobs)}: {failure}", file=sys.stderr)
    for mine in jobs:
        failed[mine.number] = mine.table
        _tabulate(mine, failure.outcome(mine.about), group)
    return [math.inf] * len(jobs)


def _tabulate(mine: Job, found: sweep.Outcome, group: Group) -> None:
    if group.first:
        sweep.record(mine.out, found)
        if (mine.out / sweep.TABLE).exists():  # that of its seeds
            sweep.tabulate(mine.out)
        sweep.tabulate(mine.table.parent)


def experiments(jobs: Sequence[tuple[RunConf, Path]], group: Group, signals: Signals) -> list[list[Result]]:
    """The runs of each job; an error leaves its traceback in the folder of the first, from where it happened, and so does the log."""
    out = jobs[0][1]
    with log_file() as begin_log:
        try:
            about = group, signals, lambda: begin_log(out / "softmpm_learn.log")
            found = [run_experiment(*jobs[0], *about)] if len(jobs) == 1 else run_side_by_side(jobs, *about)
            for _, folder in jobs:
                _traceback_of(folder, group).unlink(missing_ok=True)  # of an earlier attempt
            return found
        except Exception as error:
            if isinstance(error, OtherProcessError) or (isinstance(error, TrainingError) and not group.first):
                raise JobError from None
            kind = RefusedError if isinstance(error, LockedError) else JobError
            done = error.iteration if isinstance(error, TrainingError) else _iterations(out)
            raise kind(f"{sentence(error)}{_left(error, out, group)}", done) from error


def _iterations(out: Path) -> int:
    """Iterations of a run that its table has; 0 for seeds side by side, which have tables of their own."""
    try:
        return max(len((out / "metrics.csv").read_text().splitlines()) - 1, 0)
    except OSError:
        return 0


def _traceback_of(out: Path, group: Group) -> Path:
    return out / (f"error.{group.rank}.txt" if group.rank else "error.txt")


def _left(error: Exception, out: Path, group: Group) -> str:
    """Leave the traceback in the folder of the run, unless that or the error is another's; gives a note on its place for people, and on
    the line of theirs that it came from."""
    line = _own_line(error)
    known = isinstance(error, EXPECTED) and not line
    place = _traceback_of(out, group)
    if isinstance(error, LockedError) or is_lost(error):
        return ""
    try:
        files.replace(place, "".join(traceback.format_exception(error)).encode())
    except OSError as other:
        return line if known else f"{line} The traceback could not be saved: {other}"
    return "" if known else f"{line} The traceback is in {place}."


def _own_line(error: BaseException | None) -> str:
    """The last line of a user's file that an error came through, in words; empty if there is none."""
    own, found = set(plugins.files()), ""
    while error is not None:
        for frame in traceback.extract_tb(error.__traceback__):
            if str(Path(frame.filename).resolve()) in own:
                found = f" ({type(error).__name__} in {os.path.relpath(frame.filename)}, line {frame.lineno})"
        error = None if found else error.__cause__ or error.__context__
    return found
