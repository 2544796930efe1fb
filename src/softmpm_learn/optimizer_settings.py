"""Settings of the optimiser. Numbers without a source are ours."""

import math
from dataclasses import dataclass, field
from typing import Any

from softmpm_learn.register import OPTIMIZERS
from softmpm_learn.setting_checks import not_negative, positive, share, typed


@dataclass(kw_only=True)
class OptimizerConf:
    """Optimiser that updates policy and design by the gradient of a simulation."""

    name: str = "adam"
    """adam or sgd (plain gradient descent)."""
    policy_rate: float | None = None
    """Learning rate of the policy. null is the task's, for the mlp and adam: 5e-3, of walkers 1e-2."""
    design_rate: float = 3e-2
    """Learning rate of the design, in the unbounded space before the sigmoid."""
    halving: float | None = None
    """Iterations in which both rates fall by half; null: never."""
    max_norm: float | None = 1.0
    """Shorten a longer gradient to this length and count it in metrics.csv; null leaves gradients alone."""
    fade: float | None = None
    """Time constant with which gradients fade on their way back through the simulation [s]: what a muscle did long before a step has an
    effect that changes of a useful size do not have (fading.py). null is the task's, 0.1 for walkers and the arm; inf: never."""
    retries: int = 4
    """Maximum number of times that a failed step is halved towards the last successful simulation; if it still fails, the run goes back
    to its best, and ends if that fails too. 0 ends the run at once."""
    fallback_share: float = 0.5
    """Go back to the best policy and design where the progress since the first iteration is below this share of the best; 0: never."""
    fallback_after: int = 5
    """Iterations in a row below that share before the run goes back. Our choice: of twelve runs in docs/results none that was so long
    below a half came to a better one within its 100 iterations."""
    fallback_from: int = 20
    """First iterations, which do not count: progress is small by then, and the best of it is chance."""
    fallback_rate: float = 0.5
    """Factor of both learning rates at each fallback."""
    settle: float = 0.2
    """Share of the iterations, at the end, in which the run settles: it takes ever smaller steps from its best, with features that no
    longer change, and ends there (settling.py); 0: never. Our choice."""
    restart_above: float | None = None
    """Begin anew with other first weights where the loss of no episode was below this; such a run does not go back to its best either.
    null is the task's, of walkers minus a tenth of their length; inf: never."""
    restart_after: int = 20
    """Iterations after which that is decided. Our choice: of a hundred elephants 22 stood still after 40 iterations, and 19 of them
    would have begun anew, with 9 of the others (docs/learning.md)."""
    options: dict[str, Any] = field(default_factory=dict)
    """Further arguments of the optimiser, such as betas of adam: +optimizer.options.betas=[0.9,0.99]."""

    def __post_init__(self):
        typed("optimizer", self)
        OPTIMIZERS.need(self.name, self.options)
        positive("optimizer", self, "design_rate", "policy_rate", "halving", "max_norm")
        if self.fade is not None and not self.fade > 0:
            raise ValueError(f"optimizer.fade must be > 0, inf or null, got {self.fade}.")
        not_negative("optimizer", self, "retries", "fallback_from")
        positive("optimizer", self, "fallback_after", "restart_after")
        if self.restart_above is not None and math.isnan(self.restart_above):
            raise ValueError("optimizer.restart_above must be a number, inf or null, got nan.")
        share("optimizer", self, "fallback_rate")
        for name in ("fallback_share", "settle"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"optimizer.{name} must lie in [0, 1), got {getattr(self, name)}.")
