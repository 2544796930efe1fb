"""Optimisers of policy and design, by their names."""

from collections.abc import Sequence

import torch

from softmpm_learn import register
from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.register import OPTIMIZERS


@register.optimizer("adam")
def adam(
    groups: list[dict], *, betas: Sequence[float] = (0.9, 0.999), eps: float = 1e-8, weight_decay: float = 0.0
) -> torch.optim.Optimizer:
    """Adam (Kingma and Ba 2015)."""
    return torch.optim.Adam(groups, betas=(betas[0], betas[1]), eps=eps, weight_decay=weight_decay)


@register.optimizer("sgd")
def sgd(groups: list[dict], *, momentum: float = 0.0, weight_decay: float = 0.0) -> torch.optim.Optimizer:
    """Gradient descent."""
    return torch.optim.SGD(groups, momentum=momentum, weight_decay=weight_decay)


def make_optimizer(
    conf: OptimizerConf, policy: list[torch.nn.Parameter], design: list[torch.nn.Parameter]
) -> torch.optim.Optimizer:
    """The optimiser that the settings name, with a group for the policy and one for the design if it has parameters."""
    groups = [{"params": policy, "lr": conf.policy_rate}]
    if design:
        groups.append({"params": design, "lr": conf.design_rate})
    made = OPTIMIZERS.build(conf.name, conf.options, groups)
    if not isinstance(made, torch.optim.Optimizer):
        raise ValueError(f"optimizer {conf.name} must be a torch.optim.Optimizer, got {type(made).__name__}.")
    return made


def moments(optimizer: torch.optim.Optimizer, parameter: torch.nn.Parameter) -> list[torch.Tensor]:
    """State of an optimiser that has one number for each number of a parameter, such as its moments."""
    found = optimizer.state.get(parameter, {})
    return [value for name, value in found.items() if isinstance(value, torch.Tensor) and name != "step"]
