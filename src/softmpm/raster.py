"""Particles to grid for an observer, on tensors: launches of kernels/raster.py."""

import torch
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


def rasterize_nodes(model: Model, state: State) -> GridField:
    """Mass (world, *nodes) and velocity (world, *nodes, dim) of what :func:`softmpm.rasterize` sees."""
    step, _motion, now = _enter(model, state)
    node = torch.zeros(*step.nodes, model.dim + 1, dtype=model.dtype, device=model.device)
    mass, nodes = _arguments(model, node)
    step.launch(raster(model.dim, model.spec.dtype).splat, step.particles, model.scale, mass, now, nodes)
    node = node.view(model.worlds, *model.scene.grid.shape, model.dim + 1)
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
