"""States and material in Warp arrays, for users of Warp: made from tensors, read back, checked once when they are made."""

from dataclasses import dataclass, field
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.checks import check_bounds, check_finite, check_params, check_row, check_state
from softmpm.kernels.structs import types
from softmpm.model import Model, check_model
from softmpm.schemes.alarm_check import armed, check_end
from softmpm.schemes.buffers import Motion, Solid, lame, masses, view
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.device import on_its_gpu, stream_of
from softmpm.schemes.failure_report import raise_failure
from softmpm.schemes.plain.substep import Substep
from softmpm.state import Params, State


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
    """What rounding took off ``fx`` (float32 only)."""

    def __post_init__(self):
        t = types(self.model.spec.dim, self.model.spec.dtype)
        kinds = {"base": t.ivec, "fx": t.vec, "v": t.vec, "C": t.mat, "H": t.mat, "fx_low": t.vec}
        for name, array in self.arrays().items():
            _check_array(self.model, name, array, self.model.particle_count, kinds[name])

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


@dataclass(eq=False, frozen=True, kw_only=True)
class WarpSolid:
    """Material of all particles and pull of the muscles in Warp arrays, with the buffers that steps share.

    Arrays are written into (``wp.copy``), not replaced.
    """

    model: Model
    """The model that it was made for, and works with."""
    mass: wp.array
    """m_p in units of ``model.mass_unit``, (world, particle)."""
    mu: wp.array
    """Lamé's μ [Pa], (world, particle)."""
    lam: wp.array
    """Lamé's λ [Pa], (world, particle)."""
    pull: wp.array | None = None
    """Activation times strength [Pa], (world, muscle); None without muscles."""
    work: Substep = field(init=False)

    def __post_init__(self):
        model, struct = self.model, Solid.fixed(self.model)
        real = types(model.spec.dim, model.spec.dtype).real
        for name, array in self.arrays().items():
            size = model.muscle_count if name == "pull" else model.particle_count
            _check_array(model, name, array, size, real)
            setattr(struct, name, array)
        object.__setattr__(self, "work", Substep(model, struct))

    def differentiable(self) -> list[wp.array]:
        return list(self.arrays().values())

    def arrays(self) -> dict[str, wp.array]:
        """Every array by its name."""
        names = ("mass", "mu", "lam", "pull")
        return {name: getattr(self, name) for name in names[: 4 if self.model.muscle_count else 3]}

    def raise_failure(self, model: Model, state: WarpState) -> None:
        """Raise :class:`softmpm.UnstableError` if a step so far failed. Waits for the device.

        Checks ``state``, which the last step gave, for torn bodies and the running step limit as well.
        """
        check_own(model, "raise_failure", solid=self, state=state)
        mass, mu, lam = (wp.to_torch(array) for array in (self.mass, self.mu, self.lam))
        pull = None if self.pull is None else wp.to_torch(self.pull)
        _raise_failure(model, state, self.work, Solid(mass, mu, lam, pull), pull)


@on_its_gpu
def _raise_failure(model: Model, state: WarpState, work: Substep, given: Solid, pull: Tensor | None) -> None:
    work.stream = stream_of(model.device)
    end = work.leave(state.struct(model))
    if armed(model):
        check_end(model, work.solid, end, work.words_array, work.last)
    raise_failure(model, work.words.tolist(), end, solid=given, pull=pull)


def _owned(tensor: Tensor, dtype, requires_grad: bool) -> wp.array:
    """A Warp array on a tensor of its own, with a gradient of its own."""
    array = view(tensor.clone(memory_format=torch.contiguous_format), dtype)
    array.requires_grad = requires_grad
    return array


def check_own(model: Model, wants: str, **given: WarpState | WarpSolid) -> None:
    """Raise unless these are the model's own: the kernels trust shapes and types."""
    check_model(model, wants)
    for name, held in given.items():
        kind, make = (WarpSolid, "warp_solid") if name == "solid" else (WarpState, "warp_state")
        if not isinstance(held, kind):
            raise TypeError(
                f"{name} must be a softmpm.{kind.__name__}, as softmpm.{make} gives it, got {type(held).__name__}."
            )
        if held.model is not model:
            raise ValueError(f"{name} belongs to another model; make one with softmpm.{make}(model).")


