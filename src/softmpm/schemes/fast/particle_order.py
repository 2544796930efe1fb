"""Particle order and grid window of the fast scheme: particles are sorted by cell, and only nodes near them are allocated.

Both may be out of date without affecting results. A stale order costs speed only; particles are re-sorted when neighbours in
memory share their cell too rarely. The window is the allocated part of the grid, at a separate place in each world, and it is
re-centred when a particle comes near its edge. If a particle or a surface point leaves it, the chunk is repeated: with the window
centred on its initial state or, if it was already centred or this is not the first time, with a larger window. If it was outside
as the chunk began, because the call began elsewhere, the window is centred only. A captured graph cannot do this: it centres the
window for each call, and after a replay in which one left, the window is enlarged and the graph captured again. The cost of a substep
is proportional to the window, not to the grid.
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
from softmpm.planning.memory import grown_margin, window_shape
from softmpm.schemes.buffers import placeholder, view
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.device import stream_of
from softmpm.schemes.failure_report import Report
from softmpm.schemes.fast.footprint import first_margin
from softmpm.schemes.launch import RebindableLaunch

STALE, STALE_FEW = 1.5, 3.0
"""Re-sort when the number of changes of cell along the order has grown by this factor; with few particles the order matters less."""


class ParticleLayout:
    """Order of the particles and window of the grid. Both are updated in place; a larger window is a new layout.

    Args:
        x: Initial positions [m], shape (world, particle, dim).
        before: A layout whose window was too small, or None. Its margin grows, and no axis gets shorter.

    Attributes:
        order: Particle at each place, shape (world, particle), int32.
        neighbours: Places of the neighbours at rest of the particle at each place; Warp array (world, particle, at most dim).
        origin: First node of the window, shape (world, dim), int32.
        shape: Nodes of the window along each axis.
        version: Number of updates.
        stale: Whether the particles should be re-sorted.
        left: Whether a particle has left the window before, on the way.
        outgrown: Whether the window must be enlarged, because a particle left it inside a captured graph.
    """

    def __init__(self, model: Model, x: Tensor, before: "ParticleLayout | None" = None):
        self.model, self.version = model, 0
        self._margin = grown_margin(before._margin) if before else first_margin(model)
        self._fresh: Report | None = None  # changes of cell along the order just after sorting
        self.stale = self.left = self.outgrown = False

        def integers(*size):
            return torch.empty(*size, dtype=torch.int32, device=model.device)

        self.order = integers(model.worlds, model.particle_count)
        self.origin = integers(model.worlds, model.dim)
        self._key = torch.empty_like(self.order)
        by_place = integers(model.worlds, *model.neighbours.shape)
        self.neighbours = view(by_place, wp.int32)
        self._place_neighbours = self._neighbour_launches(by_place)
        self._ends = integers(2, model.worlds, model.dim)
        self._find = self._locate_launch()
        grid = model.scene.grid.shape
        self._locate(x)
        low, high = self._ends.tolist()  # waits for the device
        apart = [[max(0, h - b) for b, h in zip(*ends, strict=True)] for ends in zip(low, high, strict=True)]
        reach, points = [max(axis) for axis in zip(*apart, strict=True)], model.surface
        wide = window_shape(grid, reach, self._margin, 0 if points is None else points.count)
        self.shape = tuple(max(sizes) for sizes in zip(wide, before.shape if before else wide, strict=True))
        self._centre = self._centre_launch()
        self.resort(x)

    @property
    def node_count(self) -> int:
        """Nodes of one world in memory."""
        return math.prod(self.shape)

    def _locate_launch(self) -> RebindableLaunch:
        """Launch that computes the sort keys and the bounding box of the particles."""
        model, t = self.model, types(self.model.spec.dim, self.model.spec.dtype)
        gravity = model.scene.gravity
        up = max(range(t.dim), key=lambda axis: abs(gravity[axis])) if gravity else 0
        places, found = [placeholder(model, t.vec) for _ in range(2)], (self._key, *self._ends)
        inputs = (model.constants, up, *places, *(view(tensor, wp.int32) for tensor in found))
        return RebindableLaunch(
            model, sorting(t.dim, model.spec.dtype).locate, self.order.shape, inputs, places
        )

    def _neighbour_launches(self, by_place: Tensor) -> list[RebindableLaunch]:
        """Launches of :meth:`place_neighbours`; none without rest neighbours."""
        model, t = self.model, types(self.model.spec.dim, self.model.spec.dtype)
        if by_place.shape[2] == 0:
            return []
        places, order = view(torch.empty_like(self.order), wp.int32), view(self.order, wp.int32)
        invert = sorting(t.dim, model.spec.dtype).invert
        permute = packed_alarms(model.spec).permute_neighbours
        given = (order, places, view(model.neighbours, wp.int32), self.neighbours)
        return [
            RebindableLaunch(model, invert, self.order.shape, (order, places), ()),
            RebindableLaunch(model, permute, self.order.shape, given, ()),
        ]

    def _centre_launch(self) -> RebindableLaunch:
        """Launch that centres the window on the bounding box."""
        model, t = self.model, types(self.model.spec.dim, self.model.spec.dtype)
        ends = (view(tensor, wp.int32) for tensor in (*self._ends, self.origin))
        inputs = (model.constants, t.ivec(*self.shape), *ends)
        return RebindableLaunch(
            model, sorting(t.dim, model.spec.dtype).centre_window, self.origin.shape, inputs, ()
        )

    def _locate(self, x: Tensor) -> None:
        """Compute the sort keys and the bounding box of the particles of each world.

        Within a cell the lower half comes first: particles of a falling body that leave their cell together stay together in memory.
        On the CPU, where sums are sequential, the order is that at rest, so that results do not depend on earlier calls; the window
        never affects results.
        """
        model = self.model
        follow = x if model.device.type == "cuda" else model.positions.expand_as(x)
        self._ends[0].fill_(max(model.scene.grid.shape))
        self._ends[1].fill_(0)
        self._find(stream_of(model.device), x.contiguous(), follow.contiguous())

    def centre(self, x: Tensor) -> None:
        """Centre the window on the particles, without waiting for the device."""
        self._locate(x)
        self._centre(stream_of(self.model.device))
        self.version += 1

    def resort(self, x: Tensor) -> None:
        """Centre the window on the particles and sort them by cell, without waiting for the device."""
        model = self.model
        self.centre(x)
        key, order = torch.sort(self._key, dim=1, stable=True)
        self.order.copy_(order)
        if not is_capturing(model):
            cell = key // 2
            self._fresh = Report(model.worlds + (cell[:, 1:] != cell[:, :-1]).sum()[None])
        self.stale = False

    def place_neighbours(self) -> None:
        """Permute the lists of rest neighbours into the present order."""
        for launch in self._place_neighbours:
            launch(stream_of(self.model.device))

    def grown(self, x: Tensor) -> "ParticleLayout":
        """A layout with a larger window."""
        return ParticleLayout(self.model, x, before=self)

    def changed(self) -> None:
        """A captured graph has sorted the particles: calls outside of it must load their order anew."""
        self.version += 1

    def outgrow(self) -> None:
        """Request a larger window for the next call outside of a capture, after a particle left it inside a captured graph."""
        self.outgrown = True

    def update_staleness(self, cells: int, near_edge: bool) -> None:
        """Decide whether to re-sort.

        Args:
            cells: Changes of cell along the order.
            near_edge: Whether a particle is near the window's edge.
        """
        assert self._fresh is not None
        limit = STALE_FEW if self.order.numel() <= FEW else STALE
        scattered = self.model.device.type == "cuda" and cells > limit * self._fresh.read()[0]
        self.stale = near_edge or scattered

    def window(self, origin: Tensor):
        """The window as a struct for the kernels; ``origin`` is its first node in each world."""
        t = types(self.model.spec.dim, self.model.spec.dtype)
        window = t.Window()
        window.shape, window.count = t.ivec(*self.shape), self.node_count
        window.origin = view(origin, t.ivec)
        return window
