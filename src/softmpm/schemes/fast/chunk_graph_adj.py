"""The adjoint of a chunk graph: the adjoint launches from the last substep to the first, captured as a graph as well."""

import torch
import warp as wp

from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.g2p2g_adj import fused_adj
from softmpm.kernels.fast.native import BLOCK
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.structs import RequestedGrads
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import slot, view
from softmpm.schemes.device import stream_of
from softmpm.schemes.fast.chunk_graph import ChunkGraph
from softmpm.schemes.fast.fixed_point import FixedPointAccumulator
from softmpm.schemes.fast.sorted_inputs import add_unsorted, unsort
from softmpm.schemes.fast.sorted_state import SortedAdj
from softmpm.schemes.inputs import Accumulators, InputsAdj
from softmpm.schemes.launch import KernelLauncher, LaunchReplay, RebindableLaunch
from softmpm.state import State


class AdjointBuffers:
    """Buffers that a backward pass needs only while it runs; all chunk graphs of a particle layout share them."""

    def __init__(self, graph: ChunkGraph, wanted: RequestedGrads):
        model, t = graph.model, graph.types

        def tensor(*size):
            return torch.empty(*size, dtype=model.dtype, device=model.device)

        self.adj = tensor(graph.rows.shape[1])
        self.nodes = tensor(2, len(graph.velocity), 4)
        self.velocity = tensor(len(graph.velocity), 4)
        self.adj_array = view(self.adj, t.real)
        self.node_arrays = [view(nodes, t.aligned) for nodes in self.nodes]
        self.velocity_array = view(self.velocity, t.aligned)
        self.wanted = wanted
        self._accumulators: dict[int, Accumulators] = {}
        self.exact = None
        if model.spec.deterministic:
            self.exact = FixedPointAccumulator(model, self.adj_array, self.node_arrays)

    def accumulators(self, graph: ChunkGraph, rows: int) -> Accumulators:
        """Accumulators for chunks that touch this number of control steps, built on first use."""
        if rows not in self._accumulators:
            nodes = len(self.velocity) // graph.model.worlds
            self._accumulators[rows] = Accumulators(graph.model, self.wanted, rows, nodes)
        return self._accumulators[rows]


