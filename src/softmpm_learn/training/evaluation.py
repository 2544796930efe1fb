"""Evaluation: a loss that compares iterations and runs, where that of the episodes does not.

Where each simulation draws a goal of its own it is taken at fixed goals, without chance. Of a walker it is that of a longer motion:
gaits that stumble or break soon after the episode are often those of the lowest loss.
"""

import itertools
import logging
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch

import softmpm
from softmpm_learn.distributed import in_full
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs

ALL = 1 - 1e-4
"""Share of the worlds above which it is all of them: a mean is rounded."""
ROUNDS = 8
"""Most evaluations of what may be the best, until one repeats itself."""

logger = logging.getLogger("softmpm_learn")


def due(run: Run) -> bool:
    """True if this iteration is evaluated: the first, every so many, and the last of a run that settles; not the last of another run,
    which would differ if it went on."""
    every = run.settings.train.evaluate_every
    regular = run.iteration == 0 or (run.iteration + 1) % every == 0
    return run.evaluated and (regular or (run.settles and run.left == 1))


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of the policy and design of a run."""

    loss: float
    """Mean over the evaluation goals, ``train.endurance`` times as long as an episode; of several starts the worst; infinite if a
    simulation failed."""
    lasts: bool
    """All these motions last, see :mod:`softmpm_learn.lasting`; True where the task does not ask."""

    def worse(self, other: "Evaluation") -> "Evaluation":
        """The worse of both, of the same run from other starts."""
        return Evaluation(max(self.loss, other.loss), self.lasts and other.lasts)


def evaluate(runs: Runs, of: Collection[int]) -> dict[int, Evaluation]:
    """Evaluate policy and design of some runs as they are, by their numbers; what would be the best so far also from further starts."""
    found, further = simulate(runs, of, runs.evaluator.starts), runs.evaluator.further
    best = [k for k, one in found.items() if runs.all[k].motions.would_be_best(one.loss, one.lasts)]
    again = simulate(runs, best, further) if best and further else {}
    return found | {k: found[k].worse(one) for k, one in again.items()}


def evaluate_best(runs: Runs, of: Collection[int]) -> dict[int, Evaluation]:
    """Evaluate the best motions of some runs again, from other starts. These runs are left with the policies and designs of their best.

    If the best of a run that settles does not repeat itself, the next best takes its place and is evaluated too. There are at most
    :data:`ROUNDS` evaluations, the last of which is accepted in any case. If no motion is left that is worth going on with, the run
    keeps its best.
    """
    first, before = dict[int, Evaluation](), {k: runs.all[k].motions.all for k in of}
    found, left = dict[int, Evaluation](), ROUNDS
    while of:
        left -= 1
        for k in of:
            runs.all[k].load_policy(runs.all[k].best)
        again = simulate(runs, of, runs.evaluator.again)
        first, found = again | first, found | again
        tried = [k for k in of if left and runs.all[k].settles and not _repeats(runs.all[k], again[k])]
        of = [k for k in tried if runs.all[k].motions.best_is_worth_it]
    for k, motions in before.items():
        if motions and not runs.all[k].motions.best_is_worth_it:
            runs.all[k].motions.rank(motions)
            runs.all[k].load_policy(runs.all[k].best)
            found[k] = first[k]
    return found


def _repeats(run: Run, again: Evaluation) -> bool:
    """Count the further evaluation of the best of a run, see :meth:`softmpm_learn.runs.run.Run.recount`; the log says what followed."""
    before = run.best
    repeats = run.recount(again.loss, again.lasts)
    if not repeats:
        logger.info(
            "%s: evaluated again, the best has %.3g instead of %.3g%s; %s.",
            run.now,
            again.loss,
            before["loss"],
            " and does not last" if before["lasts"] and not again.lasts else "",
            f"the best is that of iteration {run.best['iteration']} now"
            if run.motions.best_is_worth_it
            else "no other is better",
        )
    return repeats


@torch.no_grad()
def simulate(runs: Runs, of: Collection[int], starts: Sequence[float]) -> dict[int, Evaluation]:
    """Evaluate from starts with these speeds along the first axis [m/s], of which the worst counts."""
    times, found, failed = runs.evaluator.at_once, [], dict[int, tuple[float, softmpm.UnstableError]]()
    groups = [starts[k : k + times] for k in range(0, len(starts), times)]
    for kicks, goal in itertools.product(groups, runs.evaluation_goals() or [None]):
        both = torch.stack(runs.evaluator(goal, kicks))
        found.append(both.unflatten(1, (len(runs.all), -1)).mean(dim=2))
        for k, error in runs.failed(runs.evaluator.failures.errors, times).items():
            failed.setdefault(k, (kicks[error.world % times], error))
    for k, (kick, error) in failed.items():
        if k not in of:
            continue
        start = f", from a start with {kick:g} m/s" if times > 1 else ""
        logger.warning("%s: the evaluation failed%s: %s", runs.all[k].now, start, in_full(error))
        found[0][0, k] = math.inf
    means = runs.group.average(found)  # infinite in every process if it is in one
    # of each start the mean over the goals, shape (group of starts, 2, run, start)
    each = torch.stack(means).unflatten(0, (len(groups), -1)).mean(dim=1)
    worst, least = each[:, 0].amax(dim=(0, 2)).tolist(), each[:, 1].amin(dim=(0, 2)).tolist()
    return {k: Evaluation(worst[k], least[k] > ALL) for k in of}
