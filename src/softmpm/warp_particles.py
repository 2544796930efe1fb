"""State of the moving formulation in Warp arrays: made from tensors, read back, checked once when it is made."""

from dataclasses import dataclass
from typing import cast

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import Motion
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.failure_report import raise_failure
from softmpm.schemes.plain.substep import Substep
from softmpm.state import State, SurfaceState
from softmpm.warp_nodal import check_array, owned


@dataclass(eq=False, frozen=True, kw_only=True)
class WarpState:
    """State of all particles in Warp arrays of shape (world, particle); all but ``base`` can carry a gradient.

    Arrays are written into (``wp.copy``), not replaced.
    Small quantities are not stored on top of large ones: position is x = (base + fx + fx_low) dx, deformation F = I + H.
    """

    model: Model
    """The model that it was made for, and works with."""
    base: wp.array
    """First node of the stencil, integer vectors."""
    fx: wp.array
    """Position from the base node in cells [-]; its gradient is dx ∂L/∂x."""
    v: wp.array
    """Velocity [m/s]."""
    C: wp.array
    """Affine velocity [1/s]."""
    H: wp.array
    """F − I [-]; its gradient is ∂L/∂F."""
    fx_low: wp.array | None = None
    """Part of ``fx`` that rounding removed (float32 only)."""
    anchor: wp.array | None = None
    """Places on the walls where surface points adhere [m], vectors of shape (world, wall, point); with contact at them only. Their
    gradient is theirs alone, where :func:`softmpm.simulate` adds it to that of x for a state whose anchors follow from x."""
    force: wp.array | None = None
    """Mean force of each wall on each surface point in the latest step [N], vectors of shape (world, wall, point). Not read by a
    step."""

    def __post_init__(self):
        model, t = self.model, types(self.model.spec.dim, self.model.spec.dtype)
        kinds = {"base": t.ivec, "fx": t.vec, "v": t.vec, "C": t.mat, "H": t.mat, "fx_low": t.vec}
        for name, array in self.arrays().items():
            check_array(model, name, array, (model.worlds, model.particle_count), kinds[name])
        if model.surface is not None:
            for name in SurfaceState._fields:
                check_array(model, name, getattr(self, name), model.anchor_shape[:-1], t.vec)

    def differentiable(self) -> list[wp.array]:
        return [self.fx, self.v, self.C, self.H, *self._points()]

    def surface(self) -> SurfaceState | None:
        """The surface points in tensors that share their memory; None if the model has none."""
        return _surface_of([wp.to_torch(array, requires_grad=False) for array in self._points()])

    def adj_surface(self) -> SurfaceState | None:
        """Their gradients, likewise."""
        return _surface_of([wp.to_torch(cast(wp.array, array.grad)) for array in self._points()])

    def _points(self) -> list[wp.array]:
        return [] if self.anchor is None or self.force is None else [self.anchor, self.force]

    def struct(self, model: Model):
        struct = types(model.spec.dim, model.spec.dtype).Motion()
        for name, array in self.arrays().items():
            setattr(struct, name, array)
        return struct

    def arrays(self) -> dict[str, wp.array]:
        """Every array by its name."""
        names = ("base", "fx", "v", "C", "H", "fx_low")
        return {name: getattr(self, name) for name in names[: 6 if self.model.dtype == torch.float32 else 5]}

    def adj_struct(self, model: Model):
        struct = types(model.spec.dim, model.spec.dtype).MotionAdj()
        for name in ("fx", "v", "C", "H"):
            setattr(struct, name, getattr(self, name).grad)
        return struct


def _surface_of(tensors: list[Tensor]) -> SurfaceState | None:
    return SurfaceState(*tensors) if tensors else None


@on_its_gpu
def warp_particles(model: Model, state: State, requires_grad: bool) -> WarpState:
    """Copy of a state of particles, with its surface points if the model has contact at them."""
    t = types(model.spec.dim, model.spec.dtype)
    motion, work = Motion.empty(model), Substep(model)
    work.enter(state, motion.struct(model))
    raise_failure(model, work.words.tolist(), state)
    return WarpState(
        model=model,
        base=owned(motion.base, t.ivec, False),
        fx=owned(motion.fx, t.vec, requires_grad),
        v=owned(motion.v, t.vec, requires_grad),
        C=owned(motion.C, t.mat, requires_grad),
        H=owned(motion.H, t.mat, requires_grad),
        fx_low=None if motion.fx_low is None else owned(motion.fx_low, t.vec, False),
        anchor=None if state.surface is None else owned(state.surface.anchor, t.vec, requires_grad),
        force=None if state.surface is None else owned(state.surface.force, t.vec, requires_grad),
    )


@on_its_gpu
def torch_particles(model: Model, state: WarpState) -> State:
    """The particles of a state in new tensors."""
    surface = state.surface()
    end = Substep(model).leave(state.struct(model))
    return end if surface is None else end._replace(surface=surface.clone())
