"""Buffers of a chunk of the reference formulation, forward and adjoint."""

import weakref
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import FROZEN, NEVER
from softmpm.kernels.lagrangian.chunk import chunk as memory
from softmpm.kernels.lagrangian.record import stores_u
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import clear, view
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.inputs import Accumulators, InputsAdj, Values
from softmpm.schemes.lagrangian.bricks import empty_partial, rest_struct
from softmpm.schemes.lagrangian.footprint import chunk_bytes, stored_nodes
from softmpm.schemes.lagrangian.frame import frame_struct, shift_of
from softmpm.schemes.lagrangian.mirror import Reflection, ReflectionAdj
from softmpm.schemes.lagrangian.surface import SurfaceBuffersAdj, SurfaceContact, SurfaceContactAdj
from softmpm.schemes.sorted_inputs import SortedInputs, add_unsorted, unsort
from softmpm.state import Nodal


def views(fields: Tensor, kind: Any) -> list[wp.array]:
    """Each of these fields as an array."""
    return [view(one, kind) for one in fields]


class ChunkBuffers:
    """Everything that the launches of a chunk read and write.

    Attributes:
        u, v, anchor, shift: Nodal states: if ``keep``, one more than there are substeps, else two that take turns. Of u there are two
            in any case where a gradient recomputes it from v (record.py).
        low: What rounding has kept from u and v of the latest state.
        force: Mean forces of the walls on the surface points in the present control step.
        w: Velocities of the nodes after each substep, without damping, walls and contact, where ``keep`` needs them (record.py).
        mass: Masses of the nodes.
        partial: Sums of the bricks for the nodes of their windows.
        words: Status words, see errors.py; shape (world,).
        inputs: Inputs, those of particles in the order of their places.
        contact: Contact of surface points, or None.
        reflection: Clamps and planes of symmetry, or None.
    """

    def __init__(self, model: Model, chunk: Chunk, keep: bool):
        self.model, self.chunk, self.keep = model, chunk, keep
        self.types, self.rest = types(model.spec.dim, model.spec.dtype), rest_struct(model)
        nodal = model.worlds, model.rest_grid.count, model.dim
        stored, substeps = (chunk.length + 1, chunk.length) if keep else (2, 0)
        self._keeps_u = keep and stores_u(model.spec)
        stored_u = stored if self._keeps_u else 2
        self.u, self.v = self.tensor(stored_u, *nodal), self.tensor(stored, *nodal)
        self.w = self.tensor(substeps, model.worlds, stored_nodes(model), model.dim)
        self.mass = self.tensor(*nodal[:2])
        self.low = self.tensor(nodal[0], 2, *nodal[1:])
        self.anchor, self.partial = self.tensor(stored, *model.anchor_shape), empty_partial(model)
        self.shift = torch.empty(stored, model.worlds, model.dim, dtype=torch.float64, device=model.device)
        self.force, self.frame = self.tensor(*model.anchor_shape), frame_struct(model)
        self.words = torch.empty(model.worlds, dtype=torch.int64, device=model.device)
        self._loaded = False
        order = model.rest_grid.order.expand(model.worlds, -1).contiguous()
        self.order, self.inputs = order, SortedInputs(model, chunk, order)
        vec, real = self.types.vec, self.types.real
        self.u_arrays, self.v_arrays, self.w_arrays = (views(one, vec) for one in (self.u, self.v, self.w))
        self.shift_arrays = [view(one, types(model.spec.dim, "float64").vec) for one in self.shift]
        self.mass_array, self.partial_array = view(self.mass, real), view(self.partial, vec)
        self.placed_mass = view(self.inputs.values["mass"], real)
        self.words_array = view(self.words, wp.int64)
        self.contact = None if model.surface is None else SurfaceContact(model, chunk)
        self.reflection = None
        self.struct = self.struct_on(self.u)
        if model.mirror is not None:
            self.reflection = Reflection(model, self.mass)

    def tensor(self, *shape: int) -> Tensor:
        return torch.empty(shape, dtype=self.model.dtype, device=self.model.device)

    def struct_on(self, u: Tensor) -> Any:
        """Struct of the memory with these displacements, as kernels see it."""
        t, exact = self.types, types(self.model.spec.dim, "float64").vec
        struct = memory(self.model.spec.dim, self.model.spec.dtype).Chunk()
        struct.length, struct.keep, struct.keep_u = self.chunk.length, int(self.keep), int(self._keeps_u)
        struct.words, struct.mass, struct.shift = self.words_array, self.mass_array, view(self.shift, exact)
        struct.u = view(u, t.vec)
        for name in ("partial", "low", "v", "w", "anchor", "force"):
            setattr(struct, name, view(getattr(self, name), t.vec))
        if self.contact is not None:
            self.contact.add_to(struct)
        return struct

    @property
    def bytes(self) -> int:
        """Bytes of the buffers."""
        states = sum(one.nbytes for one in (self.u, self.v, self.w, self.anchor))
        return states + chunk_bytes(self.model, self.chunk.row_count)

    def index(self, s: int) -> int:
        """Number of the state before substep ``s``."""
        return s if self.keep else s % 2

    def index_u(self, s: int) -> int:
        """Number of the displacements before substep ``s``."""
        return s if self._keeps_u else s % 2

    @property
    def last_u(self) -> wp.array:
        """Displacements after the last substep."""
        return self.u_arrays[self.index_u(self.chunk.length)]

    def load(
        self, stream: wp.Stream | None, chunk: Chunk, start: Nodal, values: Values, frozen: Tensor | None
    ) -> None:
        """Copy the initial state and the inputs of a chunk into the buffers."""
        first = is_capturing(self.model) or not self._loaded
        self._loaded = False
        self.words.fill_(NEVER)
        if frozen is not None:
            self.words.masked_fill_(frozen, FROZEN)
        self.inputs.take(stream, chunk, values, first)
        given_states = (*start[:3], shift_of(self.model, start))
        for own, given in zip((self.u, self.v, self.anchor, self.shift), given_states, strict=True):
            own[0].copy_(given.detach())
        if start.low is None:
            clear(self.low)
        else:
            self.low.copy_(start.low.detach())
        if chunk.begins:
            clear(self.force)
        else:
            self.force.copy_(start.force.detach())
        if self.contact is not None:
            self.contact.rate.fill_(1.0 / (chunk.substeps * self.model.scene.dt))
        self._loaded = True

    def end(self) -> Nodal:
        """Copy of the final state: a result must not keep all states alive."""
        last, u = self.index(self.chunk.length), self.u[self.index_u(self.chunk.length)].clone()
        v, anchor, shift = (one[last].clone() for one in (self.v, self.anchor, self.shift))
        return Nodal(u, v, anchor, self.force.clone(), shift, low=self.low.clone())


