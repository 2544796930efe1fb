"""Rules of the tensors that meet a model; those of inputs are in ``check_inputs.py``, of nodes in ``check_nodes.py``.

Each message names the rule, the value received and a remedy.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from softmpm.alarms import Alarms
from softmpm.inputs import QUANTITIES
from softmpm.planning.chunks import Horizon
from softmpm.scene.scene import Scene
from softmpm.state import Low, Nodal, Params, State, SurfaceState
from softmpm.validate import need


class Sizes(Protocol):
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


def check_state(model: Sizes, state: State) -> None:
    """Shape, dtype and device of x, v, C and F, and of the low-order parts if there are any."""
    if not isinstance(state, State):
        raise TypeError(f"state must be a softmpm.State, got {type(state).__name__}.")
    lead, d = (model.worlds, model.particle_count), model.dim
    shapes = {"x": (*lead, d), "v": (*lead, d), "C": (*lead, d, d), "F": (*lead, d, d)}
    for name in shapes:
        check_tensor(model, f"state.{name}", getattr(state, name), shapes[name])
    for name, kind in (("low", Low), ("nodes", Nodal), ("surface", SurfaceState)):
        part = getattr(state, name)
        if not (part is None or isinstance(part, kind)):
            raise TypeError(
                f"state.{name} must be a softmpm.{kind.__name__} or None, got {type(part).__name__}; "
                "state.of_worlds(...) takes some worlds of a state."
            )
    if state.nodes is not None:
        _check_nodes(model, state.nodes)
    if state.surface is not None:
        _check_surface(model, state.surface)
    if state.low is None:
        return
    if model.dtype != torch.float32:
        raise ValueError(
            f"state.low must be None in {model.dtype}, which has room for these remainders in x and F; take state.to({model.dtype}), "
            "which adds them."
        )
    for name in ("x", "F"):
        check_tensor(model, f"state.low.{name}", getattr(state.low, name), shapes[name])


def _check_nodes(model: Sizes, nodes: Nodal) -> None:
    """Shape, dtype and device of the nodal state, which only the reference formulation has."""
    if model.formulation != "reference":
        raise ValueError(
            "state.nodes must be None with formulation='moving'; take state._replace(nodes=None), or build the model with "
            "formulation='reference'."
        )
    shape = (model.worlds, model.rest_grid.count, model.dim)
    wanted_shapes = {"u": shape, "v": shape, "anchor": model.anchor_shape, "force": model.anchor_shape}
    for name, wanted in wanted_shapes.items():
        check_tensor(model, f"state.nodes.{name}", getattr(nodes, name), wanted)
    if nodes.reaction is not None:
        check_tensor(model, "state.nodes.reaction", nodes.reaction, model.reaction_shape)
    if nodes.shift is not None:
        check_tensor(model, "state.nodes.shift", nodes.shift, (model.worlds, model.dim), torch.float64)
    if nodes.low is not None:
        check_tensor(model, "state.nodes.low", nodes.low, (shape[0], 2, *shape[1:]))


def _check_surface(model: Sizes, surface: SurfaceState) -> None:
    """Shape, dtype and device of the surface points, which only the moving formulation with contact at them has."""
    if model.formulation != "moving" or model.anchor_shape[2] == 0:
        raise ValueError(
            "state.surface must be None unless formulation='moving' and contact='surface'; take state._replace(surface=None)."
        )
    shape = model.anchor_shape
    for name in ("anchor", "force"):
        check_tensor(model, f"state.surface.{name}", getattr(surface, name), shape)


ALONE = 32_767
"""Numbers of a tensor, at most, for which PyTorch uses the calling thread alone on a CPU."""


def _total(tensor: Tensor) -> Tensor:
    """Sum of a tensor, on a CPU in parts that PyTorch adds up in the calling thread (docs/decisions/0011-cpu-threads.md)."""
    if tensor.device.type != "cpu" or tensor.numel() <= ALONE:
        return tensor.sum()
    return torch.stack([part.sum() for part in tensor.reshape(-1).split(ALONE)]).sum()


def check_activation(model: Sizes, activation: Tensor | None) -> None:
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


def check_row(model: Sizes, activation: Tensor | None) -> None:
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


def check_params(model: Sizes, params: NamedTuple) -> None:
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


@torch.no_grad()
def check_finite(state: State | None, activation: Tensor | None) -> None:
    """All numbers that a call reads of a state, and the activation, are finite. Reads back once: a GPU has to wait."""
    given = [] if state is None else list(_read(state))
    given += [] if activation is None else [("activation", activation)]
    if not given:
        return
    # A sum is finite only if all of it is, and takes one pass; few sums of finite numbers are not.
    totals = [_total(value).double() for _, value in given]
    for (name, value), total in zip(given, torch.stack(totals).tolist(), strict=True):
        if not math.isfinite(total):
            demand(name, value, torch.isfinite(value), "finite")


def _read(state: State) -> Iterator[tuple[str, Tensor]]:
    """The tensors of a state that a call reads, by name: all but mean forces of the last control step."""
    parts = {
        "state": (state, ("x", "v", "C", "F")),
        "state.low": (state.low, ("x", "F")),
        "state.nodes": (state.nodes, ("u", "v", "anchor", "shift", "low")),
        "state.surface": (state.surface, ("anchor",)),
    }
    for place, (part, names) in parts.items():
        for name in names if part is not None else ():
            value = getattr(part, name)
            if value is not None:
                yield f"{place}.{name}", value


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
    model: Sizes,
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
