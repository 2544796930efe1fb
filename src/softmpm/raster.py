"""Particles to grid for an observer, on tensors: launches of kernels/raster.py."""

import torch
import warp as wp
from torch import Tensor

from softmpm.buffers import Motion, MotionAdj, view
from softmpm.failures import raise_failure
from softmpm.kernels.raster import raster
from softmpm.kernels.types import types
from softmpm.model import Model
from softmpm.replay import note, recording
from softmpm.state import GridField, State
from softmpm.step import Substep


def _enter(model: Model, state: State):
    """The state as kernels hold it, checked; F does not enter and is taken as I."""
    eye = torch.eye(model.dim, dtype=model.dtype, device=model.device)
    state = state._replace(F=eye.expand_as(state.C))
    step, motion = Substep(model, None), Motion.empty(model)
    struct = motion.struct(model)
    step.enter(state, struct)
    if recording(model):
        note(step.watch_words)
    else:
        raise_failure(model, step.watch_words.tolist(), state)
    return step, motion, struct


def _arguments(model: Model, node: Tensor):
    t = types(model.spec.dim, model.spec.dtype)
    return view(model.mass, t.real), view(node, t.node)


def _units(model: Model, mass: Tensor, motion: Motion) -> Tensor:
    """Units of momentum and mass in which no sum over a world's particles overflows 62 bits, powers of two, (world, 2)."""
    speed = motion.v.abs().amax(-1) + 2 * model.scene.grid.spacing * motion.C.abs().sum(-1).amax(-1)
    largest = torch.stack([(mass * speed).amax(1), mass.amax().expand(model.worlds)], 1).double()
    return torch.frexp(largest * model.particle_count / 2.0**62).exponent.double().exp2()


def _sums(model: Model, step: Substep, motion: Motion, now) -> Tensor:
    """Momentum and mass of the nodes, (world, node, dim + 1)."""
    kernels, shape = raster(model.dim, model.spec.dtype), (*step.nodes, model.dim + 1)
    if not model.deterministic:
        node = torch.zeros(shape, dtype=model.dtype, device=model.device)
        mass, nodes = _arguments(model, node)
        step.launch(kernels.splat, step.particles, model.scale, mass, now, nodes)
        return node
    node = torch.zeros(shape, dtype=torch.int64, device=model.device)
    units = _units(model, model.mass, motion)
    arguments = (view(model.mass, types(model.dim, model.spec.dtype).real), view(units, wp.float64), now)
    step.launch(kernels.splat_fixed, step.particles, model.scale, *arguments, view(node, wp.int64))
    momentum, mass = (unit[:, None, None] for unit in units.unbind(1))
    return torch.cat([node[..., :-1] * momentum, node[..., -1:] * mass], -1).to(model.dtype)


def rasterize_nodes(model: Model, state: State) -> GridField:
    """Mass (world, *nodes) and velocity (world, *nodes, dim) of what :func:`softmpm.rasterize` sees."""
    step, motion, now = _enter(model, state)
    node = _sums(model, step, motion, now).view(model.worlds, *model.scene.grid.shape, model.dim + 1)
    mass = node[..., -1].clone()
    return GridField(mass, node[..., :-1] / torch.where(mass > 0, mass, 1)[..., None])


def rasterize_nodes_adj(model: Model, state: State, field: GridField, adj: GridField) -> State:
    """Adjoint of :func:`rasterize_nodes`, of x, v and C: p̄ = v̄/m, m̄ −= p̄·v, never a 1/m² that underflows; then (O1.adj)."""
    present = field.mass > 0
    adj_p = adj.velocity / torch.where(present, field.mass, 1)[..., None] * present[..., None]
    adj_m = adj.mass - (adj_p * field.velocity).sum(-1)
    adj_node = torch.cat([adj_p, adj_m[..., None]], -1).view(model.worlds, model.node_count, model.dim + 1)
    step, _motion, now = _enter(model, state)
    adj_state = MotionAdj.zeros(model)
    mass, nodes = _arguments(model, adj_node)
    kernel = raster(model.dim, model.spec.dtype).splat_adj
    step.launch(kernel, step.particles, model.scale, mass, now, nodes, adj_state.struct(model))
    return State(
        adj_state.fx / model.scene.grid.spacing, adj_state.v, adj_state.C, F=torch.zeros_like(adj_state.C)
    )
