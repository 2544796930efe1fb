"""The adjoint of a program: the same launches from the last substep to the first, replayed as a graph as well."""

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.g2p2g_adj import fused_adj
from softmpm.kernels.fast.material_order import sorted_solid_adj
from softmpm.kernels.fast.native import BLOCK
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.physics.actuation_sum import PARTS, collect_pull, collect_pull_in_order, collectors
from softmpm.kernels.structs import Wanted, solid_adj_type
from softmpm.schemes.buffers import SolidAdj, clear, slot, slots_in, view
from softmpm.schemes.device import stream_of
from softmpm.schemes.fast.chunk_graph import Program
from softmpm.schemes.fast.fixed_point import Exact
from softmpm.schemes.fast.sorted_state import SortedAdj
from softmpm.schemes.launch import Command, Launcher, Replay
from softmpm.state import State


class Scratch:
    """What a backward pass needs only while it runs; the programs of an arrangement share it."""

    def __init__(self, program: Program, wanted: Wanted):
        model, t = program.model, program.types

        def tensor(*size):
            return torch.empty(*size, dtype=model.dtype, device=model.device)

        self.adj = tensor(program.rows.shape[1])
        self.nodes = tensor(2, len(program.velocity), 4)
        self.velocity = tensor(len(program.velocity), 4)
        self.solid = SolidAdj.zeros(model, wanted)
        self.adj_array = view(self.adj, t.real)
        self.node_arrays = [view(nodes, t.aligned) for nodes in self.nodes]
        self.velocity_array = view(self.velocity, t.aligned)
        self.exact = None
        if model.spec.deterministic:
            self.exact = Exact(model, self.adj_array, self.node_arrays)
        self.solid_struct = self.solid.struct(model)
        self.tensors = [part for part in (self.solid.material, self.solid.slot) if part is not None]


