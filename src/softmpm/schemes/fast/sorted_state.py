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
from softmpm.schemes.buffers import placeholder
from softmpm.schemes.device import stream_of
from softmpm.schemes.launch import RebindableLaunch
from softmpm.state import Low, State, SurfaceState


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

        def rebindable(kernel, parameters, *fields, none=()) -> RebindableLaunch:
            given = [placeholder(model, *field) for field in fields]
            return RebindableLaunch(model, kernel, lead, (*parameters, *given, *none), given)

        self.invert = rebindable(sorting(spec.dim, spec.dtype).invert, (), order, (wp.int32,))
        self.leave = rebindable(pack.leave, constants, order, base, rows, *end, *low, none=nothing)
        self.positions = rebindable(pack.positions, constants, order, base, rows, (t.vec,))
        self.leave_adj = rebindable(pack.leave_adj, constants, order, rows, *end)

    def fields(self, *axes: int) -> list[Tensor]:
        """New tensors of shape (world, particle, ...), one for each number in ``axes``, with that number of further axes."""
        model = self.model
        lead = (model.worlds, model.particle_count)
        return [torch.empty(*lead, *n * (model.dim,), dtype=model.dtype, device=model.device) for n in axes]


class Sorted:
    """Packed particles in the order of a particle layout.

    Args:
        rows: Packed particles, see kernels/structs.py.
        order: Particle at each place, shape (world, particle), int32.
        surface: Surface points, which are not sorted, or None.
    """

    def __init__(self, unpacker: Unpacker, rows: Tensor, order: Tensor, surface: SurfaceState | None = None):
        self._unpacker, self.rows, self.order, self.surface = unpacker, rows, order, surface

    @property
    def _stream(self) -> wp.Stream | None:
        return stream_of(self._unpacker.model.device)

    def inverse_permutation(self) -> Tensor:
        """Place of each particle in memory, shape (world, particle), int32."""
        places = torch.empty_like(self.order)
        self._unpacker.invert(self._stream, self.order, places)
        return places


class SortedState(Sorted):
    """Sorted state between two chunks.

    Args:
        base: Packed base nodes.
        owner: Lease of the buffers, which nothing else writes to while it is referenced. None if the state owns them.
    """

    def __init__(
        self,
        unpacker: Unpacker,
        base: Tensor,
        rows: Tensor,
        order: Tensor,
        surface: SurfaceState | None = None,
        owner: object = None,
    ):
        super().__init__(unpacker, rows, order, surface)
        self.base, self._owner = base, owner

    def copy(self) -> "SortedState":
        """A copy in new buffers."""
        surface = None if self.surface is None else self.surface.clone()
        return SortedState(self._unpacker, self.base.clone(), self.rows.clone(), self.order.clone(), surface)

    @property
    def x(self) -> Tensor:
        """Positions [m] in the user's order, as in :class:`State`."""
        (x,) = self._unpacker.fields(1)
        self._unpacker.positions(self._stream, self.order, self.base, self.rows, x)
        return x

    def state(self) -> State:
        """The same in the user's order, in new tensors."""
        rounds = self._unpacker.model.dtype == torch.float32
        x, v, C, F, *low = self._unpacker.fields(1, 1, 2, 2, *((1, 2) if rounds else ()))
        self._unpacker.leave(self._stream, self.order, self.base, self.rows, x, v, C, F, *low)
        surface = None if self.surface is None else self.surface.clone()
        return State(x, v, C, F, Low(*low) if low else None, surface=surface)


class SortedAdj(Sorted):
    """Sorted adjoint of a state between two chunks."""

    def state(self) -> State:
        """The same in the user's order, in new tensors."""
        x, v, C, F = self._unpacker.fields(1, 1, 2, 2)
        self._unpacker.leave_adj(self._stream, self.order, self.rows, x, v, C, F)
        return State(x, v, C, F, surface=self.surface)
