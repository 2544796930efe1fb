"""The PyTorch boundary: what a user calls, as functions with an explicit adjoint; no kernel is launched here."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from softmpm.alarms import Failures
from softmpm.batches import (
    FirstOrder,
    FirstOrderAdjoint,
    keeps_graph,
    kinds,
    refuse_batches,
    refuse_other_kinds,
)
from softmpm.check_inputs import check_inputs, check_inputs_bounds, control_steps
from softmpm.check_state import check_finite, check_state
from softmpm.checks import check_activation, check_horizon
from softmpm.compiling import opaque
from softmpm.errors import at, place
from softmpm.inputs import Inputs, differentiable
from softmpm.kernel_inputs import derive
from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model, check_model
from softmpm.planning.chunks import Horizon
from softmpm.rasterization import rasterize_nodes, rasterize_nodes_adj
from softmpm.rollout import Trail, explain_out_of_memory, rollout, rollout_adj
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.inputs import Values
from softmpm.schemes.lagrangian.nodal import particles_of, start_of
from softmpm.schemes.surface_start import with_surface
from softmpm.state import GridField, Low, Nodal, Params, State, SurfaceState


def simulate(
    model: Model,
    start: State,
    activation: Tensor | None,
    params: Params,
    *,
    substeps: int,
    inputs: Inputs | None = None,
    failures: Failures | None = None,
) -> State:
    """Advance a soft robot, differentiably.

    Each row of ``activation`` drives ``substeps`` substeps: of MLS-MPM (Hu et al. 2018, Eq. 29) on the moving grid, of total Lagrangian
    MPM in the reference formulation. Second derivatives raise.

    Args:
        model: The model of the scene, from :func:`softmpm.build`.
        start: State at the first substep. Differentiable, never modified.
        activation: Activation of each muscle and pressure [-], shape (control_step, world, muscle); None is one control step without
            activation. Any size, but ``build`` has judged dt by at most 1. Differentiable.
        params: Material of each particle: ``young`` [Pa], ``poisson`` [-], ``density`` [kg/m³], shapes that broadcast
            to (world, particle). Differentiable. Quantities derived from parameters that need no gradient are cached by tensor
            identity and version. In-place writes through ``.data``, NumPy or Warp are not detected; pass a new tensor instead.
        substeps: Substeps of ``model.scene.dt`` [s] for each row of ``activation``.
        inputs: Gravity, friction, forces and other quantities that take the place of the scene's; see :class:`softmpm.Inputs`.
            Without activation they say how many control steps there are. Differentiable.
        failures: Counts the failures of single worlds, whose state is frozen or reset meanwhile; None raises the first.

    Returns:
        State after ``control_step * substeps * dt`` seconds, in new tensors.

    Raises:
        TypeError: ``model`` is not a :class:`softmpm.Model`, or ``failures`` no :class:`softmpm.Failures`.
        ValueError: An argument has a wrong shape, precision or device; names the rule and the value received.
        UnstableError: A particle became non-finite, collapsed or left the grid, numerical fracture occurred, dt is above the running
            stable step, a surface point is deep in a wall, or bodies pass through each other in the reference formulation
            (:class:`softmpm.Alarms`); names world, particle, substep and limit.
        torch.OutOfMemoryError: With a note of the estimated requirement. The backward pass may raise it and UnstableError as well.
    """
    return _simulate(model, start, activation, params, substeps, inputs, failures)


@opaque
def _simulate(
    model: Model,
    start: State,
    activation: Tensor | None,
    params: Params,
    substeps: int,
    inputs: Inputs | None,
    failures: Failures | None,
) -> State:
    if torch.is_inference_mode_enabled():  # buffers that stay with the model must be ordinary tensors
        with torch.inference_mode(False), torch.no_grad():
            return _simulate(model, start, activation, params, substeps, inputs, failures)
    check_model(model, "simulate")
    if not isinstance(failures, Failures | None):
        raise TypeError(
            f"failures must be a softmpm.Failures or None, got {failures!r}; softmpm.Failures('freeze') makes one."
        )
    start, activation, params = cast(model, start), cast(model, activation), cast(model, params)
    check_state(model, start)
    check_activation(model, activation)
    given = check_inputs(model, inputs)
    tensors = (
        *start.differentiable(),
        activation,
        *(params if isinstance(params, tuple) else ()),
        *given.values(),
    )
    refuse_batches(tensors)
    horizon = check_horizon(control_steps(activation, given), substeps)
    if not is_capturing(model):  # else nothing can be read back; NaN is reported by the kernels
        check_finite(start, activation)
        check_inputs_bounds(model, given)
    values = derive(model, start, activation, params, given, horizon)
    if model.formulation == "moving":
        if model.surface is not None:
            start = with_surface(model, start, values)
        return _run(model, horizon, start, values, failures)
    normals = values["normal"][0] if model.spec.moving else None  # at the beginning of the call
    nodes = start_of(model, start, values["mass"], normals)
    return particles_of(model, _run(model, horizon, nodes, values, failures))


def _run(model: Model, horizon: Horizon, start: Any, values: Values, failures: Failures | None) -> Any:
    """The final state, of the type of the initial one."""
    tensors = (*values.values(), *start.differentiable())
    needed = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    call = _Call(model, horizon, tuple(values), needed, failures)
    if not needed and not _has_transform_or_tangent(tensors):
        return call.run(start, values)
    simulated: Any = _Simulate.apply(call, *tensors, *call.rounding(start))
    return call.state(simulated)


def _has_transform_or_tangent(tensors: Iterable[Tensor | None]) -> bool:
    """True if a torch.func transform is active or a tensor carries a forward-mode tangent.

    If not, and no gradient is needed, PyTorch's preparations are skipped.
    """
    return torch._C._are_functorch_transforms_active() or any(
        t is not None and forward_ad.unpack_dual(t).tangent is not None for t in tensors
    )


def rasterize(model: Model, state: State) -> GridField:
    """Mass and velocity of the particles on the grid, as an observer sees them: P2G without forces (APIC, Jiang et al. 2015).

    Args:
        model: From :func:`softmpm.build`; its densities weigh the particles.
        state: What to look at. Differentiable in x, v and C; F does not enter.

    Returns:
        ``mass`` [kg] of shape (world, *nodes) and ``velocity`` [m/s] of shape (world, *nodes, dim), zero where there is no mass.

    Raises:
        TypeError, ValueError, UnstableError: As :func:`simulate`, for the model and the state, and in the backward pass for a
            gradient that is not finite.
    """
    return _rasterize(model, state)


@opaque
def _rasterize(model: Model, state: State) -> GridField:
    check_model(model, "rasterize")
    state = cast(model, state)
    check_state(model, state)
    refuse_batches(state[:3])
    return GridField(*_Rasterize.apply(model, state.x, state.v, state.C))


def cast(model: Model, value: Any) -> Any:
    """Under autocast, tensors in the model's precision: a policy then gives half precision without being asked."""
    if value is None or not torch.is_autocast_enabled(model.device.type):
        return value
    if isinstance(value, Tensor):
        return value.to(model.dtype) if value.is_floating_point() else value
    if isinstance(value, (Nodal, SurfaceState)):
        return value.to(model.dtype)
    if not isinstance(value, (State, Low, Params)):
        return value  # of a wrong type, which is refused by name
    return type(value)(*(cast(model, part) for part in value))


