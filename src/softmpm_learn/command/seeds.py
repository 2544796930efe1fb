"""Seeds side by side: the settings, the folder and the outcome of each seed of an experiment."""

import dataclasses
import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from softmpm_learn.config import RunConf
from softmpm_learn.distributed import Group
from softmpm_learn.settings import Settings
from softmpm_learn.storage import sweep
from softmpm_learn.train import Result

Conf = TypeVar("Conf", RunConf, Settings)


def split(conf: Conf) -> list[Conf]:
    """Settings of each seed, with which it would be the same run alone."""
    first = conf.train.seed
    return [
        dataclasses.replace(conf, train=dataclasses.replace(conf.train, seed=first + k, seeds=1))
        for k in range(conf.train.seeds)
    ]


def share(conf: RunConf, out: Path, group: Group) -> list[tuple[RunConf, Path]]:
    """Settings and folder of each seed of this process; of one seed alone, of every process.

    Raises:
        ValueError: There are fewer seeds than processes.
    """
    if conf.train.seeds == 1:
        return [(conf, out)]
    if conf.train.seeds < group.size:
        raise ValueError(
            f"train.seeds must be 1, or at least the {group.size} processes that share the seeds; got {conf.train.seeds}."
        )
    return [(one, folder(out, one.train.seed)) for one in split(conf)[group.rank :: group.size]]


def folder(out: Path, seed: int) -> Path:
    """Folder of a seed that learns beside others."""
    return out / f"{sweep.SEED}{seed}"


def record(
    conf: RunConf, out: Path, results: Sequence[Result], group: Group, about: dict[str, Any]
) -> sweep.Outcome | None:
    """Write the outcome of each seed into its folder, and a table of all into ``out``; gives that of all seeds together, whose loss
    is the median, or None as long as one of them has neither finished nor failed.

    Args:
        results: Those of the seeds of this process.
        about: Job, settings and folder.
    """
    words = about["settings"].split(" ")  # not at all white space, of which a value may have several
    words = [text for text in words if not text.startswith(("train.seed=", "train.seeds="))]
    for result in results:
        seed = result.run.settings.train.seed
        place = folder(out, seed)
        own = {"seed": seed, "folder": str(place), "settings": " ".join([*words, f"train.seed={seed}"])}
        if result.error or result.finished:
            sweep.record(place, outcome(result, about | own))
    stopped = group.any(not all(result.error or result.finished for result in results))
    found = group.broadcast(group.once(_of_all, conf, out, about))
    return None if stopped else found


def _of_all(conf: RunConf, out: Path, about: dict[str, Any]) -> sweep.Outcome:
    """Outcome of all seeds that have one; writes the table."""
    sweep.tabulate(out)
    found = [one for c in split(conf) if (one := sweep.outcome(folder(out, c.train.seed)))]
    done = min((one.iterations for one in found), default=0)
    failed = [one for one in found if one.status == "failed"]
    if failed:
        numbers = ", ".join(str(one.seed) for one in failed)
        problem = (
            f"of {conf.train.seeds} seeds these failed: {numbers}. Seed {failed[0].seed}: {failed[0].error}"
        )
        return sweep.Outcome(status="failed", error=problem, iterations=done, **about)
    loss = statistics.median([one.loss for one in found] or [math.inf])
    return sweep.Outcome(status="finished", loss=loss, iterations=done, **about)


def outcome(result: Result, about: dict[str, Any]) -> sweep.Outcome:
    """Outcome of a run that has finished or failed."""
    if result.error:
        return sweep.Outcome(
            status="failed", error=str(result.error), iterations=result.run.iteration, **about
        )
    about = (
        about | {"iteration": result.best_iteration, "iterations": result.run.iteration} | result.examination
    )
    return sweep.Outcome(status="finished", loss=result.best_loss, **about)


def median_loss(results: Sequence[Result]) -> float:
    """The median of the best losses, infinite for a run that failed."""
    return statistics.median(math.inf if result.error else result.best_loss for result in results)
