"""Buffers of the backward pass of a chunk of the fast scheme."""

import weakref

import torch
import warp as wp

from softmpm.kernels.fast.packing import packing
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.structs import RequestedGrads
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import placeholder, view
from softmpm.schemes.carried_adj import SurfaceContactAdj
from softmpm.schemes.fast.chunk_buffers import ChunkBuffers, sums_over
from softmpm.schemes.fast.contact_views import packed_nodes, vectors
from softmpm.schemes.fast.sorted_state import SortedAdj
from softmpm.schemes.inputs import Accumulators, InputsAdj
from softmpm.schemes.launch import RebindableLaunch
from softmpm.schemes.sorted_inputs import add_unsorted, unsort
from softmpm.state import State


class SharedAdjoint:
    """Buffers that a backward pass needs only while it runs; all chunks on a particle layout share them.

    Attributes:
        adj: Packed adjoint of the state.
        nodes: Adjoints of mass and momentum of the nodes, of two successive substeps.
        velocity: Recomputed nodal velocities; with contact at surface points of two successive substeps, then those before contact.
        contact: Adjoint of contact at surface points, or None.
        gained: What contact adds to the adjoints of velocities and masses.
        adj_loads: Adjoint of the loads, of two successive substeps.
        sums: How the particles add to the adjoints of the nodes.
    """

    def __init__(self, buffers: ChunkBuffers, wanted: RequestedGrads):
        model, t = buffers.model, buffers.types

        def tensor(*size):
            return torch.empty(*size, dtype=model.dtype, device=model.device)

        self.model, self.wanted = model, wanted
        self.adj = tensor(buffers.rows.shape[1])
        self.nodes = tensor(2, buffers.held, 4)
        self.velocity = tensor(1 if model.surface is None else 3, buffers.held, 4)
        self.adj_array = view(self.adj, t.real)
        self.node_arrays = [view(nodes, t.aligned) for nodes in self.nodes]
        self.velocity_arrays = [view(velocity, t.aligned) for velocity in self.velocity]
        self._accumulators = weakref.WeakValueDictionary[int, Accumulators]()  # as long as a chunk has them
        self.contact = None
        if model.surface is not None:
            self.contact = SurfaceContactAdj(model, wanted, packed=True)
            self.gained, self.adj_loads = tensor(buffers.held, 4), torch.empty_like(buffers.loads)
            self.gained_array = view(self.gained, t.aligned)
            self.gained_view = packed_nodes(model, self.gained)
            self.velocity_vectors = [vectors(model, velocity) for velocity in self.velocity]
            self.node_vectors = [vectors(model, nodes) for nodes in self.nodes]
            self.adj_load_arrays = [view(load, t.real) for load in self.adj_loads]
        self.sums = sums_over(model, lambda: self.adj, self.node_arrays)

    def velocity_at(self, s: int) -> wp.array:
        """Nodal velocities of substep ``s``."""
        return self.velocity_arrays[0 if self.contact is None else s % 2]

    def accumulators(self, rows: int) -> Accumulators:
        """Accumulators for chunks that touch this number of control steps, built on first use."""
        found = self._accumulators.get(rows)
        if found is None:
            nodes = self.velocity.shape[1] // self.model.worlds
            found = self._accumulators[rows] = Accumulators(self.model, self.wanted, rows, nodes)
        return found


class ChunkAdjoint:
    """Adjoint buffers of the chunks of one shape: those that are shared, and the launches that load and unload them.

    Attributes:
        forward: Buffers with the stored states.
        shared: Buffers that other chunks use as well.
        found: Accumulated adjoints of the inputs, in the order of the chunk.
    """

    def __init__(self, forward: ChunkBuffers, shared: SharedAdjoint):
        self.forward, self.shared, self.model = forward, shared, forward.model
        self.wanted, chunk = shared.wanted, forward.chunk
        self.found = shared.accumulators(chunk.row_count)
        self._unsort = unsort(self.model, forward.order, self.found)
        model, t, order = self.model, forward.types, forward.order_array
        pack, sort = packing(t.dim, model.spec.dtype), sorting(t.dim, model.spec.dtype)
        end = [placeholder(model, dtype) for dtype in (t.vec, t.vec, t.mat, t.mat)]
        arguments = (model.constants, order, *end, shared.adj_array)
        self._enter = RebindableLaunch(model, pack.enter_adj, forward.lead, arguments, end)
        given = [placeholder(model, wp.int32), placeholder(model, t.real, len(shared.adj))]
        arguments = (order, *given, shared.adj_array)
        self._move = RebindableLaunch(model, sort.move_adj, forward.lead, arguments, given)

    def load(self, stream: wp.Stream | None, adj_end: State | SortedAdj) -> None:
        """Copy the adjoint of the final state into the buffers, in the order of the chunk, and clear all sums."""
        self.found.clear()
        self.shared.sums.begin(None)
        self.forward.reset_status()
        if self.shared.contact is not None and adj_end.surface is not None:
            self.shared.contact.load(adj_end.surface)
        if isinstance(adj_end, SortedAdj):
            self._move(stream, adj_end.inverse_permutation(), adj_end.rows)
        else:
            self._enter(stream, *adj_end[:4])

    def unload(self, stream: wp.Stream | None, chunk: Chunk, adj_inputs: InputsAdj) -> None:
        """Add the adjoints of the inputs into ``adj_inputs``."""
        adj_inputs.add(self.found, chunk.rows)
        add_unsorted(stream, self._unsort, self.found, chunk.rows, adj_inputs)
