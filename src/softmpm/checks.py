"""Rules of the tensors that meet a model; those of states are in ``check_state.py``, of inputs in ``check_inputs.py``.

Each message names the rule, the value received and a remedy.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from softmpm.alarms import Alarms
from softmpm.inputs import QUANTITIES
from softmpm.planning.chunks import Horizon
from softmpm.scene.scene import Scene
from softmpm.state import Params
from softmpm.validate import need


class ModelLike(Protocol):
    """Properties of a model that decide which tensors it accepts."""

    @property
    def dim(self) -> int: ...
    @property
    def worlds(self) -> int: ...
    @property
    def particle_count(self) -> int: ...
    @property
    def muscle_count(self) -> int: ...
    @property
    def dtype(self) -> torch.dtype: ...
    @property
    def device(self) -> torch.device: ...
    @property
    def spec(self) -> Any: ...
    @property
    def defaults(self) -> dict[str, Tensor]: ...
    @property
    def scene(self) -> Scene: ...
    @property
    def alarms(self) -> Alarms: ...
    @property
    def formulation(self) -> str: ...
    @property
    def rest_grid(self) -> Any: ...
    @property
    def anchor_shape(self) -> tuple[int, ...]: ...
    @property
    def reaction_shape(self) -> tuple[int, ...]: ...
    def shape_of(self, name: str, control_steps: int) -> tuple[int, ...]: ...


MOST_SUBSTEPS = 100_000_000
"""Of one call: its chunks are listed beforehand."""


def check_activation(model: ModelLike, activation: Tensor | None) -> None:
    """Shape (control_step, world, muscle), dtype and device; None is no activation."""
    if activation is None:
        return
    check_tensor(model, "activation", activation)
    want = (model.worlds, model.muscle_count)
    if activation.ndim != 3 or activation.shape[1:] != want:
        raise ValueError(
            f"activation must have shape (control_step, world, muscle) = (any, {want[0]}, {want[1]}), "
            f"got {tuple(activation.shape)}; {_activation_hint(tuple(activation.shape), *want)}."
        )
    need(
        len(activation) > 0,
        "activation needs at least one control step, got none; pass None for no actuation.",
    )


def _activation_hint(shape: tuple[int, ...], worlds: int, muscles: int) -> str:
    """Remedy for an activation of a wrong shape."""
    if shape == (muscles,):
        return f"one control step of all worlds is activation.expand(1, {worlds}, -1)"
    if shape == (worlds, muscles):
        return "one control step is activation[None]"
    if len(shape) == 2 and shape[1] == muscles:
        return "one world is activation[:, None]" + f".expand(-1, {worlds}, -1), the same in each" * (
            worlds > 1
        )
    if len(shape) == 3 and shape[1:] == (1, muscles):
        return f"the same in each world is activation.expand(-1, {worlds}, -1)"
    if len(shape) == 3 and shape[1] == worlds:
        return f"the last axis has a number for each of the scene's {muscles} muscles and pressures"
    return f"the axes are control steps, {worlds} worlds and {muscles} muscles, in this order"


def check_row(model: ModelLike, activation: Tensor | None) -> None:
    """Shape (world, muscle), dtype and device of one row of activation; None is no activation."""
    if activation is None:
        return
    check_tensor(model, "activation", activation)
    want = (model.worlds, model.muscle_count)
    need(
        activation.shape == want,
        f"activation must have shape (world, muscle) = {want}, got {tuple(activation.shape)}; "
        "of several control steps take one row, activation[k].",
    )


def check_horizon(steps: int, substeps: int) -> Horizon:
    """A whole number of substeps for each control step, not too many in all."""
    check_whole("substeps", substeps)
    total = substeps * steps
    need(
        total <= MOST_SUBSTEPS,
        f"a call has at most {MOST_SUBSTEPS:,} substeps, got {total:,}; call simulate several times, each from the end before.",
    )
    return Horizon(steps, substeps)


def check_params(model: ModelLike, params: NamedTuple) -> None:
    """Shapes that broadcast to (world, particle), dtype and device of young, poisson and density."""
    for name, value in fields("params", params, Params._fields):
        check_tensor(model, f"params.{name}", value)
        check_broadcasts(f"params.{name}", value, "particle", (model.worlds, model.particle_count))


def check_broadcasts(name: str, value: Tensor, axis: str, want: tuple[int, int]) -> None:
    """Shape that broadcasts to (world, ``axis``), which is ``want``."""
    shape, each = tuple(value.shape), 1 if axis == "particle" else want[1]
    fits = all(n in (1, full) for n, full in zip(reversed(shape), reversed(want), strict=False))
    if not fits or len(shape) > 2:
        raise ValueError(
            f"{name} must broadcast to (world, {axis}) = {want}, got shape {shape}; one value for each world needs shape "
            f"(world, {each})."
        )


def check_whole(name: str, value: Any, least: int = 1) -> None:
    """A whole number of at least ``least``."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}.")


