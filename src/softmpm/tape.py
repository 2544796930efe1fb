"""The same substep for users of Warp: :func:`step` works on Warp arrays and records its explicit adjoint on a ``wp.Tape``.

solid = softmpm.warp_solid(model, params, activation, requires_grad=True)
states = [softmpm.warp_state(model, start, requires_grad=True), softmpm.warp_state(model, requires_grad=True)]
tape = wp.Tape()
softmpm.step(model, states[0], states[1], solid, tape=tape)
tape.backward(grads={states[1].v: ...})             # fills states[0].v.grad, solid.mu.grad, ...
"""

from dataclasses import dataclass, fields

import torch
import warp as wp
from torch import Tensor

from softmpm.buffers import Motion, Solid, SolidAdj, lame, view
from softmpm.failures import raise_failure
from softmpm.kernels.types import Wanted, solid_adj_type, types
from softmpm.model import Model
from softmpm.state import Params, State
from softmpm.step import Substep, on_its_gpu, stream_of


@dataclass(eq=False)
class WarpState:
    """State of all particles in Warp arrays of shape (world, particle); all but ``base`` can carry a gradient.

    Small quantities are not stored on top of large ones: position is x = (base + fx + fx_low) dx, deformation F = I + H.
    """

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
    fx_low: wp.array | None
    """What rounding took off ``fx`` (float32 only)."""

    def differentiable(self) -> list[wp.array]:
        return [self.fx, self.v, self.C, self.H]

    def struct(self, model: Model):
        struct = types(model.spec.dim, model.spec.dtype).Motion()
        for field in fields(self):
            if getattr(self, field.name) is not None:
                setattr(struct, field.name, getattr(self, field.name))
        return struct

    def adj_struct(self, model: Model):
        struct = types(model.spec.dim, model.spec.dtype).MotionAdj()
        for name in ("fx", "v", "C", "H"):
            setattr(struct, name, getattr(self, name).grad)
        return struct


@dataclass(eq=False)
class WarpSolid:
    """Material of all particles and pull of the muscles in Warp arrays, with the buffers that steps share."""

    mass: wp.array
    """m_p [kg], (world, particle)."""
    mu: wp.array
    """Lamé's μ [Pa], (world, particle)."""
    lam: wp.array
    """Lamé's λ [Pa], (world, particle)."""
    pull: wp.array | None
    """Activation times strength [Pa], (world, muscle); None without muscles."""
    work: Substep

    def differentiable(self) -> list[wp.array]:
        return [array for array in (self.mass, self.mu, self.lam, self.pull) if array is not None]

    def raise_failure(self, model: Model, state: WarpState) -> None:
        """Raise :class:`softmpm.UnstableError` if a step so far failed; waits for the device."""
        _raise_failure(model, state, self.work)


@on_its_gpu
def _raise_failure(model: Model, state: WarpState, work: Substep) -> None:
    work.stream = stream_of(model.device)
    raise_failure(model, work.watch_words.tolist(), work.leave(state.struct(model)))


def _owned(tensor: Tensor, dtype, requires_grad: bool) -> wp.array:
    """A Warp array on a tensor of its own, with a gradient of its own."""
    array = view(tensor.clone(memory_format=torch.contiguous_format), dtype)
    array.requires_grad = requires_grad
    return array


@on_its_gpu
def warp_state(model: Model, state: State | None = None, *, requires_grad: bool = False) -> WarpState:
    """A :class:`WarpState` that holds ``state``, or the rest state if None.

    Raises:
        UnstableError: A particle is off the grid or not finite.
    """
    t, state = types(model.spec.dim, model.spec.dtype), model.rest() if state is None else state
    motion, work = Motion.empty(model), Substep(model, None)
    work.enter(state, motion.struct(model))
    raise_failure(model, work.watch_words.tolist(), state)
    return WarpState(
        base=_owned(motion.base, t.ivec, False),
        fx=_owned(motion.fx, t.vec, requires_grad),
        v=_owned(motion.v, t.vec, requires_grad),
        C=_owned(motion.C, t.mat, requires_grad),
        H=_owned(motion.H, t.mat, requires_grad),
        fx_low=None if motion.fx_low is None else _owned(motion.fx_low, t.vec, False),
    )