class ChunkGraphAdj:
    """Vector-Jacobian product of a chunk graph that stores its states."""

    def __init__(self, graph: ChunkGraph, wanted: RequestedGrads, scratch: AdjointBuffers):
        self.graph, self.wanted, self.scratch = graph, wanted, scratch
        self._backward = LaunchReplay(graph.model)
        rows = graph.chunk.row(graph.chunk.length - 1) + 1
        self.found = scratch.accumulators(graph, rows)
        self._unsort = unsort(graph.model, graph.order, self.found)
        self._build_launches()

    def _build_launches(self) -> None:
        """Build the launches that fill the buffers from a user's adjoint or from that of the next chunk."""
        graph, t, model = self.graph, self.graph.types, self.graph.model
        pack, lead, adj, at = graph.packing, graph.lead, self.scratch.adj_array, graph.order_array
        end = [slot(model, dtype) for dtype in (t.vec, t.vec, t.mat, t.mat)]
        self._enter = RebindableLaunch(model, pack.enter_adj, lead, (model.constants, at, *end, adj), end)
        given = [slot(model, wp.int32), slot(model, t.real, len(self.scratch.adj))]
        move = sorting(t.dim, model.spec.dtype).move_adj
        self._move = RebindableLaunch(model, move, lead, (at, *given, adj), given)

    def run(self, chunk: Chunk, adj_end: State | SortedAdj, adj_inputs: InputsAdj) -> None:
        """Compute the adjoint of the initial state in the adjoint buffers, and add those of the inputs into ``adj_inputs``."""
        graph, scratch = self.graph, self.scratch
        stream = stream_of(graph.model.device)
        self.found.clear()
        if scratch.exact is not None:
            scratch.exact.begin(None)
        graph.reset_status()
        self._take(stream, adj_end)
        self._backward.run(stream, self._launch_all)
        adj_inputs.add(self.found, chunk.rows)
        add_unsorted(stream, self._unsort, self.found, chunk.rows, adj_inputs)

    def _take(self, stream: wp.Stream | None, adj_end: State | SortedAdj) -> None:
        """Copy the adjoint of the final state into the buffers, permuted into the present order."""
        if isinstance(adj_end, SortedAdj):
            self._move(stream, adj_end.inverse_permutation(), adj_end.rows)
        else:
            self._enter(stream, *adj_end[:4])

    def _launch_all(self, launch: KernelLauncher) -> None:
        clear_nodes, held = fused(self.graph.model.spec).clear, len(self.scratch.velocity)
        launch(clear_nodes, held, self.scratch.velocity_array, block_dim=BLOCK)
        for s in range(self.graph.chunk.length, -1, -1):
            self._grid(s, launch)
            self._particles(s, launch)
            chunk = self.graph.chunk
            if s == 0 or (s < chunk.length and chunk.row(s - 1) != chunk.row(s)):
                self.found.collect(chunk.row(s), self.graph.inputs.values, launch)

    def _grid(self, s: int, launch: KernelLauncher) -> None:
        """Launch the adjoint of the grid stage of substep ``s``, and recompute the nodal velocities of substep ``s - 1``."""
        graph, nothing, (here, before) = self.graph, self.graph.nothing, self._adj_nodes(s)
        model, nodes, velocity = graph.model, graph.node_arrays, self.scratch.velocity_array
        if self.scratch.exact is not None:
            here, before = self.scratch.exact.sums(s), nothing
        last, first = s == graph.chunk.length, s == 0
        now, then = nothing if last else nodes[s], nothing if first else nodes[s - 1]
        kernel = fused_adj(model.spec, self.wanted).grid_velocity_adj
        stages = [(max(s - 1, 0) if last else s, now, then)]
        if model.spec.moving and not (last or first):  # the walls have another pose in each
            stages = [(s, now, nothing), (s - 1, nothing, then)]
        for k, now, then in stages:
            row = graph.chunk.row(k)
            inputs, adj_inputs = graph.inputs.grid_struct(k), self.found.grid_struct(row)
            arguments = (model.constants, inputs, graph.window, now, then, here, velocity, before, adj_inputs)
            launch(kernel, len(self.scratch.velocity), *arguments, block_dim=BLOCK)

    def _adj_nodes(self, s: int) -> tuple[wp.array, wp.array]:
        """Adjoint grids of substep ``s`` and of the previous substep."""
        return self.scratch.node_arrays[s % 2], self.scratch.node_arrays[(s + 1) % 2]

    def _particles(self, s: int, launch: KernelLauncher) -> None:
        """Launch the adjoint of P2G of substep ``s``, then that of G2P of the previous substep."""
        graph, scratch, (here, before) = self.graph, self.scratch, self._adj_nodes(s)
        model, length, exact = graph.model, graph.chunk.length, scratch.exact
        per_warp = graph.particles_of_warp(may_halve=True)
        sink = before if exact is None else exact.shares(s - 1)
        inputs, start, end = graph.inputs.particle_struct(s, s - 1), s == 0, s == length
        rows = [graph.chunk.row(min(max(k, 0), length - 1)) for k in (s, s - 1)]
        parameters = (model.constants, inputs, graph.window, length - 1 - s, start, end, per_warp)
        sizes = (model.particle_count, graph.total, graph.order_flat)
        states = (graph.packed[max(s - 1, 0)], graph.packed[s])
        grids = (scratch.velocity_array, here, scratch.adj_array)
        out = (graph.words_array, self.found.particle_struct(*rows), sink)
        kernel = fused_adj(model.spec, self.wanted).g2p2g_adj[graph.few]
        arguments = (*parameters, *sizes, *states, *grids, *out)
        launch(kernel, graph.threads(per_warp), *arguments, block_dim=graph.block)
        if exact is not None and not start:
            exact.accumulate(graph, s - 1, states[0], None, launch)
