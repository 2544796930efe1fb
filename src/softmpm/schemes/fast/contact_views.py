"""Nodes of the fast scheme as contact at surface points takes them: views of the four numbers of each node, (x, y[, z], further)."""

import warp as wp
from torch import Tensor

from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import view
from softmpm.schemes.carried import Nodes


def contact_nodes(model: Model, node: Tensor, velocities: Tensor, load: Tensor) -> Nodes:
    """Views of mass and momentum, of the velocities after and before contact, and of the loads."""
    velocity, free = (vectors(model, one) for one in velocities)
    return Nodes(packed_nodes(model, node), free, velocity, view(load, types(2, model.spec.dtype).real))


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
