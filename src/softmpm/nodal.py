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
    u, v = (field[:, grid.stencil] for field in nodes)  # (world, particle, node, dim)
    eye = torch.eye(model.dim, dtype=model.dtype, device=model.device)
    x = model.positions + torch.einsum("wpnd,pn->wpd", u, weights)
    F = eye + torch.einsum("wpnd,pne->wpde", u, slopes)
    rate = torch.einsum("wpnd,pne->wpde", v, slopes)
    # C F = Ḟ:
    C = torch.linalg.solve(F.transpose(-1, -2), rate.transpose(-1, -2)).transpose(-1, -2)
    return State(x, torch.einsum("wpnd,pn->wpd", v, weights), C, F, nodes=nodes)


def nodes_of(model: Model, state: State, mass: Tensor) -> Nodal:
    """Nodal state from the four fields of the particles (Q6).

    Args:
        mass: Mass of the particles in any unit, shape (world, particle).
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
    return Nodal(*(_added(grid, share[..., None] * field) / total for field in (u, v)))


def _added(grid, terms: Tensor) -> Tensor:
    """Sums over the particles of each node, shape (world, node, ...)."""
    total = terms.new_zeros(len(terms), grid.count, terms.shape[-1])
    return total.index_add(1, grid.stencil.reshape(-1), terms.flatten(1, 2))
