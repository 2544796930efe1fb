"""Restart: a run that gets nowhere begins anew, with other first weights of the policy.

Which gait a policy finds, or none, is decided by its first weights; one that has not found any in its first iterations rarely does
later.
"""

import math
from dataclasses import dataclass

from softmpm_learn.optimizer_settings import OptimizerConf


@dataclass
class Restart:
    """Counts iterations since the run began, or began anew, and remembers their lowest loss."""

    iterations: int = 0
    lowest: float = math.inf
    """Lowest loss of an episode in these iterations."""
    count: int = 0
    """Restarts so far."""

    def is_due(self, loss: float, conf: OptimizerConf) -> bool:
        """True if the run should begin anew after an iteration whose episode has this loss."""
        self.iterations += 1
        self.lowest = min(self.lowest, loss)
        return self.iterations >= conf.restart_after and not is_worth(self.lowest, conf)

    def next(self) -> "Restart":
        """Of the run that begins anew."""
        return Restart(count=self.count + 1)


def is_worth(loss: float, conf: OptimizerConf) -> bool:
    """True if a policy with this loss is worth going on with."""
    assert conf.restart_above is not None, "Settings.suited has put the task's in its place"
    return loss < conf.restart_above or conf.restart_above == math.inf
