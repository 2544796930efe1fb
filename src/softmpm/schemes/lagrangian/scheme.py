"""The scheme of the reference formulation: chunks of substeps on the nodes at rest, any precision, any device."""

from collections.abc import Callable
from typing import Any, ClassVar

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import NEVER
from softmpm.kernels.lagrangian.cells import cells
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import Footprint
from softmpm.schemes.buffers import view
from softmpm.schemes.capture import is_capturing, keep_alive
from softmpm.schemes.device import of_this_stream, stream_of
from softmpm.schemes.graph_cache import GraphCache, Lease
from softmpm.schemes.inputs import InputsAdj, ReusedParticleStruct, Values, elapsed, grid_struct, stiffest
from softmpm.schemes.lagrangian.bricks import brick_launch, rest_struct
from softmpm.schemes.lagrangian.buffers import ChunkAdjoint, ChunkBuffers, SharedAdjoint
from softmpm.schemes.lagrangian.footprint import LagrangianFootprint
from softmpm.schemes.lagrangian.frame import shift_of
from softmpm.schemes.lagrangian.launches import launch_chunk, launch_chunk_adj
from softmpm.schemes.lagrangian.nodal import nodes_of, particles_of, with_reaction
from softmpm.schemes.lagrangian.overlap import OverlapCheck
from softmpm.schemes.lagrangian.surface import check_start
from softmpm.schemes.launch import LaunchReplay, launcher
from softmpm.state import Nodal, State


class ChunkGraph:
    """Captured launches of the chunks of one shape."""

    def __init__(self, model: Model, chunk: Chunk, keep: bool):
        self.buffers = ChunkBuffers(model, chunk, keep)
        self._replay = LaunchReplay(model)
        self._check: tuple[OverlapCheck, LaunchReplay] | None = None

    def load(
        self, stream: wp.Stream | None, chunk: Chunk, start: Nodal, values: Values, frozen: Tensor | None
    ) -> None:
        """Copy the initial state and the inputs of a chunk into the buffers."""
        self.buffers.load(stream, chunk, start, values, frozen)
        if self.buffers.reflection is not None:
            self.buffers.reflection.load(chunk, start)

    def run(self, stream: wp.Stream | None) -> None:
        """Launch all substeps on what the buffers hold."""
        self._replay.run(stream, lambda launch: launch_chunk(self.buffers, launch))

    def check(self, stream: wp.Stream | None, overlap: OverlapCheck) -> None:
        """Look for bodies that pass through each other in the final state."""
        model, known = self.buffers.model, self._check
        if known is None or known[0] is not overlap:
            if is_capturing(model):
                keep_alive(known)  # no graph may be destroyed now
            known = self._check = overlap, LaunchReplay(model)
        u, last = self.buffers.last_u, self.buffers.chunk.length - 1
        known[1].run(stream, lambda launch: overlap.check(launch, last, u, self.buffers.words_array))

    def end(self) -> Nodal:
        """Copy of the final state."""
        end, reflection = self.buffers.end(), self.buffers.reflection
        return with_reaction(self.buffers.model, end, reflection and reflection.reaction.clone())


class ChunkGraphAdj:
    """Captured adjoint launches of the chunks whose states a chunk graph stores."""

    def __init__(self, graph: ChunkGraph, shared: SharedAdjoint):
        self.buffers = ChunkAdjoint(graph.buffers, shared)
        self._replay = LaunchReplay(graph.buffers.model)

    def load(self, start: Nodal, adj_end: Nodal) -> None:
        """Copy the initial displacements and the adjoint of the final state into the buffers, and clear all sums."""
        self.buffers.load(start, adj_end)
        if self.buffers.reflection is not None:
            self.buffers.reflection.load(adj_end)

    def unload(self, stream: wp.Stream | None, chunk: Chunk, adj_inputs: InputsAdj) -> Nodal:
        """Add the adjoints of the inputs into ``adj_inputs``; returns that of the initial state."""
        adj, reflection = self.buffers.unload(stream, chunk, adj_inputs), self.buffers.reflection
        return with_reaction(self.buffers.model, adj, reflection and reflection.unload(chunk))

    def run(self, stream: wp.Stream | None) -> None:
        """Turn the adjoint of the final state in the buffers into that of the initial state."""
        self._replay.run(stream, lambda launch: launch_chunk_adj(self.buffers, launch))


