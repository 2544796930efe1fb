"""Where the fast scheme keeps things: particles in the order of their cells, and only the nodes around them.

Neither has to be exact. An order that has grown stale costs speed, never correctness, and is renewed when particles that stand
next to each other share their cell too rarely. The window is the part of the grid that is in memory, in each world at a place of
its own; a particle that is about to leave it is seen in time. When one does leave it, its chunk runs again: with the window put
around its start or, if it was already there or this is not the first time, with a larger one. A recorded graph cannot look: after a
replay in which a particle left, the window grows and the graph is recorded once more. The cost of a substep follows the window, not the
grid.
"""

import math

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.fast.alarms import packed_alarms
from softmpm.kernels.fast.native import FEW
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.planning.memory import MARGIN, window_shape
from softmpm.schemes.buffers import slot, view
from softmpm.schemes.capture import recording
from softmpm.schemes.device import stream_of
from softmpm.schemes.failure_report import Report
from softmpm.schemes.launch import Command

STALE, STALE_FEW = 1.5, 3.0
"""Renew the order when going along it meets so many times more cells than when it was new; with few particles it matters less."""


class Arrangement:
    """Order of the particles and window of the grid. Both are renewed in place; only a window that grows is another one.

    Args:
        x: Positions to start from [m], shape (world, particle, dim).
        before: One whose window was too small, if there is one: its margin is doubled, and nothing gets smaller.

    Attributes:
        order: Particle at each place, shape (world, particle), int32.
        neighbours: Places of the neighbours at rest of the particle at each place; Warp array (world, particle, at most dim).
        origin: First node of the window, shape (world, dim), int32.
        shape: Nodes of the window along each axis.
        version: How often it was renewed.
        stale: Whether to renew it.
        left: Whether a particle left the window before.
        outgrown: Whether to take a larger one, because a particle left the window inside a recorded graph.
    """

    def __init__(self, model: Model, x: Tensor, before: "Arrangement | None" = None):
        self.model, self.version = model, 0
        self._margin = 2 * before._margin + 1 if before else MARGIN[model.dim]
        self._fresh: Report | None = None  # cells met along the order when it was new
        self.stale = self.left = self.outgrown = False

        def integers(*size):
            return torch.empty(*size, dtype=torch.int32, device=model.device)

        self.order = integers(model.worlds, model.particle_count)
        self.origin = integers(model.worlds, model.dim)
        self._key = torch.empty_like(self.order)
        by_place = integers(model.worlds, *model.neighbours.shape)
        self.neighbours = view(by_place, wp.int32)
        self._arrange = self._arranging(by_place)
        self._ends = integers(2, model.worlds, model.dim)
        self._find = self._finding()
        grid = model.scene.grid.shape
        self._locate(x)
        low, high = self._ends.tolist()  # waits for the device
        apart = [[max(0, h - b) for b, h in zip(*ends, strict=True)] for ends in zip(low, high, strict=True)]
        wide = window_shape(grid, [max(axis) for axis in zip(*apart, strict=True)], self._margin)
        self.shape = tuple(max(sizes) for sizes in zip(wide, before.shape if before else wide, strict=True))
        self._centre = self._centring()
        self.renew(x)

    @property
    def node_count(self) -> int:
        """Nodes of one world in memory."""
        return math.prod(self.shape)

    def _finding(self) -> Command:
        """Fills the keys to sort by, and the ends of the box around the particles."""
        model, t = self.model, types(self.model.spec.dim, self.model.spec.dtype)
        gravity = model.scene.gravity
        up = max(range(t.dim), key=lambda axis: abs(gravity[axis])) if gravity else 0
        places, found = [slot(model, t.vec) for _ in range(2)], (self._key, *self._ends)
        inputs = (model.scale, up, *places, *(view(tensor, wp.int32) for tensor in found))
        return Command(model, sorting(t.dim, model.spec.dtype).locate, self.order.shape, inputs, places)

    def _arranging(self, by_place: Tensor) -> list[Command]:
        """See :meth:`place_neighbours`."""
        model, t = self.model, types(self.model.spec.dim, self.model.spec.dtype)
        if by_place.shape[2] == 0:
            return []
        places, order = view(torch.empty_like(self.order), wp.int32), view(self.order, wp.int32)
        invert, arrange = sorting(t.dim, model.spec.dtype).invert, packed_alarms(model.spec).arrange
        given = (order, places, view(model.neighbours, wp.int32), self.neighbours)
        return [
            Command(model, invert, self.order.shape, (order, places), ()),
            Command(model, arrange, self.order.shape, given, ()),
        ]

    def _centring(self) -> Command:
        """Puts the window around that box."""
        model, t = self.model, types(self.model.spec.dim, self.model.spec.dtype)
        ends = (view(tensor, wp.int32) for tensor in (*self._ends, self.origin))
        inputs = (model.scale, t.ivec(*self.shape), *ends)
        return Command(model, sorting(t.dim, model.spec.dtype).centre_window, self.origin.shape, inputs, ())

    def _locate(self, x: Tensor) -> None:
        """Cell of each particle, and the box around them in each world.

        In a cell the lower half comes first: when a body falls, that is what leaves it, and it stays together.
        On the CPU, where nothing is summed in parallel, the order is that at rest, so that results never depend on what ran
        before; the window does not change a result.
        """
        model = self.model
        follow = x if model.device.type == "cuda" else model.positions.expand_as(x)
        self._ends[0].fill_(max(model.scene.grid.shape))
        self._ends[1].fill_(0)
        self._find(stream_of(model.device), x.contiguous(), follow.contiguous())

    def renew(self, x: Tensor) -> None:
        """Sort by cell and centre the window on the particles, without waiting for the device."""
        model = self.model
        self._locate(x)
        key, order = torch.sort(self._key, dim=1, stable=True)
        self.order.copy_(order)
        self._centre(stream_of(model.device))
        if not recording(model):
            cell = key // 2
            self._fresh = Report(model.worlds + (cell[:, 1:] != cell[:, :-1]).sum()[None])
        self.stale = False
        self.version += 1

    def place_neighbours(self) -> None:
        """Put the neighbours at rest into the present order."""
        for command in self._arrange:
            command(stream_of(self.model.device))

    def grown(self, x: Tensor) -> "Arrangement":
        """Another one with a larger window."""
        return Arrangement(self.model, x, before=self)

    def outgrow(self) -> None:
        """Take note that a particle left the window inside a recorded graph: the next call that is not recorded takes a larger one."""
        self.outgrown = True

    def judge(self, cells: int, near_edge: bool) -> None:
        """Take note of what a call reports: cells met along the order, and whether a particle is near the window's edge."""
        assert self._fresh is not None
        limit = STALE_FEW if self.order.numel() <= FEW else STALE
        scattered = self.model.device.type == "cuda" and cells > limit * self._fresh.read()[0]
        self.stale = near_edge or scattered

    def window(self, origin: Tensor):
        """Struct for the kernels."""
        t = types(self.model.spec.dim, self.model.spec.dtype)
        window = t.Window()
        window.shape, window.count = t.ivec(*self.shape), self.node_count
        window.origin = view(origin, t.ivec)
        return window
