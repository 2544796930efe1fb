"""State of the reference formulation in Warp arrays, and the checks of all arrays that users of Warp hold."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import view
from softmpm.state import Nodal


@dataclass(eq=False, frozen=True, kw_only=True)
class WarpNodal:
    """State of all nodes in Warp arrays, as :class:`softmpm.Nodal` has it; all but ``shift`` and ``low`` can carry a
    gradient.

    Arrays are written into (``wp.copy``), not replaced.
    """

    model: Model
    """The model that it was made for, and works with."""
    u: wp.array
    """Displacement in addition to the shift [m], vectors of shape (world, node)."""
    v: wp.array
    """Velocity [m/s], vectors of shape (world, node)."""
    anchor: wp.array
    """Places on the walls where surface points adhere, in addition to the shift [m], vectors of shape (world, wall, point)."""
    force: wp.array
    """Mean force of each wall on each surface point in the latest step [N], vectors of shape (world, wall, point). Not read by a
    step."""
    shift: wp.array
    """Translation of all nodes of a world [m], vectors of float64, shape (world,)."""
    reaction: wp.array
    """Mean force of clamps and planes of symmetry on each group of nodes in the latest step [N], vectors of shape (world, group). Not
    read by a step."""
    low: wp.array
    """Accumulated rounding errors of u [m] and v [m/s], vectors of shape (world, 2, node)."""

    def __post_init__(self):
        model, t = self.model, types(self.model.spec.dim, self.model.spec.dtype)
        nodes, points = (model.worlds, model.rest_grid.count), model.anchor_shape[:-1]
        for name, array in self.arrays().items():
            other = {"u": nodes, "v": nodes, "low": (nodes[0], 2, nodes[1])}
            other |= {"shift": nodes[:1], "reaction": model.reaction_shape[:-1]}
            shape = other.get(name, points)
            kind = types(model.spec.dim, "float64").vec if name == "shift" else t.vec
            check_array(model, name, array, shape, kind)

    def arrays(self) -> dict[str, wp.array]:
        """Every array by its name."""
        return {name: getattr(self, name) for name in Nodal._fields}

    def differentiable(self) -> list[wp.array]:
        return [self.u, self.v, self.anchor, self.force, self.reaction]

    def nodal(self) -> Nodal:
        """The same state in tensors that share its memory."""
        return Nodal(*(wp.to_torch(array, requires_grad=False) for array in self.arrays().values()))

    def adj(self) -> Nodal:
        """Gradients in tensors that share their memory."""
        return Nodal.of([wp.to_torch(array.grad) for array in self.differentiable()])  # pyright: ignore[reportArgumentType]


def warp_nodal(model: Model, nodes: Nodal, requires_grad: bool) -> WarpNodal:
    """Copy of a nodal state that has all parts."""
    vec, exact = (types(model.spec.dim, dtype).vec for dtype in (model.spec.dtype, "float64"))
    assert nodes.shift is not None and nodes.low is not None
    arrays = Nodal.of([owned(tensor, vec, requires_grad) for tensor in nodes.differentiable()])  # pyright: ignore[reportArgumentType]
    constants = dict(shift=owned(nodes.shift, exact, False), low=owned(nodes.low, vec, False))
    return WarpNodal(model=model, **arrays._replace(**constants)._asdict())


def owned(tensor: Tensor, dtype, requires_grad: bool) -> wp.array:
    """A Warp array on a copy of a tensor, with a gradient of its own."""
    array = view(tensor.detach().clone(memory_format=torch.contiguous_format), dtype)
    array.requires_grad = requires_grad
    return array


def check_array(model: Model, name: str, array: object, shape: tuple[int, ...], dtype: type) -> wp.array:
    """The array; raises unless it has this shape and type and is on the model's device."""
    if not isinstance(array, wp.array):
        raise TypeError(f"{name} must be a warp.array, got {type(array).__name__}.")
    if array.shape != shape or array.dtype is not dtype or array.device != model.wp_device:
        raise ValueError(
            f"{name} must be {_kind(shape, dtype)} on {model.wp_device}, got {_kind(array.shape, array.dtype)} on {array.device}; "
            "softmpm.warp_state and softmpm.warp_solid make such arrays."
        )
    return array


def _kind(shape: tuple[int, ...], dtype: Any) -> str:
    """As PyTorch would see it: the axes of vectors and matrices last."""
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    return f"{(*shape, *getattr(dtype, '_shape_', ()))} of {scalar.__name__}"
