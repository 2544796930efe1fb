"""Buffers of a chunk of the fast scheme: everything that its launches read and write, at addresses that do not change.

A captured graph refers to addresses, so whatever changes between calls is copied into these buffers first: the order of the particles,
the inputs (sorted_inputs.py) and the initial state.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import FROZEN, NEVER
from softmpm.kernels.fast.native import padded
from softmpm.kernels.fast.packing import packing
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import passing, placeholder, view
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.carried import Nodes, SurfaceContact
from softmpm.schemes.fast.contact_views import packed_nodes, vectors
from softmpm.schemes.fast.fixed_point import FixedPointSums
from softmpm.schemes.fast.launch_size import LaunchSize
from softmpm.schemes.fast.particle_order import ParticleLayout
from softmpm.schemes.fast.sorted_state import SortedState
from softmpm.schemes.fast.sums import NodeSums, SlabSums
from softmpm.schemes.inputs import Values
from softmpm.schemes.launch import RebindableLaunch
from softmpm.schemes.sorted_inputs import SortedInputs
from softmpm.state import State


def sums_over(model: Model, rows: Callable[[], Tensor], nodes: Sequence[wp.array]) -> NodeSums:
    """Sums of the contributions of a model's particles to nodes; ``rows`` gives memory for what they contribute, packed as they are."""
    if model.spec.deterministic:
        return FixedPointSums(model, view(rows(), wp.float32), nodes)
    return SlabSums(model, rows(), nodes) if model.spec.slabs else NodeSums(nodes)


class StoredStates(NamedTuple):
    """Copies of the stored states of a chunk, and of the particle order and window that they refer to."""

    version: int
    """Version of the layout, see :class:`ParticleLayout`."""
    order: Tensor
    origin: Tensor
    states: list[Tensor]
    """Packed states and nodes, then anchors and impulses of surface points."""


