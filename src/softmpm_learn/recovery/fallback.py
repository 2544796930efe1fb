"""Fallback: a run that stays far below its best goes on from there, with smaller steps.

Where contact changes, a step of the usual length may lead to a gait that is much worse, from which gradients do not lead back.
"""

import math
from dataclasses import dataclass

from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.recovery.settling import SETTLED_SHARE


def limits(conf: OptimizerConf, settles: bool) -> tuple[float, int]:
    """Share of the best progress below which a run is too far, and the iterations in a row after which it goes back."""
    return (SETTLED_SHARE, 1) if settles else (conf.fallback_share, conf.fallback_after)


@dataclass
class Fallback:
    """Counts iterations in a row whose progress, the first loss minus the present one, is below a share of the best progress.

    The best may be above the first loss, because a motion that lasts is better than one that does not. Its progress then is its size.
    """

    first: float = math.nan
    """First loss of the run."""
    below: int = 0
    """Iterations in a row, up to the present one."""
    count: int = 0
    """Times that the run went back so far."""
    iterations: int = 0
    """Iterations so far."""

    def next(self) -> "Fallback":
        """Of a run that begins anew; its first loss stays that."""
        return Fallback(first=self.first, count=self.count)

    def is_below(self, loss: float, best: float, share: float) -> bool:
        """True if the progress of a loss is below a share of the best progress; False as long as there is no first loss."""
        begin = self.first if self.first > best else best + abs(best)
        return not math.isnan(self.first) and begin - loss < share * (begin - best)

    def is_due(self, loss: float, best: float, conf: OptimizerConf, settles: bool = False) -> bool:
        """True if the run should fall back after an iteration; then a new count begins.

        Args:
            loss: That of the iteration; nan where it is not known, which goes on with the count and decides nothing, infinite where its
                simulation failed.
            best: That of the best so far.
            settles: The run settles: a single iteration below :data:`softmpm_learn.recovery.settling.SETTLED_SHARE` decides.
        """
        self.iterations += 1
        if math.isnan(loss):
            self.below += self.below > 0
            return False
        if math.isnan(self.first):
            if math.isinf(loss):
                return False
            self.first = loss
        early = self.iterations <= conf.fallback_from and not settles
        share, after = limits(conf, settles)
        low = not early and self.is_below(loss, best, share)
        self.below = self.below + 1 if low else 0
        if conf.fallback_share == 0 or self.below < after:
            return False
        self.below = 0
        return True