@dataclass(eq=False)
class _Call:
    """Data of one call that are no tensors, which PyTorch would track; receives the trail for its backward pass.

    Attributes:
        names: Of the inputs, in the order of the function's tensors.
    """

    model: Model
    horizon: Horizon
    names: tuple[str, ...]
    differentiable: bool
    failures: Failures | None
    place: str = field(default_factory=place)
    """Notes for the errors of its backward pass."""
    trail: Trail | None = None

    def state(self, tensors: Sequence) -> Any:
        """A state of the model's formulation from its tensors and those of its low-order parts."""
        if self.model.formulation == "reference":
            *found, shift, low = tensors
            return Nodal.of(found)._replace(shift=shift, low=low)
        *found, low_x, low_F = tensors
        return State.of(found)._replace(low=None if low_x is None else Low(low_x, low_F))

    @property
    def count(self) -> int:
        """Number of the tensors of a state that are differentiable."""
        if self.model.formulation == "reference":
            return 5
        return 4 if self.model.surface is None else 6

    def rounding(self, state: Any) -> tuple:
        """Parts of a state without a gradient: shift and ``low`` of nodes, or low-order parts of particles, or None."""
        return (state.shift, state.low) if isinstance(state, Nodal) else tuple(state.low or (None, None))

    def run(self, start: Any, values: Values) -> Any:
        """The end, after the trail is kept."""
        with explain_out_of_memory(self.model, self.horizon, self.differentiable):
            given = self.model, self.horizon, start, values, self.differentiable, self.failures
            end, self.trail = rollout(*given)
        return end

    def split(self, tensors: Sequence) -> tuple[Values, list]:
        """Inputs by name, and the tensors behind them."""
        count = len(self.names)
        return dict(zip(self.names, tensors[:count], strict=True)), list(tensors[count:])


