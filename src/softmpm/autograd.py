"""The PyTorch boundary. Nothing else mentions torch.autograd; no kernel is launched here."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from softmpm.alarms import Failures
from softmpm.batches import FORWARD, UNAVAILABLE, refuse_batches
from softmpm.checks import (
    check_activation,
    check_bounds,
    check_finite,
    check_horizon,
    check_params,
    check_state,
)
from softmpm.compiling import opaque
from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model, check_model
from softmpm.planning.chunks import Horizon
from softmpm.rasterization import rasterize_nodes, rasterize_nodes_adj
from softmpm.rollout import Trail, explain_out_of_memory, rollout, rollout_adj
from softmpm.schemes.buffers import Solid, lame, masses
from softmpm.schemes.capture import is_capturing
from softmpm.state import GridField, Low, Params, State

_SECOND = (
    "softmpm: second derivatives are not available (the adjoint is explicit and first order); "
    "call backward without create_graph=True."
)


def simulate(
    model: Model,
    start: State,
    activation: Tensor | None,
    params: Params,
    *,
    substeps: int,
    failures: Failures | None = None,
) -> State:
    """Advance a soft robot, differentiably.

    Each row of ``activation`` drives ``substeps`` MLS-MPM substeps (Hu et al. 2018, Eq. 29). Second derivatives raise.

    Args:
        model: The model of the scene, from :func:`softmpm.build`.
        start: State at the first substep. Differentiable, never modified.
        activation: Muscle activation [-], shape (control_step, world, muscle); None is one control step without
            activation. Differentiable.
        params: Material of each particle: ``young`` [Pa], ``poisson`` [-], ``density`` [kg/m³], shapes that broadcast
            to (world, particle). Differentiable. Quantities derived from parameters that need no gradient are cached by tensor
            identity and version. In-place writes through ``.data``, NumPy or Warp are not detected; pass a new tensor instead.
        substeps: Substeps of ``model.scene.dt`` [s] for each row of ``activation``.
        failures: Counts the failures of single worlds, whose state is frozen or reset meanwhile; None raises the first.

    Returns:
        State after ``control_step * substeps * dt`` seconds, in new tensors.

    Raises:
        TypeError: ``model`` is something else.
        ValueError: An argument has a wrong shape, precision or device; names the rule and the value received.
        UnstableError: A particle became non-finite, collapsed or left the grid, a body tore, or dt is above the running stable
            step (:class:`softmpm.Alarms`); names world, particle, substep and limit.
        torch.OutOfMemoryError: With a note of the estimated requirement. The backward pass may raise it and UnstableError as well.
    """
    return _simulate(model, start, activation, params, substeps, failures)


@opaque
def _simulate(
    model: Model,
    start: State,
    activation: Tensor | None,
    params: Params,
    substeps: int,
    failures: Failures | None,
) -> State:
    if torch.is_inference_mode_enabled():  # buffers that stay with the model must be ordinary tensors
        with torch.inference_mode(False), torch.no_grad():
            return _simulate(model, start, activation, params, substeps, failures)
    check_model(model, "simulate")
    start, activation, params = _cast(model, start), _cast(model, activation), _cast(model, params)
    check_state(model, start)
    check_activation(model, activation)
    refuse_batches((*start[:4], activation, *(params if isinstance(params, tuple) else ())))
    check_horizon(activation, substeps)
    if not is_capturing(model):  # else nothing can be read back; NaN is reported by the kernels
        check_finite(start, activation)
    mu, lam, mass = _material(model, params)
    pull, control_steps = None, 1
    if activation is not None:
        control_steps = activation.shape[0]
        if model.muscle_count:
            pull = (activation * model.strength).contiguous()
    elif model.muscle_count:
        pull = torch.zeros(1, model.worlds, model.muscle_count, dtype=model.dtype, device=model.device)
    low = start.low or (None, None)
    inputs = (pull, mu, lam, mass, *start[:4])
    needed = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs)
    call = _Call(needed, failures)
    simulated: Any = _Simulate.apply if needed or _has_transform_or_tangent(inputs) else _Simulate.forward
    end = simulated(model, Horizon(control_steps, substeps), call, *inputs, *low)
    return State(*end[:4], low=Low(*end[4:6]) if model.dtype == torch.float32 else None)


def _has_transform_or_tangent(tensors: Iterable[Tensor | None]) -> bool:
    """Whether a torch.func transform is active or a tensor carries a forward-mode tangent.

    If not, and no gradient is needed, the function's ``forward`` is called directly, which skips PyTorch's preparations.
    """
    return torch._C._are_functorch_transforms_active() or any(
        t is not None and forward_ad.unpack_dual(t).tangent is not None for t in tensors
    )


def _material(model: Model, params: Params) -> tuple[Tensor, Tensor, Tensor]:
    """μ, λ [Pa] and mass [model.mass_unit], (world, particle) each, of ``params`` that were checked.

    Those of the call before if nothing changed and nothing needs a gradient.
    """
    last, seen = model.workspace.get(_Last, _Last), _seen(model, params)
    if seen and seen == last.seen:
        return last.found
    check_params(model, params)
    if not is_capturing(model):  # else nothing can be read back
        check_bounds(params, params.density * model.volume, model.mass_unit)
    lead = (model.worlds, model.particle_count)
    mu, lam = (term.expand(lead).contiguous() for term in lame(params))
    found = mu, lam, masses(model, params).expand(lead).contiguous()
    if seen:
        last.params, last.seen, last.found = params, seen, found
    return found


class _Last:
    """Material of the call before in this thread: what another one computes may not be there yet, on a stream of its own."""

    params: Any = None  # held, so that nothing else takes their names in ``seen``
    seen: tuple = ()
    found: Any = None


def _seen(model: Model, params: Any) -> tuple:
    """Identity, version and address of the parameters; empty if a change could not be detected by them."""
    if is_capturing(model) or torch._C._are_functorch_transforms_active() or not isinstance(params, Params):
        return ()
    if not all(type(p) is Tensor and not p.requires_grad and not p.is_inference() for p in params):
        return ()
    return tuple((id(p), p._version, p.data_ptr()) for p in params)


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
    state = _cast(model, state)
    check_state(model, state)
    refuse_batches(state[:3])
    return GridField(*_Rasterize.apply(model, state.x, state.v, state.C))


def _cast(model: Model, value: Any) -> Any:
    """Under autocast, tensors in the model's precision: a policy then gives half precision without being asked."""
    if value is None or not torch.is_autocast_enabled(model.device.type):
        return value
    if isinstance(value, Tensor):
        return value.to(model.dtype) if value.is_floating_point() else value
    return type(value)(*(_cast(model, part) for part in value))


