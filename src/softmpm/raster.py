"""Particles to grid for an observer, on tensors: launches of kernels/raster.py."""

import torch
from torch import Tensor

from softmpm.buffers import Motion, MotionAdj, view
from softmpm.kernels.raster import raster
from softmpm.kernels.types import types
from softmpm.model import Model
from softmpm.rollout import raise_failure
from softmpm.state import State
from softmpm.step import Substep


def _enter(model: Model, state: State):
    """The state as kernels hold it, checked; F does not enter and is taken as I."""
    eye = torch.eye(model.dim, dtype=model.dtype, device=model.device)
    state = state._replace(F=eye.expand_as(state.C))
    step, motion = Substep(model, None), Motion.empty(model)
    struct = motion.struct(model)
    step.enter(state, struct)
    raise_failure(model, step.watch_words, state)
    return step, motion, struct


def _arguments(model: Model, node: Tensor):
    t = types(model.spec.dim, model.spec.dtype)
    mass = (model.params().density * model.volume).contiguous()
    return view(mass, t.real), view(node, t.node)


def splat(model: Model, state: State) -> Tensor:
    """Momentum and mass of every node, shape (world, node, dim + 1)."""
    step, _motion, now = _enter(model, state)
    node = torch.zeros(*step.nodes, model.dim + 1, dtype=model.dtype, device=model.device)
    mass, nodes = _arguments(model, node)
    step.launch(raster(model.dim, model.spec.dtype).splat, step.particles, model.scale, mass, now, nodes)
    return node


def splat_adj(model: Model, state: State, adj_node: Tensor) -> State:
    """Adjoint of :func:`splat`: of x, v and C."""
    step, _motion, now = _enter(model, state)
    adj = MotionAdj.zeros(model)
    mass, nodes = _arguments(model, adj_node.contiguous())
    kernel = raster(model.dim, model.spec.dtype).splat_adj
    step.launch(kernel, step.particles, model.scale, mass, now, nodes, adj.struct(model))
    return State(adj.fx / model.scene.grid.spacing, adj.v, adj.C, None)
