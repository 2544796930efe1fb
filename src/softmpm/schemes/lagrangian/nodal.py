"""The two representations of a state in the reference formulation: nodes, and the particles that show them. Differentiable.

Its kernels are those of projection.py. Clamps and planes of symmetry then hold and reflect the nodes by (B1).
"""

from typing import Any

import torch
from torch import Tensor

from softmpm.check_nodes import check_gradients_of_nodes, check_projected, check_reflected, check_shown
from softmpm.compiling import opaque
from softmpm.model import Model
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.inputs import of_surface_walls
from softmpm.schemes.lagrangian.frame import quantum, shift_of
from softmpm.schemes.lagrangian.projection import Project, Show, apart
from softmpm.state import Nodal, State
from softmpm.surface_grid import SurfaceGrid


def particles_of(model: Model, nodes: Nodal) -> State:
    """State of the particles that belongs to a nodal state (Q5), which the result carries along."""
    shown: Any = Show.apply(model, nodes.u, nodes.v, shift_of(model, nodes))
    return State(*shown, nodes=nodes)


def nodes_of(model: Model, state: State, mass: Tensor, normals: Tensor | None = None) -> Nodal:
    """Nodal state from the four fields of the particles (Q6).

    Args:
        mass: Mass of the particles in any unit, shape (world, particle).
        normals: Unit normals of all walls, shape (world, wall, dim); None takes the scene's.
    """
    moved = state.x - _rest_places(model, state.low is not None)
    moved = moved if state.low is None else moved + state.low.x
    mean, step = moved.detach().mean(1), quantum(model)
    shift = torch.where(mean.abs() > step, step * (mean / step).round(), 0.0)
    moved = (moved - shift[:, None]).to(model.dtype)
    placed = mass.index_select(1, model.rest_grid.order)
    strain = state.F - torch.eye(model.dim, dtype=model.dtype, device=model.device)
    strain = strain if state.low is None else strain + state.low.F
    found: Any = Project.apply(model, moved, state.v, state.C, strain, placed)
    of_nodes, u, v = found
    if model.mirror is not None:
        u, v = model.mirror.reflected(of_nodes, u, v)
    anchors = _anchors(model, u, normals)
    return with_reaction(model, Nodal(u, v, anchors, torch.zeros_like(anchors), shift))


def start_of(model: Model, state: State, mass: Tensor, normals: Tensor | None = None) -> Nodal:
    """Nodal state that a call starts from, with all parts: that of the state, or :func:`nodes_of` its particles if it has none.

    Raises:
        ValueError: The particles do not show the nodes of the state, a gradient is asked for that of particles only, clamps do not
            allow the nodes, or no nodes show anything like the particles; values are not checked during a capture.
    """
    nodes = state.nodes
    if nodes is None:
        nodes = nodes_of(model, state, mass, normals)
        if not is_capturing(model):
            check_projected(model, state.detach(), particles_of(model, nodes.detach()))
    else:
        check_their_nodes(model, state)
    low = nodes.low
    if low is None:
        low = nodes.u.new_zeros(model.worlds, 2, *nodes.u.shape[1:])
    nodes = nodes._replace(shift=shift_of(model, nodes).detach(), low=low.detach())
    # Clamps and planes of symmetry are of the scene, so that no model of it gives a state a shift; moving walls are of the model.
    if model.spec.moving and model.mirror is None:
        nodes = _without_shift(model, nodes, normals)
    return with_reaction(model, nodes, nodes.reaction)


@opaque
def check_their_nodes(model: Model, state: State) -> None:
    """The particles of a state show its nodes; values are not checked during a capture.

    Raises:
        ValueError: As :func:`start_of`.
    """
    nodes = state.nodes
    assert nodes is not None
    check_gradients_of_nodes(state)
    if not is_capturing(model):
        check_shown(apart(model, state, particles_of(model, nodes.detach())))
        if model.mirror is not None:
            check_reflected(model.mirror.apart(nodes.u.detach(), nodes.v.detach()))


def _without_shift(model: Model, nodes: Nodal, normals: Tensor | None) -> Nodal:
    """The same state with displacements and anchors that contain the shift, for a model whose worlds are not translated."""
    shift, low = nodes.shift, nodes.low
    assert shift is not None and low is not None
    by = shift[:, None].to(nodes.u.dtype)
    u, before = nodes.u + by, nodes.u.detach()
    added = u.detach() - before
    rounded = (before - (u.detach() - added)) + (by - added)  # off the sum (Knuth's exact addition)
    low = torch.stack([low[:, 0] + rounded, low[:, 1]], dim=1)
    anchor = nodes.anchor
    if model.surface is not None:
        # Where the points adhere does not depend on the walls to come:
        n = _normals(model, normals, shift).detach()
        across = shift[:, None] - (shift[:, None] * n).sum(-1, keepdim=True) * n
        anchor = anchor + across[:, :, None].to(anchor.dtype)
    return nodes._replace(u=u, low=low, anchor=anchor, shift=torch.zeros_like(shift))


def _rest_places(model: Model, exact: bool) -> Tensor:
    """Places of the particles at rest in float64 [m], exact or as the model's precision rounds them."""

    def make() -> Tensor:
        rounded = model.positions.double()
        return rounded + model.rest_low.double() if exact else rounded

    return model.workspace.get((_rest_places, exact), make)


def with_reaction(model: Model, nodes: Nodal, reaction: Tensor | None = None) -> Nodal:
    """The state with these mean forces of clamps and planes of symmetry; None is zero."""
    return nodes._replace(reaction=nodes.u.new_zeros(model.reaction_shape) if reaction is None else reaction)


def _anchors(model: Model, u: Tensor, normals: Tensor | None) -> Tensor:
    """Anchors of surface points that touch nothing yet: their places across the normal of each separating wall."""
    surface = model.surface
    if surface is None:
        return u.new_zeros(model.anchor_shape)
    assert isinstance(surface, SurfaceGrid)
    x, n = surface.places(u), _normals(model, normals, u)
    return x[:, None] - (x[:, None] * n[:, :, None]).sum(-1, keepdim=True) * n[:, :, None]


def _normals(model: Model, normals: Tensor | None, like: Tensor) -> Tensor:
    """Unit normals of the walls that meet surface points, shape (world, wall, dim), from those of all walls or of the scene."""
    assert isinstance(model.surface, SurfaceGrid)
    if normals is None:
        return model.surface.normals.expand(model.worlds, -1, -1).to(like.dtype)
    return of_surface_walls(model, normals).to(like.dtype)
