"""The end of a training: the best motion of each run is recorded once more and examined."""

import logging
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from softmpm import Failures
from softmpm_learn.distributed import in_full
from softmpm_learn.episode import run_episode
from softmpm_learn.evaluation import evaluate
from softmpm_learn.examination import examine
from softmpm_learn.run_logger import RunLogger, recorded
from softmpm_learn.runs import Runs

if TYPE_CHECKING:
    from softmpm_learn.tasks.task import Task

logger = logging.getLogger("softmpm_learn")


def _record_best(runs: Runs, loggers: Sequence[RunLogger], done: Sequence[int]) -> None:
    """Record an episode of these runs, whose policies and designs are their best.

    It may fail where that of the training did not, since a GPU adds in any order; such a robot goes on without activation.
    """
    failures = Failures("freeze")
    params, inputs = runs.design()
    about = [{"of": runs.all[k].best["iteration"], "kind": "best"} for k in done]
    with recorded(runs, [loggers[k] for k in done], about) as on_frame:
        run_episode(
            runs.task,
            runs.model,
            runs.observer,
            runs.policy,
            params,
            inputs=inputs,
            goal=runs.middle_goals(),
            on_frame=on_frame,
            failures=failures,
        )
    for k, error in runs.failed(failures.errors).items():
        logger.warning("The best of %s failed when it was recorded: %s", runs.name(k), in_full(error))


@torch.no_grad()
def finish(runs: Runs, loggers: Sequence[RunLogger], finer: "Task | None") -> dict[int, dict[str, float]]:
    """Record the best policy and design of each finished run once more, as the episode after the last, evaluate them once more, and
    examine them."""
    done = [
        k
        for k, run in enumerate(runs.all)
        if run.iteration >= run.settings.train.iterations
        and k not in runs.errors
        and run.best["iteration"] >= 0
    ]
    if not done:
        return {}
    now = [run.policy_snapshot() for run in runs.all]
    for k in done:
        runs.all[k].load_policy(runs.all[k].best)
    runs.move(done)
    if any(loggers[k].records for k in done):
        _record_best(runs, loggers, done)
    found = {}
    if runs.all[0].settings.train.examine:
        again, answers = evaluate(runs), examine(runs, finer)
        found = {k: answers[k] for k in done}
        for k in done:
            value = again[k] if math.isfinite(again[k]) else math.nan
            loggers[k].add_figures(runs.all[k].iteration, found[k] | {"evaluation": value})
            loggers[k].flush()
    for run, before in zip(runs.all, now, strict=True):
        run.load_policy(before)
    return found
