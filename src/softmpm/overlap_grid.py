"""Volumes of the particles at rest, by which those that overlap are found in the reference formulation; once when a model is built.

Derivation: docs/math/alarms.md.
"""

import math

import numpy as np
import torch

from softmpm.rest_grid import RestGrid
from softmpm.scene.scene import Scene

FAR = 3.0
"""Particles farther from each other than this along an axis share no nodes at rest [cells]."""
TICKS = 64
"""Parts of a cell in which rest positions are compared roughly."""


class OverlapGrid:
    """Data of the particles for the check of a state, place by place, and sizes of the table of cells in which it finds those nearby.

    Attributes:
        corners: Entry of :attr:`RestGrid.window`, flat, with the first node around each place, shape (place,), int32.
        strides: Entries from one node to the next along each axis.
        positions: Rest positions [m], shape (place, dim), float64.
        half: Half the side of the cube of each particle's volume, times the alarm [m], shape (place,), float64.
        outer: Places in cells at rest next to an empty one, shape (outer place,), int32.
        ticks: Rest positions in parts of a cell, shape (place, dim), int32.
        reach: Largest distance along an axis at which a cube is looked for [m]: that of its faces, stretched to 2.5 times their
            distance, and that of its corners, stretched to 1.4 times (3D) or 1.8 times (2D).
        side: Side of the cells of the table [m]. A particle is compared with 2^dim of them.
        buckets: Number of buckets of the table of cells, a power of two, more than there are particles.
    """

    def __init__(self, scene: Scene, rest: RestGrid, alarm: float, device: torch.device):
        particles = [body.particles for body in scene.bodies]
        order = rest.order.cpu().numpy()
        positions = np.concatenate([one.positions for one in particles])[order]
        volume = np.concatenate([one.volume for one in particles])[order]
        half = 0.5 * alarm * volume ** (1.0 / scene.grid.dim)
        self.corners = torch.from_numpy(corners_of(rest)).to(device)
        window = rest.bricks.window
        self.strides = tuple(math.prod(window[axis + 1 :]) for axis in range(len(window)))
        self.positions = torch.from_numpy(positions).to(device)
        self.half = torch.from_numpy(half).to(device)
        outer = np.flatnonzero(at_the_surface(positions / scene.grid.spacing))
        self.outer = torch.from_numpy(outer.astype(np.int32)).to(device)
        ticks = np.round(positions / scene.grid.spacing * TICKS).astype(np.int32)
        self.ticks = torch.from_numpy(ticks).to(device)
        self.reach = 2.5 * float(half.max())
        self.side = 2.0 * self.reach
        self.buckets = 1 << len(positions).bit_length()


def overlap_grid(
    scene: Scene, rest: RestGrid, alarm: float | None, device: torch.device
) -> OverlapGrid | None:
    """None if no particles are far enough from each other to overlap, or without the alarm."""
    positions = scene.positions
    if alarm is None or (np.ptp(positions, axis=0) <= FAR * scene.grid.spacing).all():
        return None
    return OverlapGrid(scene, rest, alarm, device)


def corners_of(rest: RestGrid) -> np.ndarray:
    """See :attr:`OverlapGrid.corners`."""
    rows, places, corners = (tensor.cpu().numpy() for tensor in (rest.rows, rest.places, rest.corners))
    row, slot = np.nonzero(places >= 0)
    brick = np.repeat(np.arange(len(rows) - 1), np.diff(rows))[row]
    found = np.empty(len(row), dtype=np.int32)
    found[places[row, slot]] = brick * rest.bricks.nodes + corners[brick, slot % rest.bricks.cell_count]
    return found


def at_the_surface(places: np.ndarray) -> np.ndarray:
    """True for places [cells] in cells of which a neighbour, diagonal ones included, is empty."""
    cell = np.floor(places).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    inner = np.zeros(cell.max(axis=0) + 2, dtype=bool)
    inner[tuple(cell.T)] = True
    for axis in range(cell.shape[1]):
        line = np.moveaxis(inner, axis, 0)
        line[1:-1] = line[:-2] & line[1:-1] & line[2:]
    return ~inner[tuple(cell.T)]
