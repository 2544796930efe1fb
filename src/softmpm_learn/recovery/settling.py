"""Settling: the last iterations of a run begin at its best, and its steps get ever smaller, so that it ends there.

At the full learning rate the walk of a robot goes on changing to the end, and the last one may be far worse than one before it.
"""

from dataclasses import dataclass

SETTLED_SHARE = 0.9
"""A run that settles goes back to its best as soon as its progress is below this share of the best progress."""
FEWEST = 3
"""Iterations in which a run settles, at least: in the first it goes back, and in the last it takes no step."""


@dataclass
class Settling:
    """Decides in the first of the last iterations whether the run settles in them."""

    active: bool = False
    """True if the run settles."""

    def begins(self, left: int, count: int, worth: bool) -> bool:
        """True in the first iteration in which the run settles.

        Args:
            left: Iterations of the run that are not done.
            count: Those in which it is to settle, of :func:`iterations`.
            worth: There is something to settle at.
        """
        if left == count:
            self.active = worth
        return self.active and left == count


def iterations(total: int, share: float) -> int:
    """Last iterations in which a run of so many settles, see ``OptimizerConf.settle``."""
    count = int(share * total)
    return count if count >= FEWEST else 0


def pace(left: int, count: int) -> float:
    """Length of a step in units of the learning rate while a run settles: below 1, and falling towards 0 in equal steps."""
    return left / (count + 1)
