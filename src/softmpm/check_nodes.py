"""Rules of a state with nodes that meets a model: the particles show its nodes, gradients reach them, clamps allow them.

Each message names the rule, the value received and a remedy.
"""

import torch
from torch import Tensor

from softmpm.state import State
from softmpm.validate import need


def check_shown(apart: Tensor) -> None:
    """The four tensors of a state are what its nodes show. Reads back once: a GPU has to wait.

    Args:
        apart: Largest differences of x, v, C and F, shape (4,).
    """
    for name, distance in zip(State._fields, apart.tolist(), strict=False):
        need(
            distance == 0.0,
            f"state.{name} was changed, but state.nodes was not, from which a call continues: they differ by {distance:g}; take "
            "state._replace(nodes=None), whose nodes are computed from x, v, C and F.",
        )


def check_gradients_of_nodes(state: State) -> None:
    """Raise ValueError if a gradient with respect to the particles of a state would be lost, since a call starts from its nodes."""
    nodes = state.nodes
    if nodes is None or not torch.is_grad_enabled() or nodes.u.requires_grad or nodes.v.requires_grad:
        return
    for name, tensor in zip("xvCF", state[:4], strict=True):
        need(
            not tensor.requires_grad,
            f"state.{name} requires a gradient, but state.nodes, from which a call continues, does not; take "
            "state._replace(nodes=None), whose nodes are computed from x, v, C and F.",
        )


def check_reflected(apart: Tensor) -> None:
    """Nodes of a state are their own images in clamps and symmetries, from which they differ by this. Reads back once."""
    need(
        not bool(apart > 0),
        f"state.nodes must be zero or reflected at clamps and planes of symmetry, got {float(apart):g} besides; take "
        "state._replace(nodes=None), whose nodes are computed from x, v, C and F.",
    )
