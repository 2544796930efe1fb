"""The two representations of a state in the reference formulation: nodes, and the particles that show them. Differentiable.

    x = X + Σ N_i u_i,  v = Σ N_i v_i,  F = I + Σ u_i ⊗ g_i,  C = Ḟ F⁻¹ with Ḟ = Σ v_i ⊗ g_i          (Q5)
    u_i = Σ m_p N_i (x_p − X_p + (F_p − I)(X_i − X_p)) / m_i                                         (Q6)
    v_i = Σ m_p N_i (v_p + C_p F_p (X_i − X_p)) / m_i

(Q6) is exact for affine fields; what else particles hold is smoothed, as by P2G (APIC, Jiang et al. 2015). Derivation:
docs/math/lagrangian.md.
"""

import torch
from torch import Tensor

from softmpm.model import Model
from softmpm.state import Nodal, State


def particles_of(model: Model, nodes: Nodal) -> State:
    """What the particles show of a nodal state (Q5), which the result carries along."""
    grid = model.rest_grid
    weights, slopes = grid.weights.to(model.dtype), grid.slopes.to(model.dtype)
    u, v = (field[:, grid.stencil] for field in nodes[:2])  # (world, particle, node, dim)
    eye = torch.eye(model.dim, dtype=model.dtype, device=model.device)
    x = model.positions + torch.einsum("wpnd,pn->wpd", u, weights)
    F = eye + torch.einsum("wpnd,pne->wpde", u, slopes)
    rate = torch.einsum("wpnd,pne->wpde", v, slopes)
    return State(x, torch.einsum("wpnd,pn->wpd", v, weights), rate @ inverse(F), F, nodes=nodes)


def inverse(F: Tensor) -> Tensor:
    """Inverse of 2 × 2 or 3 × 3 matrices; PyTorch's own waits for a GPU, which no capture allows."""
    if F.shape[-1] == 2:
        (a, b), (c, d) = ([F[..., i, j] for j in range(2)] for i in range(2))
        adjugate = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
        return adjugate / (a * d - b * c)[..., None, None]
    a, b, c = F.unbind(-2)
    columns = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
    return torch.stack(columns, -1) / (a * columns[0]).sum(-1)[..., None, None]


def nodes_of(model: Model, state: State, mass: Tensor, normals: Tensor | None = None) -> Nodal:
    """Nodal state from the four fields of the particles (Q6).

    Args:
        mass: Mass of the particles in any unit, shape (world, particle).
        normals: Unit normals of all walls, shape (world, wall, dim); None takes the scene's.
    """
    grid = model.rest_grid
    share = mass[..., None] * grid.weights.to(model.dtype)  # (world, particle, node)
    arms = grid.arms.to(model.dtype)
    eye = torch.eye(model.dim, dtype=model.dtype, device=model.device)
    moved = state.x - model.positions
    moved = moved if state.low is None else moved + (state.low.x - model.rest_low)
    u = moved[:, :, None] + torch.einsum("wpde,pne->wpnd", state.F - eye, arms)
    v = state.v[:, :, None] + torch.einsum("wpde,pne->wpnd", state.C @ state.F, arms)
    total = _added(grid, share[..., None])
    total = torch.where(total > 0, total, 1.0)  # a node at the very edge of a spline has no mass
    u, v = (_added(grid, share[..., None] * field) / total for field in (u, v))
    anchors = _anchors(model, u, normals)
    return Nodal(u, v, anchors, torch.zeros_like(anchors))


def _anchors(model: Model, u: Tensor, normals: Tensor | None) -> Tensor:
    """Anchors of surface points that touch nothing yet: their places across the normal of each separating wall."""
    surface = model.surface
    if surface is None:
        return u.new_zeros(model.anchor_shape)
    x = surface_places(model, u)
    if normals is None:
        n = surface.normals.expand(len(u), -1, -1).to(u.dtype)
    else:
        n = normals[:, model.spec.surface_walls].to(u.dtype)
    return x[:, None] - torch.einsum("wpd,wkd->wkp", x, n)[..., None] * n[:, :, None]


def surface_places(model: Model, u: Tensor) -> Tensor:
    """Places of the surface points [m], shape (world, point, dim), from the displacements of the nodes (K2)."""
    surface = model.surface
    assert surface is not None, "the nodes meet the walls here"
    near = u[:, surface.stencil.long()]
    return surface.points.to(u.dtype) + torch.einsum("wpnd,pn->wpd", near, surface.weights.to(u.dtype))


def _added(grid, terms: Tensor) -> Tensor:
    """Sums over the particles of each node in a fixed order, shape (world, node, ...)."""
    flat = terms.flatten(1, 2)
    padded = torch.cat([flat, flat.new_zeros(len(flat), 1, flat.shape[-1])], 1)
    return padded[:, grid.members].sum(2)
