"""State of the moving formulation in Warp arrays: made from tensors, read back, checked once when it is made."""

from dataclasses import dataclass

import torch
import warp as wp

from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import Motion
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.failure_report import raise_failure
from softmpm.schemes.plain.substep import Substep
from softmpm.state import State
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

    def __post_init__(self):
        t = types(self.model.spec.dim, self.model.spec.dtype)
        kinds = {"base": t.ivec, "fx": t.vec, "v": t.vec, "C": t.mat, "H": t.mat, "fx_low": t.vec}
        for name, array in self.arrays().items():
            check_array(self.model, name, array, (self.model.worlds, self.model.particle_count), kinds[name])

    def differentiable(self) -> list[wp.array]:
        return [self.fx, self.v, self.C, self.H]

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


@on_its_gpu
def warp_particles(model: Model, state: State, requires_grad: bool) -> WarpState:
    """Copy of a state of particles."""
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
    )


@on_its_gpu
def torch_particles(model: Model, state: WarpState) -> State:
    """The particles of a state in new tensors."""
    return Substep(model).leave(state.struct(model))