def _check_array(model: Model, name: str, array: object, size: int, dtype: type) -> None:
    """Raise unless this is an array of the shape (world, size) and of this type on the model's device."""
    if not isinstance(array, wp.array):
        raise TypeError(f"{name} must be a warp.array, got {type(array).__name__}.")
    shape = (model.worlds, size)
    if array.shape != shape or array.dtype is not dtype or array.device != model.wp_device:
        raise ValueError(
            f"{name} must be {_kind(shape, dtype)} on {model.wp_device}, got {_kind(array.shape, array.dtype)} on {array.device}; "
            "softmpm.warp_state and softmpm.warp_solid make such arrays."
        )


def _kind(shape: tuple[int, ...], dtype: Any) -> str:
    """As PyTorch would see it: the axes of vectors and matrices last."""
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    return f"{(*shape, *getattr(dtype, '_shape_', ()))} of {scalar.__name__}"


def warp_state(model: Model, state: State | None = None, *, requires_grad: bool = False) -> WarpState:
    """A :class:`WarpState` that holds ``state``, or the rest state if None.

    Raises:
        TypeError, ValueError: As :func:`softmpm.simulate`, for the model and the state.
        UnstableError: A particle is off the grid.
    """
    check_model(model, "warp_state")
    if state is not None:
        check_state(model, state)
        if not is_capturing(model):
            check_finite(state, None)
    return _warp_state(model, model.rest() if state is None else state, requires_grad)


@on_its_gpu
def _warp_state(model: Model, state: State, requires_grad: bool) -> WarpState:
    t = types(model.spec.dim, model.spec.dtype)
    motion, work = Motion.empty(model), Substep(model, None)
    work.enter(state, motion.struct(model))
    raise_failure(model, work.words.tolist(), state)
    return WarpState(
        model=model,
        base=_owned(motion.base, t.ivec, False),
        fx=_owned(motion.fx, t.vec, requires_grad),
        v=_owned(motion.v, t.vec, requires_grad),
        C=_owned(motion.C, t.mat, requires_grad),
        H=_owned(motion.H, t.mat, requires_grad),
        fx_low=None if motion.fx_low is None else _owned(motion.fx_low, t.vec, False),
    )


def torch_state(model: Model, state: WarpState) -> State:
    """The :class:`softmpm.State` that a :class:`WarpState` of this model holds, in new tensors."""
    check_own(model, "torch_state", state=state)
    return _torch_state(model, state)


@on_its_gpu
def _torch_state(model: Model, state: WarpState) -> State:
    return Substep(model, None).leave(state.struct(model))


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

    Raises:
        TypeError, ValueError: As :func:`softmpm.simulate`, for the model, the material and the activation.
    """
    check_model(model, "warp_solid")
    params = model.params() if params is None else params
    check_params(model, params)
    check_row(model, activation)
    if not is_capturing(model):
        check_bounds(params, params.density * model.volume, model.mass_unit)
        check_finite(None, activation)
    return _warp_solid(model, params, activation, requires_grad)


@on_its_gpu
def _warp_solid(model: Model, params: Params, activation: Tensor | None, requires_grad: bool) -> WarpSolid:
    real, lead = types(model.spec.dim, model.spec.dtype).real, (model.worlds, model.particle_count)
    mu, lam = (term.expand(lead) for term in lame(Params(*(p.expand(lead) for p in params))))
    mass = masses(model, params).expand(lead)
    pull = None
    if model.muscle_count:
        if activation is None:
            activation = torch.zeros(model.worlds, model.muscle_count, dtype=model.dtype, device=model.device)
        pull = (activation * model.strength).detach()
    mass, mu, lam = (_owned(tensor.detach(), real, requires_grad) for tensor in (mass, mu, lam))
    pull = None if pull is None else _owned(pull, real, requires_grad)
    return WarpSolid(model=model, mass=mass, mu=mu, lam=lam, pull=pull)