class SharedAdjoint:
    """Buffers that a backward pass needs only while it runs; all chunks share them.

    Attributes:
        u, v, anchor, force: Adjoint of the state.
        f: Adjoint of the forces on the nodes.
        mass: Adjoint of the masses of the nodes.
        partials: Sums of the bricks for the adjoints of displacements and velocities.
        low: What rounding has kept from the displacements of a chunk that are recomputed.
        contact: Buffers of contact of surface points, or None.
        reflected: Two nodal velocities of clamps and planes of symmetry, or none.
    """

    def __init__(self, buffers: ChunkBuffers, wanted: RequestedGrads):
        self.model, self.wanted = buffers.model, wanted
        self.u, self.v, self.anchor, self.force = (
            torch.empty_like(one) for one in (buffers.u[0], buffers.v[0], buffers.anchor[0], buffers.force)
        )
        self.f, self.mass = torch.empty_like(self.u), torch.empty_like(buffers.mass)
        viscous = self.model.spec.viscosity
        self.partials = [empty_partial(self.model)]
        self.partials.append(empty_partial(self.model) if viscous else self.partials[0])
        self.held = max(self.model.rest_grid.count, self.model.anchor_shape[2])
        """Accumulators of each world for what acts on nodes or surface points."""
        vec = buffers.types.vec
        self.u_array, self.v_array = view(self.u, vec), view(self.v, vec)
        self.mass_array = view(self.mass, buffers.types.real)
        self.partial_arrays = [view(one, vec) for one in self.partials]
        self.contact = None if buffers.contact is None else SurfaceBuffersAdj(buffers.contact)
        reflection = buffers.reflection
        self.reflected = [] if reflection is None else [reflection.vectors(), reflection.vectors()]
        self._displacements = self.u.new_empty(0)
        self.low = self.u.new_empty(0 if stores_u(self.model.spec) else self.u.shape)
        self._accumulators = weakref.WeakValueDictionary[int, Accumulators]()  # as long as a chunk has them

    @property
    def state(self) -> tuple[Tensor, ...]:
        """Adjoint of the state, in the order of :class:`Nodal`."""
        return self.u, self.v, self.anchor, self.force

    def displacements(self, substeps: int) -> Tensor:
        """Memory for the displacements before each of this number of substeps; shorter chunks use the beginning of it."""
        if len(self._displacements) < substeps:
            shape = substeps, *self.u.shape
            self._displacements = torch.empty(shape, dtype=self.u.dtype, device=self.u.device)
        return self._displacements[:substeps]

    def accumulators(self, rows: int) -> Accumulators:
        """Accumulators for chunks that touch this number of control steps, built on first use."""
        found = self._accumulators.get(rows)
        if found is None:
            found = self._accumulators[rows] = Accumulators(self.model, self.wanted, rows, self.held)
        return found


