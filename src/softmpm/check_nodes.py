"""Rules of a state that meets the nodes of a model: the particles show them, gradients reach them, clamps allow them.

Each message names the rule, the value received and a remedy.
"""

import torch
from torch import Tensor

from softmpm.checks import ModelLike
from softmpm.oracle.stress import det
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
    """Raise ValueError if a gradient with respect to the particles of a state would be lost, since a call starts from its nodes: they
    have no history, or a particle's tensor is a leaf, which only a user makes one."""
    nodes = state.nodes
    if nodes is None or not torch.is_grad_enabled():
        return
    shown = nodes.u.requires_grad or nodes.v.requires_grad
    for name, tensor in zip("xvCF", state[:4], strict=True):
        need(
            not tensor.requires_grad or (shown and not tensor.is_leaf),
            f"state.{name} requires a gradient, but a call continues from state.nodes, whose gradient does not reach it; take "
            "state._replace(nodes=None), whose nodes are computed from x, v, C and F.",
        )


def check_reflected(apart: Tensor) -> None:
    """Nodes of a state are their own images in clamps and symmetries, from which they differ by this. Reads back once."""
    need(
        not bool(apart > 0),
        f"state.nodes must be zero or reflected at clamps and planes of symmetry, got {float(apart):g} besides; take "
        "state._replace(nodes=None), whose nodes are computed from x, v, C and F.",
    )


ASTRAY = 0.5
"""Largest distance along an axis between a particle and where its nodes show it [cells]."""


def check_projected(model: ModelLike, given: State, shown: State) -> None:
    """The particles of a state without nodes are not inverted, and about where the nodes that were computed from them show them: these
    have one smooth displacement, by which a particle cannot be parted from its neighbours. Reads back once.

    Args:
        shown: What the nodes show.
    """
    dx, volume = model.scene.grid.spacing, det(given.F)
    way = (given.x - shown.x).abs().amax(-1) / dx
    farthest, least = torch.stack([way.max(), volume.min()]).tolist()
    if farthest > ASTRAY:
        world, p = _place(way, farthest)
        raise ValueError(
            f"in the reference formulation a state without nodes must be a smooth deformation of the rest shape, but particle {p} of "
            f"world {world} is {farthest:.3g} cells from where the displacement of its surroundings has it, more than {ASTRAY:g}; take "
            "positions nearer to the rest shape, or formulation='moving', whose bodies may tear."
        )
    collapse = model.alarms.collapse
    if collapse is not None and not least > collapse:
        world, p = _place(volume, least)
        raise ValueError(
            f"det state.F must be above {collapse:g}, but that of particle {p} of world {world} is {least:.4g}; start from a "
            "deformation gradient that is not inverted and less compressed, or set the limit with alarms=softmpm.Alarms(collapse=...)."
        )


def _place(values: Tensor, value: float) -> tuple[int, ...]:
    """World and particle of a value."""
    return tuple(torch.nonzero(values == value)[0].tolist())
