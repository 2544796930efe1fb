"""Bounded quantities of the robot: what the gradient may change about the body.

value = low + (high − low) · sigmoid(θ)        (D1)   θ is free, the value stays between its bounds

Particles with one θ in common keep the ratios of their values where the bounds are multiples of these: a stiff part remains stiff.

The variables follow from the simulator's table of quantities: a new one needs an entry in :class:`DesignConf` and nothing here.
"""

import numpy as np
import torch
from torch import Tensor, nn

from softmpm import QUANTITIES, Inputs, Model, Params
from softmpm_learn.settings import DesignConf

DESIGNABLE = {
    name: quantity.axes[-1]
    for name, quantity in QUANTITIES.items()
    if quantity.axes in (("world", "particle"), ("world", "muscle"))
}
"""Quantities that are one number for each particle or each muscle, and for which of the two."""


def variables(conf: DesignConf) -> tuple[str, ...]:
    """Names of the quantities that the settings optimise, in the order of the table."""
    return tuple(name for name in DESIGNABLE if conf.enabled and getattr(conf, name, False))


def declared_inputs(conf: DesignConf) -> tuple[str, ...]:
    """Those of :func:`variables` that ``softmpm.build`` takes as ``inputs``."""
    return tuple(name for name in variables(conf) if name in Inputs._fields)


class Design(nn.Module):
    """Quantities of the robot's particles and muscles, shared by all worlds; starts at the scene's values.

    Args:
        conf: Which quantities, per what, and the bounds.
        model: Whose robot.
        regions: Regions of the task, for ``per="region"``; particles of none share a value of their own.
    """

    def __init__(self, conf: DesignConf, model: Model, regions: dict[str, np.ndarray]):
        super().__init__()
        self._params = model.params()
        self.free, self.bounds = nn.ParameterDict(), {}
        self.start = {name: _scene_values(model, name) for name in variables(conf)}
        particles = _groups(conf.per, model.particle_count, regions).to(model.device)
        muscles = torch.arange(model.muscle_count, device=model.device)
        self._group = {name: particles if DESIGNABLE[name] == "particle" else muscles for name in self.start}
        for name, start in self.start.items():
            low, high = _bounds(conf, name, start.double())
            share = _of_groups(name, (start - low) / (high - low), self._group[name])
            self.free[name] = nn.Parameter(torch.logit(share).to(model.dtype))
            self.bounds[name] = (low.to(model.dtype), (high - low).to(model.dtype))

    def forward(self) -> tuple[Params, Inputs]:
        """(D1) for every particle, shape (particle,), and every muscle, (muscle,); an input that is no variable is None."""
        values = {name: self._value(name) for name in self.free}
        inputs = {name: values.pop(name) for name in self.free if name in Inputs._fields}
        return self._params._replace(**values), Inputs(**inputs)

    def _value(self, name: str) -> Tensor:
        low, width = self.bounds[name]
        return low + width * torch.sigmoid(self.free[name])[self._group[name]]

    @torch.no_grad()
    def change(self) -> dict[str, Tensor]:
        """Mean over the particles or muscles of |now / start − 1| [-], shape (), of each material parameter and of each variable; those
        that start at 0 do not count, and where all do it is nan."""
        change = {name: (self._value(name) / start - 1).abs() for name, start in self.start.items()}
        change = {name: c.where(self.start[name] != 0, torch.nan) for name, c in change.items()}
        none = self._params.young.new_zeros(())
        return dict.fromkeys(Params._fields, none) | {name: c.nanmean() for name, c in change.items()}


def _scene_values(model: Model, name: str) -> Tensor:
    """The field of this name of the scene's materials or actuators, shape (particle,) or (muscle,)."""
    per_particle = DESIGNABLE[name] == "particle"
    owners = [body.material for body in model.scene.bodies] if per_particle else model.scene.muscles
    if not owners:
        raise ValueError(f"design.{name} needs a scene with muscles; switch it off.")
    values = torch.tensor([getattr(o, name) for o in owners], dtype=model.dtype, device=model.device)
    return values[model.body] if per_particle else values


def _groups(per: str, count: int, regions: dict[str, np.ndarray]) -> Tensor:
    """Index of the value of each particle, shape (particle,), counted from 0 without gaps."""
    if per == "particle":
        return torch.arange(count)
    group = torch.zeros(count, dtype=torch.long)
    if per == "region":
        for number, region in enumerate(regions.values(), start=1):
            group[torch.as_tensor(region)] = number
    return torch.unique(group, return_inverse=True)[1]


def _bounds(conf: DesignConf, name: str, start: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest value of each particle or muscle: ``{name}_range`` of the settings, or ``{name}_factor`` times its own.

    Raises:
        ValueError: The scene's value is not between them.
    """
    if hasattr(conf, f"{name}_factor"):
        if bool((start == 0).any()):
            raise ValueError(
                f"design.{name} needs a scene whose {name} is 0 nowhere, because its bounds are multiples of it: "
                f"set task.{name} or switch design.{name} off."
            )
        ends = torch.stack([start * factor for factor in getattr(conf, f"{name}_factor")])
        return ends.amin(dim=0), ends.amax(dim=0)  # a negative value changes their order
    low, high = (torch.full_like(start, bound) for bound in getattr(conf, f"{name}_range"))
    if not bool(((low < start) & (start < high)).all()):
        raise ValueError(
            f"the scene's {name} must lie between the bounds of the design, {low.min():g} and {high.max():g}; "
            f"it is {start.min():g} to {start.max():g}: widen design.{name}_range or switch design.{name} off."
        )
    return low, high


def _of_groups(name: str, share: Tensor, group: Tensor) -> Tensor:
    """Value of each group, which its particles have in common, shape (group,).

    Raises:
        ValueError: They do not.
    """
    found = share.new_zeros(int(group.max()) + 1).index_copy(0, group, share)
    if not torch.allclose(found[group], share, rtol=1e-6, atol=0):
        raise ValueError(
            f"the scene's {name} must be the same all over what has one value in the design; take design.per=particle or switch "
            f"design.{name} off."
        )
    return found
