"""Check of a state for bodies that pass through themselves or each other: its buffers and launches."""

from collections.abc import Callable

import torch
import warp as wp

from softmpm.kernels.lagrangian.cell_table import cell_table
from softmpm.kernels.lagrangian.overlap import overlap, overlap_type
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.overlap_grid import FAR, TICKS
from softmpm.schemes.buffers import view


def overlap_struct(model: Model):
    """Struct on the volumes of the particles at rest."""

    def make():
        t, volumes, grid = types(model.spec.dim, model.spec.dtype), model.overlap, model.rest_grid
        assert volumes is not None
        struct = overlap_type(model.spec.dim, model.spec.dtype)()
        struct.window, struct.order = view(grid.window.flatten(), wp.int32), view(grid.order, wp.int32)
        struct.corners, struct.outer = view(volumes.corners, wp.int32), view(volumes.outer, wp.int32)
        struct.fraction = view(grid.fraction, t.vec)
        struct.positions = view(volumes.positions.to(model.dtype), t.vec)
        struct.half, struct.strides = view(volumes.half.to(model.dtype), t.real), t.ivec(*volumes.strides)
        struct.ticks, struct.near = view(volumes.ticks, t.ivec), int(FAR * TICKS) - 1  # for the rounding
        struct.far, struct.reach, struct.side = FAR * model.scene.grid.spacing, volumes.reach, volumes.side
        return struct

    return model.workspace.get(overlap_struct, make)


class OverlapCheck:
    """A table of cells, and the places of the particles.

    Attributes:
        bytes: Of the buffers.
    """

    def __init__(self, model: Model):
        volumes, device, lead = model.overlap, model.device, (model.worlds, model.particle_count)
        assert volumes is not None
        self.model, self._particles, self._outer = model, lead, (model.worlds, len(volumes.outer))
        self._bodies, self._kernels = overlap_struct(model), overlap(model.spec.dim, model.spec.dtype)
        self._buckets = model.worlds, volumes.buckets
        boxes = (*self._buckets, model.dim)
        shapes = dict(head=self._buckets, low=boxes, high=boxes, following=lead)
        tensors = {
            name: torch.empty(shape, dtype=torch.int32, device=device) for name, shape in shapes.items()
        }
        keys = torch.empty(self._buckets, dtype=torch.int64, device=device)
        x = torch.empty(*lead, model.dim, dtype=model.dtype, device=device)
        self._table = cell_table(model.spec.dim).Table()
        self._table.keys, self._x = view(keys, wp.int64), view(x, types(model.spec.dim, model.spec.dtype).vec)
        for name, tensor in tensors.items():
            setattr(self._table, name, view(tensor, wp.int32))
        self.bytes = sum(one.nbytes for one in (*tensors.values(), keys, x))

    def check(self, launch: Callable[..., None], substep: int, u: wp.array, words: wp.array) -> None:
        """Check the state after ``substep``."""
        bodies, kernels, rate = self._bodies, self._kernels, self.model.constants.rate
        launch(kernels.clear, self._buckets, self._table)
        launch(kernels.sort, self._particles, bodies, u, self._table, self._x)
        launch(kernels.compare, self._outer, bodies, rate, substep, u, self._x, self._table, words)


def overlap_bytes(model: Model) -> int:
    """Bytes of the buffers of an :class:`OverlapCheck`."""
    if model.overlap is None:
        return 0
    per_bucket, per_particle = 12 + 8 * model.dim, 4 + model.dim * model.dtype.itemsize
    return model.worlds * (per_bucket * model.overlap.buckets + per_particle * model.particle_count)
