"""Settling: the last iterations of a run begin at its best, and its steps get ever smaller, so that it ends there.

At the full learning rate the walk of a robot goes on changing to the end, and the last one may be far worse than one before it.
"""

SHARE = 0.9
"""A run that settles goes back to its best as soon as its progress is below this share of the best progress."""


def begins(iteration: int, iterations: int, settle: float) -> bool:
    """True for the first iteration in which a run of this many settles, see OptimizerConf.settle."""
    return iterations - iteration == _count(iterations, settle)


def pace(iteration: int, iterations: int, settle: float) -> float:
    """Length of a step in units of the learning rate: 1, and falling towards 0 in the iterations in which a run settles."""
    count, left = _count(iterations, settle), iterations - iteration
    return left / (count + 1) if left <= count else 1.0


def _count(iterations: int, settle: float) -> int:
    """Iterations in which a run settles."""
    return int(settle * iterations)