class _Simulate(FirstOrder):
    """Of a :class:`_Call`, its inputs, the start and its low-order parts."""

    @staticmethod
    def forward(*given):
        # PyTorch binds arguments to the signature at each call, which takes longer the more of them have names.
        call, *tensors = given
        values, state = call.split(tensors)
        end = call.run(call.state(state), values)
        return (*end.differentiable(), *call.rounding(end))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.call, *tensors = inputs
        ctx.mark_non_differentiable(*(t for t in output[ctx.call.count :] if t is not None))
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors)  # all of them: PyTorch then tells if one was changed in place
        ctx.kinds = kinds(tensors)

    @staticmethod
    def backward(ctx, *adj_end):
        refuse_batches(adj_end)
        saved = ctx.saved_tensors  # each access unpacks them
        refuse_other_kinds(saved, ctx.kinds)
        needed = dict(zip(ctx.call.names, ctx.needs_input_grad[1:], strict=False))
        found = [one.group for one in differentiable(ctx.call.model.spec) if needed.get(one.name)]
        count = ctx.call.count
        given = ctx.call, RequestedGrads(tuple(dict.fromkeys(found))), *saved, *adj_end[:count]
        # It may be differentiated once more:
        again = torch.is_grad_enabled() or _has_transform_or_tangent(given[2:])
        backward = _SimulateBackward.apply if again else _SimulateBackward.forward
        return None, *backward(*given), *(len(adj_end) - count) * (None,)


class _SimulateBackward(FirstOrderAdjoint):
    @staticmethod
    def forward(*given):
        # The start is not read, the trail has it; it stands here so that a second derivative finds this function.
        call, wanted, *tensors = given
        values, state = call.split(tensors)
        kind: Any = Nodal if call.model.formulation == "reference" else State
        pairs = zip(state[-call.count :], state[: call.count], strict=True)
        adj_end = kind.of([torch.zeros_like(like) if adj is None else adj for adj, like in pairs])
        with explain_out_of_memory(call.model, call.horizon, gradient=True), at(call.place):
            adj, adj_inputs = rollout_adj(call.model, call.horizon, call.trail, values, adj_end, wanted)
        if not keeps_graph():
            call.trail = None  # PyTorch frees only what is saved with it, and refuses a second backward pass
        found = (adj_inputs.tensors.get(name) for name in call.names)
        exact = (
            adj if adj is None else adj.to(value.dtype)
            for adj, value in zip(found, values.values(), strict=True)
        )
        return *exact, *adj.differentiable()


class _Rasterize(FirstOrder):
    @staticmethod
    def forward(model, x, v, C):
        return rasterize_nodes(model, State(x, v, C, F=C))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.model, ctx.place = inputs[0], place()
        ctx.save_for_backward(*inputs[1:], *output)

    @staticmethod
    def backward(ctx, adj_mass, adj_velocity):
        refuse_batches((adj_mass, adj_velocity))
        with at(ctx.place):
            return None, *_RasterizeBackward.apply(ctx.model, adj_mass, adj_velocity, *ctx.saved_tensors)


class _RasterizeBackward(FirstOrderAdjoint):
    @staticmethod
    def forward(model, adj_mass, adj_velocity, x, v, C, mass, velocity):
        adj = rasterize_nodes_adj(
            model, State(x, v, C, F=C), GridField(mass, velocity), GridField(adj_mass, adj_velocity)
        )
        return adj.x, adj.v, adj.C
