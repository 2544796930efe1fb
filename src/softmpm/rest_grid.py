"""Interpolation of the reference formulation: the nodes around the particles at rest, found once when a model is built.

With X_p a particle and X_i a node at rest, N_i(X_p) the quadratic B-spline of the node and g_ip = (4/dx²) N_i (X_i − X_p) its gradient
as in MLS-MPM (Hu et al. 2018). Derivation: docs/math/lagrangian.md.
"""

import itertools
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from softmpm.kernels.lagrangian.bricks import LARGEST_LATTICE, bricks_for
from softmpm.scene.check_scene import SAME
from softmpm.scene.scene import Grid, Scene


class RestGrid:
    """Nodes that particles at rest have a share in, and bricks of cells: boxes of particles that are summed together.

    The particles are ordered brick by brick, and the nodes by the first brick that has them in its window.

    Attributes:
        bricks: Size of the bricks.
        count: Number of nodes.
        nodes: Coordinates of the nodes in the grid, shape (node, dim), int32.
        index: Number of each node in the grid, shape (node,), int64.
        order: Particle at each place, shape (place,), int32.
        fraction: Distance of each particle from its base node in cells, place by place, shape (place, dim).
        rows: First row of each brick in ``places``, and their count, shape (brick + 1,), int32.
        places: Place of the particle in each slot of a row, or -1, shape (row, slot), int32. Slots count the
            cells of the brick first, then the particles of a cell; on a lattice these are layers, and rows are their particles.
        lattice: Places of the particles along each axis in every cell, shape (axis, place), or None.
        corners: First node of each of these cells in the window of its brick, or -1, shape (brick, cell), int32.
        window: Nodes of each brick, or -1 where there is none, shape (brick, node of the window), int32.
        shares: Entries of ``window``, flat, that are a node, or -1, shape (2^dim, node), int32.
        weight: Σ N of all particles, shape (node,), float64.
        middle: A node with many particles near the middle of them all.
    """

    def __init__(self, scene: Scene, device: torch.device, dtype: torch.dtype, worlds: int, loaded: bool):
        """``loaded`` says whether forces act on the particles, which lattices do not have."""
        grid, dim = scene.grid, scene.grid.dim
        positions = scene.positions
        base, fraction = bases(positions / grid.spacing)
        lattice, number_of = (None, None) if loaded else lattice_of(base, fraction)
        places = 0 if lattice is None else lattice.shape[1]
        bricks = bricks_for(dim, worlds * len(base), device, dtype, places)
        size, first = np.array(bricks.cells), base.min(axis=0)
        box, inside = np.divmod(base - first, size)
        boxes, brick = np.unique(box, axis=0, return_inverse=True)
        numbers = bricks.cell_numbers
        cell = numbers[tuple(inside.T)]

        # Cells, brick by brick, and particles, cell by cell
        cells, of = np.unique(brick.reshape(-1) * size.prod() + cell, return_inverse=True)
        of = of.reshape(-1)
        brick_of_cell, cell = np.divmod(cells, size.prod())
        corner = np.stack(np.unravel_index(np.argsort(numbers, axis=None)[cell], bricks.cells), axis=-1)
        turn = packed(brick_of_cell, cell)
        corners = np.full((len(boxes), size.prod()), -1)
        corners[brick_of_cell, turn] = flat(corner, bricks.window)
        order = np.argsort(of, kind="stable")
        if number_of is not None and bricks.lattice:
            number, heights = number_of, np.full(len(boxes), bricks.layer)
        else:
            number = np.empty(len(of), dtype=np.int64)
            number[order] = np.arange(len(of)) - np.searchsorted(of[order], np.arange(len(cells)))[of[order]]
            heights = np.zeros(len(boxes), dtype=np.int64)
            np.maximum.at(heights, brick_of_cell[of], number // bricks.parts + 1)
        rows = np.concatenate([[0], np.cumsum(heights)])
        row = rows[brick_of_cell[of]] + number // bricks.parts
        slot = number % bricks.parts * size.prod() + turn[of]
        order = np.argsort(row * bricks.slots + slot, kind="stable")
        places = np.full((rows[-1], bricks.slots), -1)
        places[row[order], slot[order]] = np.arange(len(order))

        # Nodes
        offsets = np.array(list(itertools.product(range(3), repeat=dim)))
        _, where = np.unique(of, return_index=True)
        held = np.unique(flat(base[where][:, None] + offsets, grid.shape))
        around = np.array(list(itertools.product(*map(range, bricks.window))))
        windows = first + boxes[:, None] * size + around
        within = (windows < grid.shape).all(axis=-1)
        at = np.where(within, flat(np.where(within[..., None], windows, 0), grid.shape), -1)
        found = np.isin(at, held)
        index, entry, node = np.unique(at[found], return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(entry, kind="stable"), kind="stable")
        window = np.full(at.shape, -1)
        window[found] = rank[node.reshape(-1)]
        index = index[np.argsort(rank)]
        entries = np.flatnonzero(found)
        owners = window.reshape(-1)[entries]
        by_node = np.argsort(owners, kind="stable")
        turn = (
            np.arange(len(owners)) - np.searchsorted(owners[by_node], np.arange(len(index)))[owners[by_node]]
        )
        shares = np.full((2**dim, len(index)), -1)
        shares[turn, owners[by_node]] = entries[by_node]

        def integers(values) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, dtype=np.int32)).to(device)

        self.bricks, self.count, self.brick_count = bricks, len(index), len(boxes)
        self.index = torch.from_numpy(index).to(device)
        self.nodes = integers(np.stack(np.unravel_index(index, grid.shape), axis=-1))
        self.order, self.rows, self.places = integers(order), integers(rows), integers(places)
        self.fraction = torch.from_numpy(fraction[order]).to(device, dtype)
        self.corners, self.window, self.shares = integers(corners), integers(window), integers(shares)
        self.lattice = lattice if bricks.lattice else None
        around = flat(base[:, None] + offsets, grid.shape).reshape(-1)
        share = np.bincount(around, stencils(positions / grid.spacing, offsets)[2].reshape(-1))[index]
        self.weight = torch.from_numpy(share).to(device)
        away = np.linalg.norm(self.nodes.cpu().numpy() * grid.spacing - positions.mean(axis=0), axis=1)
        self.middle = int(np.where(share > 0.5 * share.max(), away, np.inf).argmin())