class _Call:
    """Data of one call that are no tensors, which PyTorch would track; receives the trail for its backward pass."""

    def __init__(self, differentiable: bool, failures: Failures | None):
        self.differentiable, self.failures = differentiable, failures
        self.trail: Trail | None = None


class _Function(torch.autograd.Function):
    """Base of the functions below: refuses the transforms that PyTorch offers besides the gradient."""

    @staticmethod
    def vmap(*_):
        raise RuntimeError(UNAVAILABLE)

    @staticmethod
    def jvp(*_):
        raise RuntimeError(FORWARD)


class _Simulate(_Function):
    @staticmethod
    def forward(*inputs):
        # PyTorch binds arguments to the signature at each call, which takes longer the more of them have names.
        model, horizon, call, pull, mu, lam, mass, x, v, C, F, low_x, low_F = inputs
        start = State(x, v, C, F, None if low_x is None else Low(low_x, low_F))
        solid, needed = Solid(mass, mu, lam, pull), call.differentiable
        with explain_out_of_memory(model, horizon, needed):
            end, call.trail = rollout(model, horizon, start, pull, solid, needed, call.failures)
        return (*end[:4], *(end.low or (None, None)))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.model, ctx.horizon, call, *tensors = inputs
        ctx.trail = call.trail
        ctx.mark_non_differentiable(*(t for t in output[4:] if t is not None))
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors)  # all of them: PyTorch then tells if one was changed in place

    @staticmethod
    def backward(ctx, *adj_end):
        refuse_batches(adj_end)
        wanted = RequestedGrads(material=any(ctx.needs_input_grad[4:7]), activation=ctx.needs_input_grad[3])
        about = ctx.model, ctx.horizon, ctx.trail, wanted
        inputs = *about, *ctx.saved_tensors, *adj_end[:4]
        # It may be differentiated once more:
        again = torch.is_grad_enabled() or _has_transform_or_tangent(inputs[4:])
        adj = (_SimulateBackward.apply if again else _SimulateBackward.forward)(*inputs)
        return None, None, None, *adj, None, None


class _SimulateBackward(_Function):
    """A function of its own, so that a second derivative raises instead of silently losing this term."""

    @staticmethod
    def forward(*inputs):
        # The start is not read, the trail has it; it stands here so that a second derivative finds this function.
        model, horizon, trail, wanted, pull, mu, lam, mass, *_start = inputs[:-4]
        adj_end = inputs[-4:]
        shapes = 2 * ((model.worlds, model.particle_count, model.dim),)
        shapes += 2 * ((*shapes[0], model.dim),)
        adj_end = State(
            *(
                mass.new_zeros(shape) if adj is None else adj
                for adj, shape in zip(adj_end, shapes, strict=True)
            )
        )
        solid = Solid(mass, mu, lam, pull)
        with explain_out_of_memory(model, horizon, gradient=True):
            adj, adj_solid, adj_pull = rollout_adj(model, horizon, trail, pull, solid, adj_end, wanted)
        return adj_pull, adj_solid.mu, adj_solid.lam, adj_solid.mass, *adj[:4]

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def backward(ctx, *adj):
        raise RuntimeError(_SECOND)


class _Rasterize(_Function):
    @staticmethod
    def forward(model, x, v, C):
        return rasterize_nodes(model, State(x, v, C, F=C))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.model = inputs[0]
        ctx.save_for_backward(*inputs[1:], *output)

    @staticmethod
    def backward(ctx, adj_mass, adj_velocity):
        refuse_batches((adj_mass, adj_velocity))
        return None, *_RasterizeBackward.apply(ctx.model, adj_mass, adj_velocity, *ctx.saved_tensors)


class _RasterizeBackward(_Function):
    """As :class:`_SimulateBackward`: a second derivative raises."""

    @staticmethod
    def forward(model, adj_mass, adj_velocity, x, v, C, mass, velocity):
        adj = rasterize_nodes_adj(
            model, State(x, v, C, F=C), GridField(mass, velocity), GridField(adj_mass, adj_velocity)
        )
        return adj.x, adj.v, adj.C

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def backward(ctx, *adj):
        raise RuntimeError(_SECOND)