class ProgramAdj:
    """Pulls adjoints back through a program that kept its states."""

    def __init__(self, program: Program, wanted: Wanted, scratch: Scratch):
        self.program, self.wanted, self.scratch = program, wanted, scratch
        self.adj_pull = None
        if wanted.activation and program.pull is not None:
            self.adj_pull = torch.zeros_like(program.pull)
            self._adj_rows = [view(row, program.types.real) for row in self.adj_pull]
            if program.model.spec.deterministic:
                self._parts = view(
                    self.adj_pull.new_empty(*self.adj_pull.shape[1:], PARTS), program.types.real
                )
        self._backward = Replay(program.model)
        self._commands()

    def _commands(self) -> None:
        """The twins of those of the program."""
        program, t, model = self.program, self.program.types, self.program.model
        pack, lead, adj, at = program.packing, program.lead, self.scratch.adj_array, program.order_array
        end = [slot(model, dtype) for dtype in (t.vec, t.vec, t.mat, t.mat)]
        self._enter = Command(model, pack.enter_adj, lead, (model.scale, at, *end, adj), end)
        given = [slot(model, wp.int32), slot(model, t.real, len(self.scratch.adj))]
        move = sorting(t.dim, model.spec.dtype).move_adj
        self._move = Command(model, move, lead, (at, *given, adj), given)
        if self.wanted.material:
            found = solid_adj_type(model.spec, self.wanted)()
            slots = slots_in(found, ("mass", "mu", "lam"), model, t.real)
            kernel = sorted_solid_adj(model.spec, self.wanted)
            self._sort = Command(model, kernel, lead, (at, self.scratch.solid_struct, found), slots)

    def run(self, adj_end: State | SortedAdj, adj_solid: SolidAdj) -> Tensor | None:
        """Leaves the adjoint of the start in the scratch and adds into ``adj_solid``; gives that of the pull, if it is wanted."""
        program, scratch = self.program, self.scratch
        stream = stream_of(program.model.device)
        for tensor in scratch.tensors:
            clear(tensor)
        if scratch.exact is not None:
            scratch.exact.begin(None)
        if self.adj_pull is not None:
            clear(self.adj_pull)
        program.calm()
        self._take(stream, adj_end)
        self._backward.run(stream, self._launch_all)
        if adj_solid.mass is not None and adj_solid.mu is not None and adj_solid.lam is not None:
            self._sort(stream, adj_solid.mass, adj_solid.mu, adj_solid.lam)
        return None if self.adj_pull is None else self.adj_pull.clone()

    def _take(self, stream: wp.Stream | None, adj_end: State | SortedAdj) -> None:
        """Put the adjoint of the end where the kernels look for it."""
        if isinstance(adj_end, SortedAdj):
            self._move(stream, adj_end.places(), adj_end.rows)
        else:
            self._enter(stream, *adj_end[:4])

    def _launch_all(self, launch: Launcher) -> None:
        clear_nodes, held = fused(self.program.model.spec).clear, len(self.scratch.velocity)
        launch(clear_nodes, held, self.scratch.velocity_array, block_dim=BLOCK)
        for s in range(self.program.chunk.length, -1, -1):
            self._grid(s, launch)
            self._particles(s, launch)
            if self.adj_pull is not None and s < self.program.chunk.length:
                self._collect(s, launch)

    def _grid(self, s: int, launch: Launcher) -> None:
        """Adjoint of the nodes of substep ``s``, velocity of the nodes of the substep before."""
        program, nothing, (here, before) = self.program, self.program.nothing, self._adj_nodes(s)
        model, nodes, velocity = program.model, program.node_arrays, self.scratch.velocity_array
        if self.scratch.exact is not None:
            here, before = self.scratch.exact.sums(s), nothing
        last, first = s == program.chunk.length, s == 0
        now, then = nothing if last else nodes[s], nothing if first else nodes[s - 1]
        arguments = (model.scale, model.walls, program.window, now, then, here, velocity, before)
        kernel = fused_adj(model.spec, self.wanted).grid_velocity_adj
        launch(kernel, len(self.scratch.velocity), *arguments, block_dim=BLOCK)

    def _adj_nodes(self, s: int) -> tuple[wp.array, wp.array]:
        """Adjoint grids of substep ``s`` and of the one before."""
        return self.scratch.node_arrays[s % 2], self.scratch.node_arrays[(s + 1) % 2]

    def _particles(self, s: int, launch: Launcher) -> None:
        """Adjoint of P2G of substep ``s``, then of G2P of the substep before."""
        program, scratch, (here, before) = self.program, self.scratch, self._adj_nodes(s)
        model, length, exact = program.model, program.chunk.length, scratch.exact
        crew = program.crew_of(may_halve=True)
        sink = before if exact is None else exact.shares(s - 1)
        solid, start, end = program.solid(min(s, length - 1)), s == 0, s == length
        parameters = (model.scale, solid, program.window, length - 1 - s, start, end, crew)
        sizes = (model.particle_count, program.total, program.order_flat)
        states = (program.packed[max(s - 1, 0)], program.packed[s])
        grids = (scratch.velocity_array, here, scratch.adj_array)
        out = (program.watch, scratch.solid_struct, sink)
        kernel = fused_adj(model.spec, self.wanted).advance_adj[program.few]
        arguments = (*parameters, *sizes, *states, *grids, *out)
        launch(kernel, program.threads(crew), *arguments, block_dim=program.block)
        if exact is not None and not start:
            exact.push(program, s - 1, states[0], None, launch)

    def _collect(self, s: int, launch: Launcher) -> None:
        """Where a control step begins, add what the particles found for its pull."""
        program, chunk = self.program, self.program.chunk
        slot = self.scratch.solid.slot
        if slot is None or (s != 0 and chunk.row(s - 1) == chunk.row(s)):
            return
        spec, row = program.model.spec, self._adj_rows[chunk.row(s)]
        found = program.muscle_array, view(slot, program.types.real)
        if spec.deterministic:
            in_order = collect_pull_in_order(spec)
            launch(in_order.parts, self._parts.shape, *found, self._parts)
            launch(in_order.total, row.shape, self._parts, row)
        else:
            launch(collect_pull(spec), collectors(slot.shape), *found, row)
