"""The same substep for users of Warp: :func:`step` works on Warp arrays and records its explicit adjoint on a ``wp.Tape``.

solid = softmpm.warp_solid(model, params, activation, requires_grad=True)
states = [softmpm.warp_state(model, start, requires_grad=True), softmpm.warp_state(model, requires_grad=True)]
tape = wp.Tape()
softmpm.step(model, states[0], states[1], solid, tape=tape)
tape.backward(grads={states[1].v: ...})             # fills states[0].v.grad, solid.mu.grad, ...

States hold the particles in the moving formulation and the nodes in the reference formulation.
"""

from typing import Any, cast

import numpy as np
import warp as wp
from torch import Tensor

from softmpm.errors import MAX_SUBSTEP
from softmpm.inputs import groups
from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.device import on_its_gpu, stream_of
from softmpm.schemes.inputs import Accumulators, InputsAdj
from softmpm.schemes.lagrangian.nodal_step import NodalStep
from softmpm.warp_arrays import WarpSolid, WarpState, check_own
from softmpm.warp_nodal import WarpNodal


def step(
    model: Model,
    state_in: WarpState | WarpNodal,
    state_out: WarpState | WarpNodal,
    solid: WarpSolid,
    *,
    substep: int = 0,
    tape: wp.Tape | None = None,
) -> None:
    """Advance by one substep of ``model.scene.dt``, a control step of its own, on PyTorch's current stream.

    A failure raises nothing here: its world stays as it is from then on. ``solid.raise_failure(model, state_out)`` raises it; it waits
    for the device, so call it once in a while, and checks what a step does not: broken bodies and the stable step.

    Args:
        state_in, state_out: From :func:`warp_state`; two different ones. With a tape both need ``requires_grad=True``,
            and neither may be written again before ``tape.backward()``.
        solid: From :func:`warp_solid`. With a tape it may not be written again before ``tape.backward()`` either, on which it raises
            RuntimeError: where an input changes from step to step, each value takes a solid of its own.
        substep: Number of this step, from 0 on, for the message of a failure.
        tape: Where the adjoint is recorded. It adds into ``.grad`` of ``state_in`` and ``solid``; ``tape.zero()`` clears.

    Raises:
        TypeError, ValueError: A state or ``solid`` is of another model or has other arrays; the two states are the same; a tape is
            given and an array carries no gradient.
        RuntimeError: A CUDA graph is being captured, and the model is deterministic or of the reference formulation.
    """
    check_own(model, "step", solid=solid, state_in=state_in, state_out=state_out)
    if state_in.v.ptr == state_out.v.ptr:
        raise ValueError(
            "state_in and state_out must be two different states, each with arrays of its own; make another with "
            "softmpm.warp_state."
        )
    whole = isinstance(substep, (int, np.integer)) and not isinstance(substep, bool)
    if not whole or not 0 <= substep <= MAX_SUBSTEP:
        raise ValueError(f"substep must be a whole number from 0 to {MAX_SUBSTEP:,}, got {substep!r}.")
    arrays = [*state_in.differentiable(), *state_out.differentiable(), *solid.differentiable()]
    if tape is not None and any(array.grad is None for array in arrays):
        raise ValueError(
            "with a tape, states and solid need requires_grad=True; give it to warp_state and warp_solid."
        )
    _advance(model, state_in, state_out, solid, int(substep))
    if tape is not None:
        then = None if is_capturing(model) else solid.fingerprint()
        tape.record_func(lambda: _adjoint(model, state_in, state_out, solid, substep, then), arrays)


@on_its_gpu
def _advance(model: Model, state_in: Any, state_out: Any, solid: WarpSolid, substep: int) -> None:
    work = solid.work
    work.stream = stream_of(model.device)
    if isinstance(work, NodalStep):
        work.advance(state_in.nodal(), state_out.nodal(), solid.values(), substep)
    else:
        states = (state_in.struct(model), state_out.struct(model))
        work.step(*states, state_in.surface(), state_out.surface(), substep)


@on_its_gpu
def _adjoint(
    model: Model, state_in: Any, state_out: Any, solid: WarpSolid, substep: int, then: Tensor | None
) -> None:
    if then is not None and not is_capturing(model):
        solid.check_unchanged(then)
    work, wanted = solid.work, RequestedGrads(groups(model.spec))
    work.stream = stream_of(model.device)
    if isinstance(work, NodalStep):
        now, adj_then = state_in.nodal(), state_out.adj()
        adj, adj_inputs = work.adjoint(now, adj_then, solid.values(), wanted, substep)
        for grad, found in zip(state_in.adj().differentiable(), adj.differentiable(), strict=True):
            grad += found
    else:
        adj_inputs = _adjoint_of_particles(model, work, state_in, state_out, wanted, substep)
    arrays = solid.arrays()
    for one in adj_inputs.inputs:
        adj = adj_inputs.tensors[one.name]
        grad = wp.to_torch(cast(wp.array, arrays[one.name].grad))
        grad += adj[0] if one.rows else adj


def _adjoint_of_particles(
    model: Model, work: Any, state_in: Any, state_out: Any, wanted: RequestedGrads, substep: int
) -> InputsAdj:
    """Adjoint of a substep of the moving formulation, added to that of ``state_in``; returns that of the inputs."""
    found, adj_inputs = Accumulators(model, wanted, 1, model.node_count), InputsAdj(model, wanted, 1)
    now, then = state_in.struct(model), state_out.struct(model)
    structs = found.particle_struct(), found.grid_struct()
    particles = (now, then, state_out.adj_struct(model), state_in.adj_struct(model))
    surface = state_in.surface(), state_out.adj_surface()
    adj_surface = work.step_adj(wanted, particles, structs, *surface, substep)
    if adj_surface is not None:
        for grad, adj in zip(state_in.adj_surface() or (), adj_surface, strict=True):
            grad += adj
    found.collect(0, model.fixed, work.launch)
    adj_inputs.add(found, slice(0, 1))
    adj_inputs.add_particles(found, slice(0, 1))
    return adj_inputs
