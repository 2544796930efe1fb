"""Transfers between particles and grid in plain PyTorch: the truth in tests; no code shared with kernels.

Derivation: docs/math/transfer.md.
"""

import itertools
import math

import torch
from torch import Tensor

from softmpm.scene.scene import Scene


def stencil(scene: Scene, x: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """For each of the 3^dim nodes near every particle: flat node index, weight and r = x_i − x_p (S1)."""
    dx, shape = scene.grid.spacing, scene.grid.shape
    base = torch.floor(x.detach() / dx - 0.5)
    outside = ~((base >= 0) & (base <= torch.tensor(shape) - 3)).all(-1)  # also where x is not a number
    if outside.any():
        first = tuple(outside.nonzero()[0].tolist())
        raise ValueError(
            f"particle {first[-1]} of world {first[0]} must stay half a cell inside the grid, got "
            f"x = {x[first].tolist()} m; make the grid larger or dt smaller."
        )
    nodes = []
    for offset in itertools.product(range(3), repeat=len(shape)):
        node = base + torch.tensor(offset, dtype=x.dtype)
        r = node * dx - x
        weight = spline(r / dx).prod(-1)
        flat = torch.zeros(x.shape[:-1], dtype=torch.int64)
        for axis, count in enumerate(shape):
            flat = flat * count + node[..., axis].long()
        nodes.append((flat, weight, r))
    return nodes


def spline(distance: Tensor) -> Tensor:
    """Quadratic B-spline of a distance in cells; |distance| ≤ 3/2 by the choice of the stencil."""
    d = distance.abs()
    return torch.where(d < 0.5, 0.75 - d**2, 0.5 * (1.5 - d) ** 2)


def p2g(scene: Scene, x: Tensor, mass: Tensor, momentum: Tensor, affine: Tensor) -> tuple[Tensor, Tensor]:
    """m_i = Σ w m_p and (mv)_i = Σ w (p + A r) (T1), shapes (world, node) and (world, node, dim)."""
    count = math.prod(scene.grid.shape)
    node_mass = x.new_zeros(len(x), count)
    node_momentum = x.new_zeros(len(x), count, x.shape[-1])
    for node, weight, r in stencil(scene, x):
        node_mass = node_mass.scatter_add(1, node, weight * mass)
        share = weight[..., None] * (momentum + (affine @ r[..., None])[..., 0])
        node_momentum = node_momentum.scatter_add(1, node[..., None].expand_as(share), share)
    return node_mass, node_momentum


def g2p(scene: Scene, x: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """v = Σ w v_i and C = Σ w v_i rᵀ / D (T2)."""
    v, C, D = torch.zeros_like(x), x.new_zeros(*x.shape, x.shape[-1]), scene.grid.spacing**2 / 4
    for node, weight, r in stencil(scene, x):
        share = weight[..., None] * velocity.gather(1, node[..., None].expand_as(x))
        v = v + share
        C = C + share[..., :, None] * r[..., None, :] / D
    return v, C
