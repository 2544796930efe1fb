"""Sorted states and adjoints passed between chunks. They are permuted to the user's particle order only at the ends of a call.

A chunk reads its initial state directly from the buffers that hold the final state of the previous chunk. Their lease lasts as long as
the :class:`SortedState` is referenced.
"""

import math

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.fast.native import padded
from softmpm.kernels.fast.packing import packing
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import slot
from softmpm.schemes.device import stream_of
from softmpm.schemes.launch import RebindableLaunch
from softmpm.state import Low, State


class Unpacker:
    """Launches that permute packed particles to the user's order."""

    def __init__(self, model: Model):
        self.model = model
        spec, lead = model.spec, (model.worlds, model.particle_count)
        t, pack, places = types(spec.dim, spec.dtype), packing(spec.dim, spec.dtype), padded(math.prod(lead))
        order, base, rows = (wp.int32,), (wp.int32, places), (t.real, places * t.rows)
        constants, end = (model.constants,), [(t.vec,), (t.vec,), (t.mat,), (t.mat,)]
        low = [(t.vec,), (t.mat,)] if model.dtype == torch.float32 else []
        nothing = (2 - len(low)) * (None,)

        def command(kernel, parameters, *fields, none=()) -> RebindableLaunch:
            slots = [slot(model, *field) for field in fields]
            return RebindableLaunch(model, kernel, lead, (*parameters, *slots, *none), slots)

        self.invert = command(sorting(spec.dim, spec.dtype).invert, (), order, (wp.int32,))
        self.leave = command(pack.leave, constants, order, base, rows, *end, *low, none=nothing)
        self.positions = command(pack.positions, constants, order, base, rows, (t.vec,))
        self.leave_adj = command(pack.leave_adj, constants, order, rows, *end)

    def fields(self, *axes: int) -> list[Tensor]:
        """New tensors of the shape (world, particle, ...) with so many more axes each."""
        model = self.model
        lead = (model.worlds, model.particle_count)
        return [torch.empty(*lead, *n * (model.dim,), dtype=model.dtype, device=model.device) for n in axes]


class Sorted:
    """Particles in the order of some particle layout.

    Args:
        rows: Packed particles, see kernels/structs.py.
        order: Particle at each place, shape (world, particle), int32.
    """

    def __init__(self, unpacking: Unpacker, rows: Tensor, order: Tensor):
        self._unpacking, self.rows, self.order = unpacking, rows, order

    @property
    def _stream(self) -> wp.Stream | None:
        return stream_of(self._unpacking.model.device)

    def inverse_permutation(self) -> Tensor:
        """Place of each particle in memory, shape (world, particle), int32."""
        places = torch.empty_like(self.order)
        self._unpacking.invert(self._stream, self.order, places)
        return places


class SortedState(Sorted):
    """State between two chunks.

    Args:
        base: Packed base nodes.
        owner: Lease of the buffers, which nothing else writes to while it is referenced. None if the state owns them.
    """

    def __init__(self, unpacking: Unpacker, base: Tensor, rows: Tensor, order: Tensor, owner: object = None):
        super().__init__(unpacking, rows, order)
        self.base, self._owner = base, owner

    def copy(self) -> "SortedState":
        """A copy in buffers of its own."""
        return SortedState(self._unpacking, self.base.clone(), self.rows.clone(), self.order.clone())

    @property
    def x(self) -> Tensor:
        """Positions as in :class:`State`."""
        (x,) = self._unpacking.fields(1)
        self._unpacking.positions(self._stream, self.order, self.base, self.rows, x)
        return x

    def state(self) -> State:
        """In the user's order, in new tensors."""
        rounds = self._unpacking.model.dtype == torch.float32
        x, v, C, F, *low = self._unpacking.fields(1, 1, 2, 2, *((1, 2) if rounds else ()))
        self._unpacking.leave(self._stream, self.order, self.base, self.rows, x, v, C, F, *low)
        return State(x, v, C, F, Low(*low) if low else None)


class SortedAdj(Sorted):
    """Adjoint of a state between two chunks."""

    def state(self) -> State:
        """In the user's order, in new tensors."""
        x, v, C, F = self._unpacking.fields(1, 1, 2, 2)
        self._unpacking.leave_adj(self._stream, self.order, self.rows, x, v, C, F)
        return State(x, v, C, F)