@on_its_gpu
def torch_state(model: Model, state: WarpState) -> State:
    """The :class:`softmpm.State` that a :class:`WarpState` holds, in new tensors."""
    return Substep(model, None).leave(state.struct(model))


@on_its_gpu
def warp_solid(
    model: Model,
    params: Params | None = None,
    activation: Tensor | None = None,
    *,
    requires_grad: bool = False,
) -> WarpSolid:
    """Material and muscles for :func:`step`.

    Args:
        params: As in :func:`softmpm.simulate`; None takes the scene's.
        activation: Muscle activation [-], shape (world, muscle); None is zero.
    """
    real, lead = types(model.spec.dim, model.spec.dtype).real, (model.worlds, model.particle_count)
    params = model.params() if params is None else params
    mu, lam = (term.expand(lead) for term in lame(Params(*(p.expand(lead) for p in params))))
    mass = (params.density * model.volume).expand(lead)
    pull = None
    if model.muscle_count:
        if activation is None:
            activation = torch.zeros(model.worlds, model.muscle_count, dtype=model.dtype, device=model.device)
        pull = (activation * model.strength).detach()
    mass, mu, lam = (tensor.detach().contiguous() for tensor in (mass, mu, lam))
    struct = Solid(mass, mu, lam, pull).struct(model)
    arrays = {"mass": mass, "mu": mu, "lam": lam} | ({} if pull is None else {"pull": pull})
    owned = {name: _owned(tensor, real, requires_grad) for name, tensor in arrays.items()}
    for name, array in owned.items():
        setattr(struct, name, array)
    return WarpSolid(owned["mass"], owned["mu"], owned["lam"], owned.get("pull"), Substep(model, struct))


@on_its_gpu
def step(
    model: Model,
    state_in: WarpState,
    state_out: WarpState,
    solid: WarpSolid,
    *,
    substep: int = 0,
    tape: wp.Tape | None = None,
) -> None:
    """Advance by one substep of ``model.scene.dt``, on PyTorch's current stream.

    Args:
        state_in, state_out: From :func:`warp_state`; two different ones. With a tape both need ``requires_grad=True``,
            and neither may be written again before ``tape.backward()``.
        solid: From :func:`warp_solid`.
        substep: Number of this step, for the message of a failure.
        tape: Where the adjoint is recorded. It adds into ``.grad`` of ``state_in`` and ``solid``; ``tape.zero()`` clears.

    Raises:
        ValueError: The two states are the same, a tape is given and an array carries no gradient, or the model is
            deterministic and on a GPU.
    """
    if state_in is state_out:
        raise ValueError(
            "state_in and state_out must be two different states; make another with softmpm.warp_state."
        )
    if model.deterministic and model.device.type == "cuda":
        raise ValueError(
            "step adds in floating point, in any order, but the model was built with deterministic=True; use softmpm.simulate, "
            "or a model built without it."
        )
    solid.work.stream = stream_of(model.device)
    solid.work.advance(state_in.struct(model), state_out.struct(model), substep)
    if tape is None:
        return
    arrays = [*state_in.differentiable(), *state_out.differentiable(), *solid.differentiable()]
    if any(array.grad is None for array in arrays):
        raise ValueError(
            "with a tape, states and solid need requires_grad=True; give it to warp_state and warp_solid."
        )
    tape.record_func(lambda: _adjoint(model, state_in, state_out, solid, substep), arrays)


@on_its_gpu
def _adjoint(model: Model, state_in: WarpState, state_out: WarpState, solid: WarpSolid, substep: int) -> None:
    solid.work.stream = stream_of(model.device)
    wanted = Wanted(material=True, activation=solid.pull is not None)
    struct = solid_adj_type(model.spec, wanted)()
    struct.mass, struct.mu, struct.lam = solid.mass.grad, solid.mu.grad, solid.lam.grad
    slots = SolidAdj.zeros(model, Wanted(material=False, activation=wanted.activation))
    if slots.slot is not None:
        struct.pull = view(slots.slot, types(model.spec.dim, model.spec.dtype).real)
    now, then = state_in.struct(model), state_out.struct(model)
    solid.work.adjoint(
        wanted, now, then, state_out.adj_struct(model), state_in.adj_struct(model), struct, substep
    )
    if solid.pull is not None and solid.pull.grad is not None:
        solid.work.collect_pull(slots, wp.to_torch(solid.pull.grad))