class LagrangianGraphs(GraphCache):
    """Chunk graphs of one model."""

    @property
    def overlap(self) -> OverlapCheck | None:
        """Check for bodies that pass through each other, or None."""
        if self.model.overlap is None:
            return None
        return self.shared(OverlapCheck, lambda: OverlapCheck(self.model))

    def new_graph(self, chunk: Chunk, keep: bool) -> ChunkGraph:
        return ChunkGraph(self.model, chunk, keep)

    def new_shared(self, graph: ChunkGraph, wanted: RequestedGrads) -> SharedAdjoint:
        return SharedAdjoint(graph.buffers, wanted)

    def new_adjoint(self, graph: ChunkGraph, shared: SharedAdjoint) -> ChunkGraphAdj:
        return ChunkGraphAdj(graph, shared)


class LagrangianRun:
    """One chunk that was launched.

    Attributes:
        start, end: Nodal state before and after it; the end is passed on once the run is kept.
        words: Status words, see errors.py; shape (world,).
        outgrow: None, since nodes do not leave the grid at rest.
    """

    outgrow: Callable[[], None] | None = None

    def __init__(
        self,
        pool: LagrangianGraphs,
        chunk: Chunk,
        start: Nodal,
        values: Values,
        keep: bool,
        frozen: Tensor | None = None,
    ):
        self.pool, self.chunk, self.start = pool, chunk, start
        self._lease = Lease(pool, chunk, keep)
        graph, stream = self._lease.cached.graph, stream_of(pool.model.device)
        graph.load(stream, chunk, start, values, frozen)
        graph.run(stream)
        if (overlap := pool.overlap) is not None:
            graph.check(stream, overlap)
        self.end, self.words = graph.end(), graph.buffers.words

    def release(self) -> None:
        del self.end

    def vjp(self, adj_end: Nodal, adj_inputs: InputsAdj, wanted: RequestedGrads) -> Nodal:
        """Adjoint of the start; adds those of the inputs into ``adj_inputs``."""
        with self.pool.lock:
            adjoint = self.pool.adjoint(self._lease.cached, wanted)
            adjoint.load(self.start, adj_end)
            stream = stream_of(self.pool.model.device)
            adjoint.run(stream)
            return adjoint.unload(stream, self.chunk, adj_inputs)


class Lagrangian:
    """See :class:`softmpm.schemes.scheme.Scheme`. Its states are nodal. Each thread and stream has its own, since its buffers serve one
    run at a time.
    """

    footprint: ClassVar[Footprint] = LagrangianFootprint()

    @classmethod
    def of(cls, model: Model) -> "Lagrangian":
        return of_this_stream(cls, model)

    def __init__(self, model: Model):
        self.model, self._pool = model, LagrangianGraphs(model)
        self._start_inputs = ReusedParticleStruct(model)

    def run(
        self, chunk: Chunk, start: Nodal, values: Values, keep: bool, frozen: Tensor | None = None
    ) -> LagrangianRun:
        return LagrangianRun(self._pool, chunk, start, values, keep, frozen)

    def check_start(self, start: Nodal, values: Values) -> Tensor:
        model = self.model
        words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        u = view(start.u.detach().contiguous(), types(model.spec.dim, model.spec.dtype).vec)
        inputs = self._start_inputs.of(model.fixed | stiffest(model, values))
        arguments = (model.constants, inputs, rest_struct(model), 0, True, False, u, view(words, wp.int64))
        kernel = cells(model.spec, model.rest_grid.bricks).check_state
        launch = launcher(model)
        brick_launch(model, launch, kernel, *arguments)
        if model.surface is not None:
            known = model.fixed | values
            if model.spec.moving:
                known["elapsed"] = elapsed(model, 0, 1, 1)
            shift = view(shift_of(model, start), types(model.spec.dim, "float64").vec)
            check_start(model, launch, grid_struct(model, known), shift, u, view(words, wp.int64))
        return words

    def accept(self, run: LagrangianRun, words: list[int]) -> bool:
        return True

    def checkpoint(self, state: Nodal) -> Nodal:
        return state

    def rest(self) -> Nodal:
        model = self.model
        return nodes_of(model, model.rest(), model.mass.expand(model.worlds, -1))

    def to_user(self, state: Nodal) -> Nodal:
        return state

    def particles(self, state: Any) -> State:
        return particles_of(self.model, state)
