"""Ranking of the best motions of a run, and replacement of a best that does not repeat itself."""

import math
from collections.abc import Callable, Sequence

from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.recovery.fallback import Fallback
from softmpm_learn.recovery.restart import is_worth

OTHERS = 6
"""Motions that are kept besides the best."""
REPEATED = 0.8
"""A best repeats itself if a further evaluation makes at least this share of its progress."""


class Motions:
    """The best motions of a run so far.

    A motion is a dict: ``loss`` (of its evaluation if there are any), ``lasts``, ``iteration``, and copies of policy, design and what
    belongs to them (:meth:`softmpm_learn.runs.run.Run.policy_snapshot`).

    Attributes:
        best: The best motion; iteration −1 and an infinite loss until there is one.
        others: The next best, at most :data:`OTHERS`, the better first.
    """

    def __init__(self, conf: OptimizerConf):
        self._conf = conf
        self.best: dict = {"loss": math.inf, "lasts": False, "iteration": -1}
        self.others: list[dict] = []

    @property
    def all(self) -> list[dict]:
        """The best and the others."""
        return [self.best] * (self.best["iteration"] >= 0) + self.others

    @property
    def best_is_worth_it(self) -> bool:
        """True if the best is worth going on with."""
        return self.best["iteration"] >= 0 and self._is_worth(self.best["loss"])

    def would_be_best(self, loss: float, lasts: bool) -> bool:
        """True of a motion that is better than the best so far: one that lasts is better than one that does not, and of two others that
        of the lower loss.

        Args:
            loss: nan or infinite of a motion that is not known.
            lasts: See :mod:`softmpm_learn.lasting`; of no account where the motion is not worth going on with.
        """
        return math.isfinite(loss) and _rank(self._counted(loss, lasts)) < _rank(self.best)

    def keep(self, loss: float, lasts: bool, iteration: int, snapshot: Callable[[], dict]) -> None:
        """Keep a motion if it is the best so far, or among the next best.

        Args:
            snapshot: Makes the copies; called only for a motion that is kept.
        """
        now = self._counted(loss, lasts) | {"iteration": iteration}
        full = len(self.others) == OTHERS
        if math.isfinite(loss) and not (full and _rank(now) >= _rank(self.others[-1])):
            self.rank([*self.all, now | snapshot()])

    def rank(self, motions: Sequence[dict]) -> None:
        """Keep the best of some motions, and the next best."""
        self.best, *others = sorted(motions, key=_rank)
        self.others = others[:OTHERS]

    def recount(self, loss: float, lasts: bool, fallback: Fallback) -> bool:
        """Count a further evaluation of the best: True if it repeats itself, by :data:`REPEATED` of its progress, and lasts again if it
        did, or if it is not worth going on with anyway.

        A best that does not is worth the worse of both, and the best is then the best of it and of the others.

        Args:
            loss: Infinite where it failed.
            fallback: Of the run; knows where the progress began.
        """
        best = self.best
        known = math.isfinite(loss) and not fallback.is_below(loss, best["loss"], REPEATED)
        if (known and lasts >= best["lasts"]) or not self.best_is_worth_it:
            return True
        worse = self._counted(max(loss, best["loss"]), best["lasts"] and lasts)
        self.rank([best | worse, *self.others])
        return False

    def _counted(self, loss: float, lasts: bool) -> dict:
        """Score of a motion; one that is not worth going on with does not last."""
        return {"loss": loss, "lasts": lasts and self._is_worth(loss)}

    def _is_worth(self, loss: float) -> bool:
        return math.isfinite(loss) and is_worth(loss, self._conf)


def _rank(motion: dict) -> tuple[bool, float]:
    """Sort key, lower for the better motion, see :meth:`Motions.would_be_best`."""
    return not motion["lasts"], motion["loss"]