@torch.no_grad()
def check_bounds(params: NamedTuple, mass: Tensor, unit: Tensor) -> None:
    """Raise ValueError for a material that cannot exist. Reads back once: a GPU has to wait.

    Args:
        mass: That of the particles [kg], density times volume.
        unit: In which the kernels count it [kg], shape ().
    """
    given = [*fields("params", params, Params._fields), ("mass", mass)]
    found = [end for _, value in given for end in torch.aminmax(value)]
    *ends, lightest, heaviest, one = torch.stack([*found, unit]).tolist()
    for (name, value), low, high in zip(given[:-1], ends[::2], ends[1::2], strict=True):
        least, most, rule = QUANTITIES[name].low, QUANTITIES[name].high, QUANTITIES[name].rule
        if not (least < low and high < most):
            demand(f"params.{name}", value, (value > least) & (value < most), rule)
    real = torch.finfo(mass.dtype)
    least, most = max(one, 1.0) * real.tiny, min(one, 1.0) * real.max  # in both units
    if not (least <= lightest and heaviest <= most):
        rule = f"in [{least:.3g}, {most:.3g}] kg to be exact in {mass.dtype}; change params.density, or the units"
        demand("mass = density * volume", mass, (mass >= least) & (mass <= most), rule)


def demand(name: str, value: Tensor, holds: Tensor, rule: str) -> None:
    """Raise ValueError for the first value that breaks the rule."""
    if not bool(holds.all()):
        index = torch.nonzero(~holds)[0].tolist()
        place = f"[{', '.join(map(str, index))}]" if index else ""
        raise ValueError(f"{name} must be {rule}, but {name}{place} is {value[tuple(index)].item():g}.")


def fields(what: str, record: NamedTuple, names: tuple[str, ...]) -> Iterator[tuple[str, Tensor]]:
    for name in names:
        if not hasattr(record, name):
            raise TypeError(f"{what} must be a softmpm.{what.capitalize()}, got {type(record).__name__}.")
        yield name, getattr(record, name)


def check_tensor(
    model: ModelLike,
    name: str,
    value: Tensor,
    shape: tuple[int, ...] | None = None,
    dtype: torch.dtype | None = None,
) -> None:
    """Precision and device are the model's; and the shape, if it is one of particles. Texts are made only when needed."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}; use torch.as_tensor.")
    if value.layout != torch.strided:
        raise TypeError(f"{name} must be a dense tensor, got {value.layout}; use .to_dense().")
    if dtype is not None and dtype != model.dtype:
        need(
            value.dtype == dtype,
            f"{name} must be {dtype} in every precision, got {value.dtype}; use .to({dtype}).",
        )
    elif value.dtype != model.dtype:
        raise ValueError(
            f"{name} must be {model.dtype} like the model, got {value.dtype}; use .to({model.dtype}), "
            "or build the model with another dtype."
        )
    if value.device != model.device:
        raise ValueError(
            f"{name} must be on {model.device} like the model, got {value.device}; use .to('{model.device}')."
        )
    if shape is not None and value.shape != shape:
        raise ValueError(
            f"{name} must have shape {shape} (world, particle, axes), got {tuple(value.shape)}; start from model.rest()."
        )
