"""Nodes of the fast scheme as contact at surface points takes them: views of the four numbers of each node, (x, y[, z], further).

Beside the velocity lies the load, which the grid stage clears with it; beside the adjoint of the velocity lies what contact adds to
that of the mass, which the adjoint of the grid stage takes up.
"""

import warp as wp
from torch import Tensor

from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import view
from softmpm.schemes.carried import Nodes


def contact_nodes(model: Model, node: Tensor, velocity: Tensor) -> Nodes:
    """Views of mass and momentum, and of velocity and load; shapes (node of all worlds, 4)."""
    t = types(model.spec.dim, model.spec.dtype)
    return Nodes(view(by_world(model, node)[..., : t.dim + 1], t.node), *vector_and_number(model, velocity))


def vector_and_number(model: Model, nodes: Tensor) -> tuple[wp.array, wp.array]:
    """Views (world, node) of the vector at each node and of the number beside it."""
    t, nodes = types(model.spec.dim, model.spec.dtype), by_world(model, nodes)
    return view(nodes[..., : t.dim], t.vec), view(nodes[..., t.dim], t.real)


def by_world(model: Model, nodes: Tensor) -> Tensor:
    return nodes.view(model.worlds, -1, 4)
