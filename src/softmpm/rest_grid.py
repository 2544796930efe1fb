"""Interpolation of the reference formulation: the nodes around the particles at rest, found once when a model is built.

With X_p a particle and X_i a node at rest, N_i(X_p) the quadratic B-spline of the node and g_ip = (4/dx²) N_i (X_i − X_p) its gradient
as in MLS-MPM (Hu et al. 2018). Derivation: docs/math/lagrangian.md.
"""

import itertools

import numpy as np
import torch
from torch import Tensor

from softmpm.scene.scene import Scene


class RestGrid:
    """Nodes that particles at rest have a share in, and cells: particles with the same base node.

    Attributes:
        count: Number of nodes.
        nodes: Coordinates of the nodes in the grid, shape (node, dim), int32.
        index: Number of each node in the grid, shape (node,).
        fraction: Distance of each particle from its base node in cells, cell by cell, shape (particle, dim), float64.
        particles: Particles cell by cell, shape (particle,), int32.
        first: First entry of each cell in ``particles``, and their count, shape (cell + 1,), int32.
        cell_nodes: Nodes of each cell, shape (cell, 3^dim), int32.
        node_cells: Cell in which a node is number k of ``cell_nodes``, or -1, shape (node, 3^dim), int32.
        members: Entries of ``stencil``, flat, that each node has, filled up with their count, shape (node, most).
        stencil: Nodes of each particle, in the order of the particles, shape (particle, 3^dim).
        weights: N_i(X_p), shape (particle, 3^dim), float64.
        arms: X_i − X_p [m], shape (particle, 3^dim, dim), float64.
        slopes: g_ip [1/m], of the same shape.
        middle: A node with many particles near the middle of them all.
    """

    def __init__(self, scene: Scene, device: torch.device):
        grid, dim = scene.grid, scene.grid.dim
        positions = np.concatenate([body.particles.positions for body in scene.bodies])
        offsets = np.array(list(itertools.product(range(3), repeat=dim)))
        base, f, weights = stencils(positions / grid.spacing, offsets)
        cells, of = np.unique(base, axis=0, return_inverse=True)
        of = of.reshape(-1)
        at = np.ravel_multi_index(tuple(np.moveaxis(cells[:, None] + offsets, -1, 0)), grid.shape)
        index, numbers = np.unique(at, return_inverse=True)
        numbers = numbers.reshape(at.shape)
        node_cells = np.full((len(index), len(offsets)), -1)
        node_cells[numbers, np.arange(len(offsets))] = np.arange(len(cells))[:, None]
        order = np.argsort(of, kind="stable")

        def integers(values) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, dtype=np.int32)).to(device)

        def numbers_of(values) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(device)

        self.count, self.cell_count = len(index), len(cells)
        self.index = numbers_of(index)
        self.nodes = integers(np.stack(np.unravel_index(index, grid.shape), axis=-1))
        self.fraction, self.particles = numbers_of(f[order]), integers(order)
        self.first = integers(np.searchsorted(of[order], np.arange(len(cells) + 1)))
        self.cell_nodes, self.node_cells = integers(numbers), integers(node_cells)
        self.stencil, self.weights = numbers_of(numbers[of]), numbers_of(weights)
        self.members = numbers_of(grouped(numbers[of].reshape(-1), len(index)))
        self.arms = numbers_of((offsets - f[:, None]) * grid.spacing)
        self.slopes = 4.0 / grid.spacing**2 * self.weights[..., None] * self.arms
        share = np.bincount(numbers[of].reshape(-1), weights.reshape(-1), minlength=len(index))
        nodes = np.stack(np.unravel_index(index, grid.shape), axis=-1) * grid.spacing
        away = np.linalg.norm(nodes - positions.mean(axis=0), axis=1)
        self.middle = int(np.where(share > 0.5 * share.max(), away, np.inf).argmin())


def stencils(places: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base node, distance from it, and B-spline weights of the 3^dim nodes around each place, all in cells.

    Args:
        places: Shape (point, dim).
        offsets: Offsets of the nodes from the base node, shape (3^dim, dim).
    """
    base = np.floor(places - 0.5).astype(np.int64)
    f = places - base
    splines = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])
    weights = np.prod([splines[offsets[:, axis], :, axis] for axis in range(f.shape[1])], axis=0).T
    return base, f, weights


def grouped(owners: np.ndarray, count: int) -> np.ndarray:
    """Positions of each owner 0 … count − 1 in a list of owners, one row each, filled up with the length of the list."""
    order, sizes = np.argsort(owners, kind="stable"), np.bincount(owners, minlength=count)
    rows = np.full((count, sizes.max()), len(owners))
    rows[np.arange(rows.shape[1]) < sizes[:, None]] = order
    return rows
