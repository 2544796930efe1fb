"""Evaluation: a loss that compares iterations and runs, where that of the episodes does not.

Where each simulation draws a goal of its own it is taken at fixed goals, without chance. Of a walker it is that of a longer motion:
gaits that stumble or break soon after the episode are often those of the lowest loss.
"""

import itertools
import logging
import math
from dataclasses import dataclass

import torch

import softmpm
from softmpm_learn.run import Run
from softmpm_learn.runs import Runs

ALL = 1 - 1e-4
"""Share of the worlds above which it is all of them: a mean is rounded."""

logger = logging.getLogger("softmpm_learn")


def due(run: Run) -> bool:
    """True if this iteration is evaluated: the first, every so many, and the last of a run that settles; not the last of another run,
    which would differ if it went on."""
    every = run.settings.train.evaluate_every
    regular = run.iteration == 0 or (run.iteration + 1) % every == 0
    return run.evaluated and (regular or (run.settles and run.left == 1))


@dataclass(frozen=True)
class Evaluation:
    """What was found of policy and design of a run."""

    loss: float
    """Mean over the evaluation goals, ``train.endurance`` times as long as an episode; of several starts the worst; infinite if a
    simulation failed."""
    lasts: bool
    """All these motions last, see :mod:`softmpm_learn.lasting`; True where the task does not ask."""


@torch.no_grad()
def evaluate(runs: Runs) -> list[Evaluation]:
    """Evaluate policy and design of each run as they are."""
    found, failed = [], dict[int, softmpm.UnstableError]()
    starts = runs.evaluator.starts
    for kick, goal in itertools.product(starts, runs.evaluation_goals() or [None]):
        both = torch.stack(runs.evaluator(goal, kick))
        found.append(both.unflatten(1, (len(runs.all), -1)).mean(dim=2))
        failed = runs.failed(runs.evaluator.failures.errors) | failed
    for k, error in failed.items():
        logger.warning("Iteration %d: the evaluation failed: %s", runs.all[k].iteration, error)
        found[0][0, k] = math.inf
    means = runs.group.average(found)  # infinite in every process if it is in one
    losses, lasts = torch.stack(means).unflatten(0, (len(starts), -1)).mean(dim=1).unbind(dim=1)
    worst, least = losses.max(dim=0).values.tolist(), lasts.min(dim=0).values.tolist()
    return [Evaluation(loss, share > ALL) for loss, share in zip(worst, least, strict=True)]
