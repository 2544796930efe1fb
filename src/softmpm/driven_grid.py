"""Nodes at rest that driven particles hold in the reference formulation, found once when a model is built.

    V_i = Σ_p a_ip V_p,   a_ip = (ω_ip / Ω) [1 − (r_p − c)·S⁺ c],   r_p = (X_p − X_i) / dx                  (Q11)
    Ω = Σ ω_ip,   c = Σ ω_ip r_p / Ω,   S = Σ ω_ip (r_p − c) ⊗ (r_p − c) / Ω

Derivation: docs/math/lagrangian.md.
"""

import itertools
import math

import numpy as np
import torch

from softmpm.mirror_grid import MirrorGrid
from softmpm.rest_grid import RestGrid, bases, flat, spline, stencils
from softmpm.scene.scene import Scene
from softmpm.validate import need

LEAST = 1e-12
"""Least spline of a node that a particle holds: less is the rounding of places midway between nodes."""
SPREAD = 0.01
"""Least eigenvalue of S in whose direction the velocity varies [cells²]: a standard deviation of a tenth of a cell."""
STRETCH = 5 / 3
"""Of the spline ω where the particles that hold a node do not spread: its support reaches 2.5 cells instead of 1.5."""


class Sparse:
    """A matrix by rows.

    Attributes:
        rows: Their number.
        first: First entry of each row, and their count, shape (row + 1,), int32.
        column, value: Column and value of each entry, shape (entry,), int32 and float64.
    """

    def __init__(
        self,
        row: np.ndarray,
        column: np.ndarray,
        value: np.ndarray,
        rows: int,
        device: torch.device,
    ):
        order = np.lexsort((column, row))
        self.rows, first = rows, np.searchsorted(row[order], np.arange(rows + 1))
        self.first = torch.from_numpy(first.astype(np.int32)).to(device)
        self.column = torch.from_numpy(column[order].astype(np.int32)).to(device)
        self.value = torch.from_numpy(value[order]).to(device)


class DrivenGrid:
    """Nodes that driven particles hold.

    Attributes:
        count: Number of these nodes.
        nodes: Their numbers in the grid at rest, shape (driven node,), int32.
        held: True for these nodes, shape (node,).
        spread: The matrix a of (Q11), from driven particles to these nodes.
        transposed: Its transpose.
    """

    def __init__(self, scene: Scene, rest: RestGrid, mirror: MirrorGrid | None, device: torch.device):
        grid = scene.grid
        positions = scene.positions
        places = positions[np.asarray(scene.driven)] / grid.spacing
        offsets = np.array(list(itertools.product(range(3), repeat=grid.dim)))
        base, _, share = stencils(places, offsets)
        held = np.unique(flat(base[:, None] + offsets, grid.shape)[share > LEAST])
        node, particle, value = _entries(places, held, grid.shape)
        self.spread = Sparse(node, particle, value, len(held), device)
        self.transposed = Sparse(particle, node, value, len(places), device)
        index = rest.index.cpu().numpy()
        sorting = np.argsort(index)
        nodes = sorting[np.searchsorted(index[sorting], held)]
        self.count, self.nodes = len(held), torch.from_numpy(nodes.astype(np.int32)).to(device)
        self.held = torch.zeros(rest.count, dtype=torch.bool, device=device)
        self.held[self.nodes.long()] = True
        both = 0 if mirror is None else int((mirror.group[self.nodes.long()] >= 0).sum())
        need(
            both == 0,
            f"driven particles must be three cells or more from clamps and planes of symmetry, but {both} nodes belong to both; drive "
            "other particles, or take a wall of the kind 'stick' or 'slip'.",
        )


def _entries(
    places: np.ndarray, held: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Node, particle and value of each entry of a (Q11).

    Args:
        places: Of the driven particles in cells, shape (particle, dim).
        held: Nodes that they hold, numbers in the grid in ascending order.
        shape: Nodes of the grid.
    """
    node, particle, r = _pairs(places, held, shape, 0)
    value, spreads = _weights(node, r, spline(r).prod(axis=-1), len(held))
    few = np.flatnonzero(~spreads)
    keep = spreads[node]
    far, others, r = _pairs(places, held[few], shape, 1)
    wide, _ = _weights(far, r, spline(r / STRETCH).prod(axis=-1), len(few))
    parts = (node[keep], few[far]), (particle[keep], others), (value[keep], wide)
    row, column, value = (np.concatenate(pair) for pair in parts)
    return row, column, value


def _pairs(
    places: np.ndarray, nodes: np.ndarray, shape: tuple[int, ...], further: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Node, particle and r of each pair of a particle with a node of its stencil, or so many nodes further along each axis."""
    offsets = np.array(list(itertools.product(range(-further, 3 + further), repeat=len(shape))))
    at = bases(places)[0][:, None] + offsets
    inside = np.asarray(((at >= 0) & (at < shape)).all(axis=-1))
    number = flat(np.where(inside[..., None], at, 0), shape)
    found = np.searchsorted(nodes, number).clip(max=max(len(nodes) - 1, 0))
    particle, which = np.nonzero(inside & np.isin(number, nodes))
    return found[particle, which], particle, places[particle] - at[particle, which]


def _weights(node: np.ndarray, r: np.ndarray, omega: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """a of (Q11) for each pair, and for each node whether its particles spread in all directions."""

    def total(values: np.ndarray) -> np.ndarray:
        columns = values.reshape(len(values), math.prod(values.shape[1:])).T
        sums = [np.bincount(node, omega * column, count) for column in columns]
        return np.stack(sums, -1).reshape(count, *values.shape[1:])

    whole = total(np.ones(len(node)))
    c = total(r) / whole[:, None]
    apart = r - c[node]
    S = total(apart[:, :, None] * apart[:, None]) / whole[:, None, None]
    value, axes = np.linalg.eigh(S)
    spreads = np.asarray(value > SPREAD)
    inverse = np.where(spreads, 1.0 / np.where(spreads, value, 1.0), 0.0)
    slope = np.einsum("nik,nk,njk,nj->ni", axes, inverse, axes, c)
    return omega / whole[node] * (1.0 - (apart * slope[node]).sum(-1)), np.asarray(spreads.all(-1))
