"""Where the fast scheme keeps things: particles in the order of their cells, and only the nodes around them.

Neither has to be exact. An order that has grown stale costs speed, never correctness, and is renewed when particles that stand
next to each other share their cell too rarely. The window is the part of the grid that is in memory, in each world at a place of
its own; a particle that is about to leave it is seen in time, one that does leave it stops the call, which then starts again
with a larger window. The cost of a substep follows the window, not the grid.
"""

import math

import torch
from torch import Tensor

from softmpm.buffers import view
from softmpm.kernels.types import types
from softmpm.memory import window_shape
from softmpm.model import Model

STALE = 1.3
"""Renew the order when going along it meets so many times more cells than when it was new."""


class Arrangement:
    """Order of the particles and window of the grid; moves in place, but for a window that must grow.

    Attributes:
        order: Particle at each place, shape (world, particle), int32.
        origin: First node of the window, shape (world, dim), int32.
        shape: Nodes of the window along each axis.
    """

    def __init__(self, model: Model, x: Tensor, least: tuple[int, ...] = ()):
        self.model = model
        self.fresh_cells: int | None = None
        self.stale = False
        self._grid = torch.tensor(model.scene.grid.shape, device=model.device)
        first, last = self._reach(x)
        grid = model.scene.grid.shape
        reach = [max(h - low for low, h in zip(*axis, strict=True)) for axis in zip(first, last, strict=True)]
        wide = window_shape(grid, reach)
        self.shape = tuple(min(n, max(w, k)) for n, w, k in zip(grid, wide, least or wide, strict=True))
        self._shape = torch.tensor(self.shape, device=model.device)
        self.order = torch.empty(model.worlds, model.particle_count, dtype=torch.int32, device=model.device)
        self.origin = torch.empty(model.worlds, model.dim, dtype=torch.int32, device=model.device)
        self.renew(x)

    @property
    def node_count(self) -> int:
        """Nodes of one world in memory."""
        return math.prod(self.shape)

    def _base(self, x: Tensor) -> Tensor:
        """First node of each particle's stencil, kept on the grid; shape (world, particle, dim)."""
        cells = torch.floor(x.double() / self.model.scene.grid.spacing - 0.5).nan_to_num(0.0)
        return torch.minimum(cells.clamp(min=0), self._grid - 3).long()

    def _reach(self, x: Tensor) -> tuple[list, list]:
        """Smallest and largest base in each axis and world; waits for the device."""
        base = self._base(x)
        both = torch.stack([base.amin(dim=1), base.amax(dim=1)]).tolist()
        first, last = ([list(axis) for axis in zip(*side, strict=True)] for side in both)
        return first, last

    def fits(self, x: Tensor) -> bool:
        """Whether the particles would fit into the window, wherever it is put."""
        first, last = self._reach(x)
        return all(
            high - low + 3 <= nodes
            for axis, nodes in enumerate(self.shape)
            for low, high in zip(first[axis], last[axis], strict=True)
        )

    def renew(self, x: Tensor) -> None:
        """Sort by cell and centre the window on the particles, without waiting for the device.

        On the CPU, where nothing is summed in parallel, the order is that at rest, so that results never depend on what ran
        before; the window does not change a result.
        """
        base = self._base(x)
        sorted_base = base if x.device.type == "cuda" else self._base(self.model.positions.expand_as(x))
        key = sorted_base[..., 0]
        for axis in range(1, self.model.dim):
            key = key * self.model.scene.grid.shape[axis] + sorted_base[..., axis]
        self.order.copy_(torch.argsort(key, dim=1, stable=True))
        middle = (base.amin(dim=1) + base.amax(dim=1) + 3 - self._shape) // 2
        self.origin.copy_(torch.minimum(middle.clamp(min=0), self._grid - self._shape))
        self.fresh_cells, self.stale = None, False

    def renewed(self, x: Tensor) -> "Arrangement":
        """Itself with a new order and place, or another one if the window is too small for these positions."""
        if not self.fits(x):
            return Arrangement(self.model, x, least=self.shape)
        self.renew(x)
        return self

    def grown(self, x: Tensor) -> "Arrangement":
        """Another one with a window half as large again."""
        return Arrangement(self.model, x, least=tuple(math.ceil(1.5 * n) for n in self.shape))

    def judge(self, cells: int, near_edge: bool) -> None:
        """Take note of what a call reports: cells met along the order, and whether a particle is near the window's edge."""
        if self.fresh_cells is None:
            self.fresh_cells = cells
        scattered = self.model.device.type == "cuda" and cells > STALE * self.fresh_cells
        self.stale = near_edge or scattered

    def window(self, origin: Tensor):
        """Struct for the kernels."""
        t = types(self.model.spec.dim, self.model.spec.dtype)
        window = t.Window()
        window.shape, window.count = t.ivec(*self.shape), self.node_count
        window.origin = view(origin, t.ivec)
        return window
