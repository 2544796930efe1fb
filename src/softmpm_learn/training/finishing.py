"""The end of a training: the best motion of each run is evaluated and recorded once more, and examined."""

import contextlib
import logging
import math
from collections.abc import Iterator, Sequence

import torch

from softmpm import Failures
from softmpm_learn.distributed import in_full
from softmpm_learn.episode import run_episode
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.storage.sweep import EXAMINED
from softmpm_learn.tasks.task import Task
from softmpm_learn.training.evaluation import evaluate_best
from softmpm_learn.training.examination import examine
from softmpm_learn.training.run_files import RunFiles, recorded

logger = logging.getLogger("softmpm_learn")


def _record_best(runs: Runs, files: Sequence[RunFiles], done: Sequence[int]) -> None:
    """Record an episode of these runs, whose policies and designs are their best.

    It may fail where that of the training did not, since a GPU adds in any order; such a robot goes on without activation.
    """
    failures = Failures("freeze")
    params, inputs = runs.design()
    about = [{"of": runs.all[k].best["iteration"], "kind": "best"} for k in done]
    with recorded(runs, [files[k] for k in done], about) as on_frames:
        run_episode(
            runs.task,
            runs.model,
            runs.observer,
            runs.policy,
            params,
            inputs=inputs,
            goal=runs.middle_goals(),
            on_frame=on_frames and (lambda frame: on_frames([frame])),
            failures=failures,
        )
    for k, error in runs.failed(failures.errors).items():
        logger.warning("The best of %s failed when it was recorded: %s", runs.name(k), in_full(error))


def finished(runs: Runs) -> list[int]:
    """Numbers of the runs that are done and have a best motion."""
    return [
        k
        for k, run in enumerate(runs.all)
        if run.left <= 0 and k not in runs.errors and run.best["iteration"] >= 0
    ]


@contextlib.contextmanager
def _at_their_best(runs: Runs) -> Iterator[list[int]]:
    """Policies and designs of finished runs are their best until the block ends; gives their numbers."""
    done, now = finished(runs), [run.policy_snapshot() for run in runs.all]
    for k in done:
        runs.all[k].load_policy(runs.all[k].best)
    runs.move(done)
    yield done
    for run, before in zip(runs.all, now, strict=True):
        run.load_policy(before)


def evaluate_ends(runs: Runs) -> dict[int, float]:
    """The best of each finished run, evaluated again, by its number; nan where that failed. In every process.

    A run that settles, and whose best does not repeat itself, ends at the next best. A run that had ended before keeps its value.
    """
    if not runs.all[0].settings.train.examine:
        return {}
    done = finished(runs)
    best = {k: runs.all[k].best for k in done if _end(runs.all[k]) is None}
    if best:
        with _at_their_best(runs):
            again = evaluate_best(runs, list(best))
        for k, one in again.items():
            run = runs.all[k]
            run.end = run.iteration, one.loss if math.isfinite(one.loss) else math.nan
            if run.settles and run.best is not best[k]:
                run.return_to_best()
    ends = {k: _end(runs.all[k]) for k in done}
    return {k: end for k, end in ends.items() if end is not None}


def _end(run: Run) -> float | None:
    """Evaluation at the end of a run, if it was made."""
    return run.end[1] if run.end and run.end[0] == run.iteration else None


def _examined(runs: Runs, finer: Task | None) -> list[dict[str, float]]:
    """The answers of :func:`examine`; none if something of the user's fails there, as a policy may that knows the times of an episode
    alone. The runs are finished all the same."""
    try:
        return examine(runs, finer)
    except Exception as error:
        if runs.group.size > 1:  # the others wait
            raise
        logger.warning(
            "The examination failed, so its columns stay empty (train.examine=false leaves it out): %s",
            in_full(error),
        )
        return [dict.fromkeys(EXAMINED, math.nan) for _ in runs.all]


@torch.no_grad()
def finish(
    runs: Runs, files: Sequence[RunFiles], finer: Task | None, ends: dict[int, float]
) -> dict[int, dict[str, float]]:
    """Record the best policy and design of each finished run once more, as the episode after the last, and examine them.

    Args:
        ends: Of :func:`evaluate_ends`.
    """
    if not finished(runs):
        return {}
    found = {}
    with _at_their_best(runs) as done:
        if any(files[k].records for k in done):
            _record_best(runs, files, done)
        if ends:
            answers = _examined(runs, finer)
            found = {k: answers[k] | {"end": ends[k]} for k in done}
            for k in done:
                run = runs.all[k]
                files[k].add_figures(run.iteration, found[k] | {"best": run.best["loss"]})
                files[k].flush()
    return found
