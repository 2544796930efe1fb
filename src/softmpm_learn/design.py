"""Bounded material parameters: what the gradient may change about the body.

value = low + (high − low) · sigmoid(θ)        (D1)   θ is free, the value stays between its bounds
"""

import numpy as np
import torch
from torch import Tensor, nn

from softmpm import Model, Params
from softmpm_learn.settings import DesignConf


class Design(nn.Module):
    """Young's modulus, Poisson's ratio and density of the robot, shared by all worlds; starts at the scene's values.

    Args:
        conf: Which parameters, per what, and the bounds.
        model: Whose materials.
        regions: Regions of the task, for ``per="region"``; particles of none share a value of their own.
    """

    group: Tensor

    def __init__(self, conf: DesignConf, model: Model, regions: dict[str, np.ndarray]):
        super().__init__()
        self.start = model.params()
        group = _groups(conf.per, model.particle_count, regions).to(model.device)
        self.register_buffer("group", group, persistent=False)
        share = torch.zeros(int(group.max()) + 1, dtype=torch.float64, device=group.device)
        share.index_add_(0, group, model.volume.double())
        self.free, self.bounds = nn.ParameterDict(), {}
        for name in Params._fields if conf.enabled else ():
            if not getattr(conf, name):
                continue
            start = getattr(self.start, name).double()
            first = torch.zeros_like(share).index_add_(0, group, start * model.volume.double()) / share
            if name == "poisson":
                low, high = (torch.full_like(first, bound) for bound in conf.poisson_range)
            else:
                low, high = (first * factor for factor in getattr(conf, f"{name}_factor"))
            if not bool(((low < first) & (first < high)).all()):
                raise ValueError(
                    f"the scene's {name} must lie between the bounds of the design, {low.min():g} and {high.max():g}; "
                    f"it is {first.min():g} to {first.max():g}: widen design.{name}_range or switch design.{name} off."
                )
            self.free[name] = nn.Parameter(torch.logit((first - low) / (high - low)).to(model.dtype))
            self.bounds[name] = (low.to(model.dtype), (high - low).to(model.dtype))

    def forward(self) -> Params:
        """(D1) for every particle, shape (particle,) each."""
        return self.start._replace(**{name: self._value(name)[self.group] for name in self.free})

    def _value(self, name: str) -> Tensor:
        low, width = self.bounds[name]
        return low + width * torch.sigmoid(self.free[name])

    @torch.no_grad()
    def change(self) -> dict[str, float]:
        """Mean over the particles of |now / start − 1| of each parameter [-]."""
        now = self()
        change = {name: getattr(now, name) / getattr(self.start, name) - 1 for name in self.free}
        return {name: change[name].abs().mean().item() if name in change else 0.0 for name in Params._fields}


def _groups(per: str, count: int, regions: dict[str, np.ndarray]) -> Tensor:
    """Which value each particle takes, (particle,), numbered from 0 without gaps."""
    if per == "particle":
        return torch.arange(count)
    group = torch.zeros(count, dtype=torch.long)
    if per == "region":
        for number, region in enumerate(regions.values(), start=1):
            group[torch.as_tensor(region)] = number
    return torch.unique(group, return_inverse=True)[1]
