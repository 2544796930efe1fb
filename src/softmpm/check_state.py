"""Rules of the states that meet a model; agreement with the nodes of the reference formulation is checked in ``check_nodes.py``.

Each message names the rule, the value received and a remedy.
"""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from softmpm.checks import ModelLike, check_tensor, demand
from softmpm.state import Low, Nodal, State, SurfaceState


def check_state(model: ModelLike, state: State) -> None:
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


def _check_nodes(model: ModelLike, nodes: Nodal) -> None:
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


def _check_surface(model: ModelLike, surface: SurfaceState) -> None:
    """Shape, dtype and device of the surface points, which only the moving formulation with contact at them has."""
    if model.formulation != "moving" or model.anchor_shape[2] == 0:
        raise ValueError(
            "state.surface must be None unless formulation='moving' and contact='surface'; take state._replace(surface=None)."
        )
    shape = model.anchor_shape
    for name in ("anchor", "force"):
        check_tensor(model, f"state.surface.{name}", getattr(surface, name), shape)


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


ALONE = 32_767
"""Numbers of a tensor, at most, for which PyTorch uses the calling thread alone on a CPU."""


def _total(tensor: Tensor) -> Tensor:
    """Sum of a tensor, on a CPU in parts that PyTorch adds up in the calling thread (docs/decisions/0011-cpu-threads.md)."""
    if tensor.device.type != "cpu" or tensor.numel() <= ALONE:
        return tensor.sum()
    return torch.stack([part.sum() for part in tensor.reshape(-1).split(ALONE)]).sum()