class ChunkAdjoint:
    """Adjoint buffers of the chunks of one shape.

    Attributes:
        forward: Buffers with the stored states.
        shared: Buffers that other chunks use as well.
        u, u_arrays: Displacements before each substep, stored or recomputed.
        at: Struct of the memory of the chunk with these displacements.
        found: Accumulated adjoints of the inputs, those of particles in the order of their places.
    """

    def __init__(self, forward: ChunkBuffers, shared: SharedAdjoint):
        self.forward, self.shared, self.model = forward, shared, forward.model
        chunk = forward.chunk
        self.found = shared.accumulators(chunk.row_count)
        self._unsort = unsort(self.model, forward.order, self.found)
        self.adj_placed_mass = None
        if "mass" in self.found.tensors:
            self.adj_placed_mass = view(self.found.tensors["mass"], forward.types.real)
        self.at, self.u, self.u_arrays = forward.struct, forward.u, forward.u_arrays
        if not stores_u(self.model.spec):
            self.u = shared.displacements(chunk.length)
            self.at, self.u_arrays = forward.struct_on(self.u), views(self.u, forward.types.vec)
        self.contact = self.reflection = None
        if forward.reflection is not None:
            given = forward.words_array, shared.mass_array, *shared.reflected
            self.reflection = ReflectionAdj(forward.reflection, forward.contact, *given)
        if forward.contact is not None:
            assert shared.contact is not None
            self.contact = SurfaceContactAdj(forward.contact, shared.contact, shared.wanted)
        self.struct = self._struct()

    def _struct(self) -> Any:
        """Struct of the adjoints, as kernels see them."""
        shared, t = self.shared, self.forward.types
        struct = memory(self.model.spec.dim, self.model.spec.dtype).Adjoint()
        struct.held, struct.mass = shared.held, shared.mass_array
        struct.partial_u, struct.partial_v = shared.partial_arrays
        for name in ("u", "v", "f", "anchor", "force"):
            setattr(struct, name, view(getattr(shared, name), t.vec))
        if shared.contact is not None:
            shared.contact.add_to(struct)
        return struct

    def load(self, start: Nodal, adj_end: Nodal) -> None:
        """Copy the initial displacements and the adjoint of the final state into the buffers, and clear all sums."""
        if not stores_u(self.model.spec):
            self.u[0].copy_(start.u.detach())
            if start.low is None:
                clear(self.shared.low)
            else:
                self.shared.low.copy_(start.low.detach()[:, 0])
        self.found.clear()
        self.forward.words.fill_(NEVER)
        shared = self.shared
        clear(shared.mass)
        if shared.contact is not None:
            shared.contact.clear()
        for own, given in zip(shared.state, adj_end[:4], strict=True):
            own.copy_(given)

    def unload(self, stream: wp.Stream | None, chunk: Chunk, adj_inputs: InputsAdj) -> Nodal:
        """Add the adjoints of the inputs into ``adj_inputs``; returns that of the initial state."""
        adj_inputs.add(self.found, chunk.rows)
        add_unsorted(stream, self._unsort, self.found, chunk.rows, adj_inputs)
        if chunk.begins:
            clear(self.shared.force)
        return Nodal(*(one.clone() for one in self.shared.state))