class ChunkBuffers:
    """Buffers of the chunks of one shape on one particle layout.

    Args:
        keep: Whether to store the intermediate states, which the backward pass needs.

    Attributes:
        order, origin: Particle at each place, and first node of the window, of the initial state that was loaded last.
        words: Status words, as in :class:`softmpm.schemes.fast.scheme.FastRun`.
        words_before: On a CPU those before a launch that may change them, else the words themselves.
        inputs: Inputs in this order.
        base, rows: Packed states, one or, if ``keep``, one more than substeps; the last one is the final state.
        nodes: Mass and momentum of the window's nodes, two or, if ``keep``, one for each substep.
        velocity: Nodal velocities of the present substep; with contact at surface points those before contact as well.
        contact: Contact at surface points, or None.
        loads: Sums of its areas on the nodes, of two successive substeps.
        sums: How the particles add to the nodes.
    """

    def __init__(self, model: Model, layout: ParticleLayout, chunk: Chunk, keep: bool):
        self.model, self.layout, self.chunk, self.keep = model, layout, chunk, keep
        self.types = t = types(model.spec.dim, model.spec.dtype)
        self.lead = (model.worlds, model.particle_count)
        self.size = LaunchSize(model)
        places = padded(self.size.particles)
        stored, grids = (chunk.length + 1, chunk.length) if keep else (1, 2)

        def tensor(*size, dtype=model.dtype):
            return torch.empty(*size, dtype=dtype, device=model.device)

        self.order = tensor(*self.lead, dtype=torch.int32)
        self.origin = tensor(model.worlds, model.dim, dtype=torch.int32)
        self.words = tensor(model.worlds + 2, dtype=torch.int64)
        self._no_status = torch.full_like(self.words, NEVER)
        self._no_status[-2:].zero_()
        self.words_before = torch.empty_like(self.words[:-2]) if model.spec.slabs else self.words
        self._version = -1  # of the layout that order and origin were copied from
        self.inputs = SortedInputs(model, chunk, self.order)
        self.base = tensor(stored, places, dtype=torch.int32)
        self.rows = tensor(stored, places * t.rows)
        self.nodes = tensor(grids, model.worlds * layout.node_count, 4)
        self.held = model.worlds * layout.node_count
        self.velocity = tensor(1 if model.surface is None else 2, self.held, 4)
        self.nothing = view(tensor(0, 4), t.aligned)
        self._view()
        self.sums = sums_over(model, lambda: tensor(places * t.rows), self.node_arrays)
        self.contact = None
        if model.surface is not None:
            self.contact = SurfaceContact(model, self.window, chunk, keep, packed=True)
            self.loads = tensor(2, model.worlds, layout.node_count)
            self.load_arrays = [view(load, t.real) for load in self.loads]
            self.velocity_vectors = [vectors(model, velocity) for velocity in self.velocity]
            self._contact_nodes = [packed_nodes(model, nodes) for nodes in self.nodes]
        self._prepare_loading(places)

    def _view(self) -> None:
        """Warp arrays and structs on the buffers."""
        t = self.types
        self.window = self.layout.window(self.origin)
        self.packed = []
        for base, rows in zip(self.base, self.rows, strict=True):
            packed = t.Packed()
            packed.base, packed.rows = view(base, wp.int32), view(rows, t.real)
            self.packed.append(packed)
        self.node_arrays = [view(nodes, t.aligned) for nodes in self.nodes]
        self.velocity_arrays = [view(velocity, t.aligned) for velocity in self.velocity]
        self.velocity_array = self.velocity_arrays[0]
        self.order_array = view(self.order, wp.int32)
        self.order_flat = view(self.order.view(-1), wp.int32)
        self.words_array, self.before_array = view(self.words, wp.int64), view(self.words_before, wp.int64)
        self.survey_array = view(self.words[-2:], wp.int64)
        self.mass = view(self.inputs.values["mass"], t.real)

    def _prepare_loading(self, places: int) -> None:
        """Launches that load a user's state, with or without low-order parts, or the final state of another chunk."""
        model, t = self.model, self.types
        pack, sort = packing(t.dim, model.spec.dtype), sorting(t.dim, model.spec.dtype)
        at, low = (model.constants, self.window, self.order_array), (t.vec, t.mat)
        state = (t.vec, t.vec, t.mat, t.mat)
        zero = torch.zeros(t.dim, t.dim, dtype=model.dtype, device=model.device)
        none = passing(zero[0].expand(*self.lead, -1), t.vec), passing(zero.expand(*self.lead, -1, -1), t.mat)

        def enter(*dtypes, low=()) -> RebindableLaunch:
            given = [placeholder(model, dtype) for dtype in dtypes]
            arguments = (*at, *given, *low, self.words_array, self.packed[0])
            return RebindableLaunch(model, pack.enter, self.lead, arguments, given)

        self._enter = {False: enter(*state, low=none), True: enter(*state, *low)}
        given = [
            placeholder(model, wp.int32),
            placeholder(model, wp.int32, places),
            placeholder(model, t.real, places * t.rows),
        ]
        arguments = (self.window, self.order_array, *given, self.words_array, self.packed[0])
        self._move = RebindableLaunch(model, sort.move, self.lead, arguments, given)

    @property
    def bytes(self) -> int:
        """Bytes of the buffers."""
        points = 0 if self.contact is None else self.contact.bytes
        tensors = (self.base, self.rows, self.nodes, self.velocity)
        return points + self.inputs.bytes + self.sums.bytes + sum(tensor.nbytes for tensor in tensors)

    def packed_at(self, s: int):
        """Packed state before substep ``s``."""
        return self.packed[s if self.keep else 0]

    def masses(self, s: int) -> wp.array:
        """Momentum and mass of the nodes of substep ``s``, (world, node)."""
        return self._contact_nodes[s % len(self.nodes)]

    def contact_nodes(self, s: int, velocity: wp.array, free: wp.array) -> Nodes:
        """Nodes of substep ``s`` as contact at surface points takes them, with velocities after and before contact."""
        return Nodes(self.masses(s), free, velocity, self.load_arrays[s % 2])

    def reset_status(self) -> None:
        """Reset all status words."""
        self.words.copy_(self._no_status)

    def load(
        self,
        stream: wp.Stream | None,
        chunk: Chunk,
        start: State | SortedState,
        values: Values,
        frozen: Tensor | None = None,
    ) -> None:
        """Copy everything that a chunk depends on into the buffers, in the present order of the particles.

        Args:
            chunk: Of these buffers' shape.
            values: Inputs that the call sets; those with rows have one for each control step of the chunk.
            frozen: True for worlds whose particles do not move, shape (world,).
        """
        layout = self.layout
        moved = self._follow(layout.version, layout.order, layout.origin)
        if moved:
            layout.place_neighbours()
        self.reset_status()
        if frozen is not None:
            self.words[: self.model.worlds].masked_fill_(frozen, FROZEN)
        self.inputs.take(stream, chunk, values, moved)
        self._version = layout.version
        self.load_state(stream, start)
        if self.contact is not None and start.surface is not None:
            self.contact.load(chunk, start.surface)
        self.sums.begin(values["mass"])

    def _follow(self, version: int, order: Tensor, origin: Tensor) -> bool:
        """Copy the particle order and the window origin of a layout version into the buffers, unless they are those of this version.

        Returns:
            True if the inputs must be permuted; the caller sets the version afterwards.
        """
        if not is_capturing(self.model) and self._version == version:
            return False
        self._version = -1
        self.order.copy_(order)
        self.origin.copy_(origin)
        if self.contact is not None:
            self.contact.reorder(self.order)
        return True

    @property
    def _stored(self) -> list[Tensor]:
        contact = [] if self.contact is None else [self.contact.anchor, self.contact.impulse]
        return [self.base, self.rows, self.nodes, *contact]

    def copy(self) -> StoredStates:
        """Copy the stored states into new tensors, for :meth:`restore`."""
        states = [tensor.clone() for tensor in self._stored]
        return StoredStates(self._version, self.order.clone(), self.origin.clone(), states)

    def restore(self, stream: wp.Stream | None, chunk: Chunk, stored: StoredStates, values: Values) -> None:
        """Copy stored states back, and everything else that the adjoint of their chunk reads, after other chunks used the buffers."""
        moved = self._follow(stored.version, stored.order, stored.origin)
        self.inputs.take(stream, chunk, values, moved)
        self._version = stored.version
        for own, copied in zip(self._stored, stored.states, strict=True):
            own.copy_(copied)
        if self.contact is not None:
            self.contact.set_rate(chunk)

    def load_state(self, stream: wp.Stream | None, start: State | SortedState) -> None:
        """Copy the initial state into the buffers, permuted into the present order."""
        if isinstance(start, SortedState):
            self._move(stream, start.inverse_permutation(), start.base, start.rows)
        else:
            given = [tensor.contiguous() for tensor in (*start[:4], *(start.low or ()))]
            self._enter[start.low is not None](stream, *given)
