"""Nodes of the fast scheme as contact at surface points takes them: views of the four numbers of each node, (x, y[, z], further)."""

import warp as wp
from torch import Tensor

from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import view


def packed_nodes(model: Model, nodes: Tensor) -> wp.array:
    """View (world, node) of the vector and the number at each node."""
    t = types(model.spec.dim, model.spec.dtype)
    return view(_by_world(model, nodes)[..., : t.dim + 1], t.node)


def vectors(model: Model, nodes: Tensor) -> wp.array:
    """View (world, node) of the vector at each node."""
    t = types(model.spec.dim, model.spec.dtype)
    return view(_by_world(model, nodes)[..., : t.dim], t.vec)


def _by_world(model: Model, nodes: Tensor) -> Tensor:
    return nodes.view(model.worlds, -1, 4)