def nodes_around(rest: RestGrid, places: Tensor, grid: Grid) -> Iterator[tuple[Tensor, Tensor]]:
    """Number and B-spline weight of each of the 3^dim nodes around the particles at rest, one node after the other.

    Args:
        places: Rest positions [m], shape (particle, dim), float64.

    Returns:
        Pairs of shape (particle,): numbers of nodes, int64, and weights, float64.
    """
    places = places / grid.spacing
    base = torch.floor(places - 0.5 + SAME)
    f = places - base
    splines = 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2
    index, number = rest.index.sort()
    for offset in itertools.product(range(3), repeat=len(grid.shape)):
        at, weight = torch.zeros_like(base[:, 0]), torch.ones_like(f[:, 0])
        for axis, k in enumerate(offset):
            at, weight = at * grid.shape[axis] + base[:, axis] + k, weight * splines[k][:, axis]
        yield number[torch.searchsorted(index, at.long())], weight


def lattice_of(base: np.ndarray, fraction: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Places of the particles along each axis, shape (axis, place), if they are the same in every cell, and the number of each particle
    in its cell; else None. No two particles may have one place."""
    axes, indices = [], []
    for one in fraction.T:
        order = np.argsort(one)
        new = np.diff(one[order], prepend=-1.0) > SAME
        if new.sum() > LARGEST_LATTICE:
            return None, None
        axes.append(one[order][new])
        index = np.empty(len(one), dtype=np.int64)
        index[order] = np.cumsum(new) - 1
        indices.append(index)
    count = len(axes[0])
    if any(len(found) != count for found in axes):
        return None, None
    number = np.asarray(np.ravel_multi_index(tuple(indices), (count,) * len(axes)))
    keys = np.unique(np.column_stack([base, number]), axis=0)
    return (None, None) if len(keys) < len(base) else (np.array(axes), number)


def packed(brick: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Slot of each cell in its brick, so that as few warps as possible have cells: those of a warp of the full brick stay in one warp,
    and share it with those of the next one if there is room.

    Args:
        brick: Number of the brick of each cell, in ascending order.
        cell: Number in the full brick, in ascending order within a brick.
    """
    warps, whole = cell.max() // WARP + 1, cell // WARP
    counts = np.bincount(brick * warps + whole, minlength=(brick.max() + 1) * warps).reshape(-1, warps)
    starts = np.zeros_like(counts)
    for w in range(1, warps):
        end = starts[:, w - 1] + counts[:, w - 1]
        room = -end % WARP
        starts[:, w] = end + np.where(counts[:, w] > room, room, 0)
    first = np.cumsum(counts) - counts.reshape(-1)
    of = brick * warps + whole
    return starts.reshape(-1)[of] + np.arange(len(cell)) - first[of]


WARP = 32
"""Threads of a warp."""


def bases(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Base node of each place and the distance from it, in cells. Places midway between nodes, where the third weight is zero on both
    sides, have the upper one.
    """
    base = np.floor(places - 0.5 + SAME).astype(np.int64)
    return base, places - base


def flat(coordinates: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of nodes in the grid, from their coordinates in the last axis."""
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(coordinates, -1, 0)), shape))


def spline(r: np.ndarray) -> np.ndarray:
    """Quadratic B-spline of distances in cells."""
    d = np.abs(r)
    return np.where(d < 0.5, 0.75 - d**2, 0.5 * np.maximum(1.5 - d, 0.0) ** 2)


def stencils(places: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base node, distance from it, and B-spline weights of the 3^dim nodes around each place, all in cells.

    Args:
        places: Shape (point, dim).
        offsets: Offsets of the nodes from the base node, shape (3^dim, dim).
    """
    base, f = bases(places)
    splines = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])
    weights = np.prod([splines[offsets[:, axis], :, axis] for axis in range(f.shape[1])], axis=0).T
    return base, f, weights
