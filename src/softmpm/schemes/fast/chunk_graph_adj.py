"""The adjoint of a chunk graph: the adjoint launches from the last substep to the first, captured as a graph as well."""

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.g2p2g_adj import fused_adj
from softmpm.kernels.fast.material_order import sorted_solid_adj
from softmpm.kernels.fast.native import BLOCK
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.physics.actuation_sum import PARTS, collect_pull, collect_pull_in_order, collectors
from softmpm.kernels.structs import RequestedGrads, solid_adj_type
from softmpm.schemes.buffers import SolidAdj, clear, slot, slots_in, view
from softmpm.schemes.device import stream_of
from softmpm.schemes.fast.chunk_graph import ChunkGraph
from softmpm.schemes.fast.fixed_point import FixedPointAccumulator
from softmpm.schemes.fast.sorted_state import SortedAdj
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
        self.solid = SolidAdj.zeros(model, wanted)
        self.adj_array = view(self.adj, t.real)
        self.node_arrays = [view(nodes, t.aligned) for nodes in self.nodes]
        self.velocity_array = view(self.velocity, t.aligned)
        self.exact = None
        if model.spec.deterministic:
            self.exact = FixedPointAccumulator(model, self.adj_array, self.node_arrays)
        self.solid_struct = self.solid.struct(model)
        self.tensors = [part for part in (self.solid.material, self.solid.slot) if part is not None]


class ChunkGraphAdj:
    """Vector-Jacobian product of a chunk graph that stores its states."""

    def __init__(self, graph: ChunkGraph, wanted: RequestedGrads, scratch: AdjointBuffers):
        self.graph, self.wanted, self.scratch = graph, wanted, scratch
        self.adj_pull = None
        if wanted.activation and graph.pull is not None:
            self.adj_pull = torch.zeros_like(graph.pull)
            self._adj_rows = [view(row, graph.types.real) for row in self.adj_pull]
            if graph.model.spec.deterministic:
                self._parts = view(self.adj_pull.new_empty(*self.adj_pull.shape[1:], PARTS), graph.types.real)
        self._backward = LaunchReplay(graph.model)
        self._commands()

    def _commands(self) -> None:
        """Launches that fill the buffers, as those of the chunk graph."""
        graph, t, model = self.graph, self.graph.types, self.graph.model
        pack, lead, adj, at = graph.packing, graph.lead, self.scratch.adj_array, graph.order_array
        end = [slot(model, dtype) for dtype in (t.vec, t.vec, t.mat, t.mat)]
        self._enter = RebindableLaunch(model, pack.enter_adj, lead, (model.constants, at, *end, adj), end)
        given = [slot(model, wp.int32), slot(model, t.real, len(self.scratch.adj))]
        move = sorting(t.dim, model.spec.dtype).move_adj
        self._move = RebindableLaunch(model, move, lead, (at, *given, adj), given)
        if self.wanted.material:
            found = solid_adj_type(model.spec, self.wanted)()
            slots = slots_in(found, ("mass", "mu", "lam"), model, t.real)
            kernel = sorted_solid_adj(model.spec, self.wanted)
            self._sort = RebindableLaunch(model, kernel, lead, (at, self.scratch.solid_struct, found), slots)

    def run(self, adj_end: State | SortedAdj, adj_solid: SolidAdj) -> Tensor | None:
        """Compute the adjoint of the initial state in the adjoint buffers, and add that of the material into ``adj_solid``.

        Returns:
            Adjoint of the pull, if it is requested.
        """
        graph, scratch = self.graph, self.scratch
        stream = stream_of(graph.model.device)
        for tensor in scratch.tensors:
            clear(tensor)
        if scratch.exact is not None:
            scratch.exact.begin(None)
        if self.adj_pull is not None:
            clear(self.adj_pull)
        graph.reset_status()
        self._take(stream, adj_end)
        self._backward.run(stream, self._launch_all)
        if adj_solid.mass is not None and adj_solid.mu is not None and adj_solid.lam is not None:
            self._sort(stream, adj_solid.mass, adj_solid.mu, adj_solid.lam)
        return None if self.adj_pull is None else self.adj_pull.clone()

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
            if self.adj_pull is not None and s < self.graph.chunk.length:
                self._collect(s, launch)

    def _grid(self, s: int, launch: KernelLauncher) -> None:
        """Adjoint of the grid stage of substep ``s``, and the nodes' velocity of substep ``s - 1``."""
        graph, nothing, (here, before) = self.graph, self.graph.nothing, self._adj_nodes(s)
        model, nodes, velocity = graph.model, graph.node_arrays, self.scratch.velocity_array
        if self.scratch.exact is not None:
            here, before = self.scratch.exact.sums(s), nothing
        last, first = s == graph.chunk.length, s == 0
        now, then = nothing if last else nodes[s], nothing if first else nodes[s - 1]
        arguments = (model.constants, model.walls, graph.window, now, then, here, velocity, before)
        kernel = fused_adj(model.spec, self.wanted).grid_velocity_adj
        launch(kernel, len(self.scratch.velocity), *arguments, block_dim=BLOCK)

    def _adj_nodes(self, s: int) -> tuple[wp.array, wp.array]:
        """Adjoint grids of substep ``s`` and of the one before."""
        return self.scratch.node_arrays[s % 2], self.scratch.node_arrays[(s + 1) % 2]

    def _particles(self, s: int, launch: KernelLauncher) -> None:
        """Adjoint of P2G of substep ``s``, then of G2P of the substep before."""
        graph, scratch, (here, before) = self.graph, self.scratch, self._adj_nodes(s)
        model, length, exact = graph.model, graph.chunk.length, scratch.exact
        per_warp = graph.particles_of_warp(may_halve=True)
        sink = before if exact is None else exact.shares(s - 1)
        solid, start, end = graph.solid(min(s, length - 1)), s == 0, s == length
        parameters = (model.constants, solid, graph.window, length - 1 - s, start, end, per_warp)
        sizes = (model.particle_count, graph.total, graph.order_flat)
        states = (graph.packed[max(s - 1, 0)], graph.packed[s])
        grids = (scratch.velocity_array, here, scratch.adj_array)
        out = (graph.words_array, scratch.solid_struct, sink)
        kernel = fused_adj(model.spec, self.wanted).g2p2g_adj[graph.few]
        arguments = (*parameters, *sizes, *states, *grids, *out)
        launch(kernel, graph.threads(per_warp), *arguments, block_dim=graph.block)
        if exact is not None and not start:
            exact.accumulate(graph, s - 1, states[0], None, launch)

    def _collect(self, s: int, launch: KernelLauncher) -> None:
        """At the first substep of a control step, add the contributions of the particles to the adjoint of its pull."""
        graph, chunk = self.graph, self.graph.chunk
        slot = self.scratch.solid.slot
        if slot is None or (s != 0 and chunk.row(s - 1) == chunk.row(s)):
            return
        spec, row = graph.model.spec, self._adj_rows[chunk.row(s)]
        found = graph.muscle_array, view(slot, graph.types.real)
        if spec.deterministic:
            in_order = collect_pull_in_order(spec)
            launch(in_order.parts, self._parts.shape, *found, self._parts)
            launch(in_order.total, row.shape, self._parts, row)
        else:
            launch(collect_pull(spec), collectors(slot.shape), *found, row)
