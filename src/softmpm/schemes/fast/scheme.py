"""The fast scheme: chunks of substeps run as captured graphs, on particles sorted by cell and the grid nodes near them."""

import threading
import weakref
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import LONGEST, Footprint
from softmpm.schemes.alarm_check import StartCheck
from softmpm.schemes.buffers import Solid, SolidAdj
from softmpm.schemes.capture import is_capturing, keep_alive
from softmpm.schemes.failure_report import outgrown
from softmpm.schemes.fast.chunk_graph import ChunkGraph
from softmpm.schemes.fast.chunk_graph_adj import AdjointBuffers, ChunkGraphAdj
from softmpm.schemes.fast.footprint import FastFootprint
from softmpm.schemes.fast.particle_order import ParticleLayout
from softmpm.schemes.fast.sorted_state import SortedAdj, SortedState, Unpacker
from softmpm.state import State


class Pair(NamedTuple):
    """A chunk graph and its adjoint graphs, which refer to it."""

    graph: ChunkGraph
    adjoints: dict[RequestedGrads, ChunkGraphAdj]


STAY = {False: 4, True: 2}
"""Number of chunk shapes whose graphs always stay in the cache, by whether they store the states inside. A call has at most two
shapes, and graphs that store nothing serve calls with and without gradient in turn."""


class _FreeList(list[Pair]):
    """Free chunk graphs of one shape: a list that can be weakly referenced, see :func:`_give_back`."""


def _give_back(free: weakref.ref[_FreeList], pair: Pair) -> None:
    """Return a leased graph to its cache, if that still exists; the lease itself does not keep the cache alive."""
    if (graphs := free()) is not None:
        graphs.append(pair)


class GraphCache:
    """Cache of the chunk graphs that were built for one particle layout and are not in use.

    Graphs of the most recent chunk shapes always stay. Older ones stay only while all of them fit into one call's share of the
    memory budget, since calls of different lengths bring different shapes.
    """

    def __init__(self, model: Model, arrangement: ParticleLayout, unpacking: Unpacker):
        self.model, self.arrangement, self.unpacking = model, arrangement, unpacking
        # By whether they store the states inside, then by shape, the most recent last:
        self._free: dict[bool, dict[tuple, _FreeList]] = {False: {}, True: {}}
        self._scratch: dict[RequestedGrads, AdjointBuffers] = {}
        # Guards the adjoint buffers: the backward pass of this thread's calls may run in other threads.
        self.turn = threading.Lock()

    def take(self, chunk: Chunk, keep: bool) -> tuple[Pair, _FreeList]:
        """Acquire a graph, and the list that it is returned to; only this thread adds lists to the cache."""
        shapes = self._free[keep]
        free = shapes[chunk.shape] = shapes.pop(chunk.shape, _FreeList())
        if free:
            pair = free.pop()
            if is_capturing(self.model):
                # With its adjoints: their graphs must not be destroyed during a capture.
                keep_alive(pair)
            return pair, free
        if not is_capturing(self.model):  # else no graph may be destroyed
            self._forget(keep)
        return Pair(ChunkGraph(self.model, self.arrangement, chunk, keep), {}), free

    def _forget(self, keep: bool) -> None:
        """Evict old shapes to make room for another graph."""
        shapes, part = self._free[keep], self.model.budget // self.model.calls
        for shape in list(shapes)[: -STAY[keep]]:
            if sum(pair.graph.bytes for free in shapes.values() for pair in free) <= part:
                break
            del shapes[shape]

    def adjoint(self, pair: Pair, wanted: RequestedGrads) -> ChunkGraphAdj:
        graph, adjoints = pair
        if is_capturing(self.model):
            return ChunkGraphAdj(graph, wanted, AdjointBuffers(graph, wanted))
        if wanted not in self._scratch:
            self._scratch[wanted] = AdjointBuffers(graph, wanted)
        if wanted not in adjoints:
            adjoints[wanted] = ChunkGraphAdj(graph, wanted, self._scratch[wanted])
        return adjoints[wanted]


class _Lease:
    """Lease of a chunk graph; returned to the cache when no result references its buffers."""

    def __init__(self, pool: GraphCache, chunk: Chunk, keep: bool):
        self.pair, free = pool.take(chunk, keep)
        if not is_capturing(pool.model):  # else it belongs to the graph that is being captured
            weakref.finalize(self, _give_back, weakref.ref(free), self.pair)


class FastRun:
    """A chunk that has been launched; its chunk graph is leased as long as it or its final state lives.

    Attributes:
        renewed: Whether the particle layout was updated for its initial state.
        start, end: Initial and final state; the final one lies in the buffers of the chunk graph.
        words: Status words, see errors.py; then cells met along the order of the particles, and whether one is near the
            window's edge; shape (world + 2,).
    """

    def __init__(
        self,
        pool: GraphCache,
        renewed: bool,
        chunk: Chunk,
        start: State | SortedState,
        pull: Tensor | None,
        solid: Solid,
        keep: bool,
        frozen: Sequence[int] = (),
    ):
        self.pool, self.renewed, self.chunk, self.start = pool, renewed, chunk, start
        self._lease = _Lease(pool, chunk, keep)
        graph = self._lease.pair.graph
        graph.run(start, pull, solid, frozen)
        self.end = SortedState(pool.unpacking, graph.base[-1], graph.rows[-1], graph.order, self._lease)
        self.words = graph.words
        self.outgrow: Callable[[], None] | None = pool.arrangement.outgrow

    def vjp(
        self, adj_end: State | SortedAdj, adj_solid: SolidAdj, wanted: RequestedGrads
    ) -> tuple[SortedAdj, Tensor | None]:
        """Adjoint of the start and of the pull; adds that of the material into ``adj_solid``."""
        with self.pool.turn:
            adjoint = self.pool.adjoint(self._lease.pair, wanted)
            adj_pull = adjoint.run(adj_end, adj_solid)
            adj, order = adjoint.scratch.adj, adjoint.graph.order  # both are reused by other runs
            return SortedAdj(self.pool.unpacking, adj.clone(), order.clone()), adj_pull


class Fast:
    """See :class:`softmpm.schemes.scheme.Scheme`. One for each thread and stream: its buffers serve one run after the other."""

    footprint: ClassVar[Footprint] = FastFootprint()

    @classmethod
    def of(cls, model: Model) -> "Fast":
        """Kept in the model's workspace, so that it must not hold the model."""
        stream = torch.cuda.current_stream(model.device).cuda_stream if model.device.type == "cuda" else 0
        return model.workspace.get((cls, stream), lambda: cls(weakref.proxy(model)))

    def __init__(self, model: Model):
        self.model = model
        self._pool: GraphCache | None = None
        self._unpacking = Unpacker(model)
        self._start_check: StartCheck | None = None
        self._widened = False  # the window was just centred on the initial state of the next chunk
        # Substeps of the graph that is being captured since particles were last sorted in it:
        self._recorded = LONGEST

    def run(
        self,
        chunk: Chunk,
        start: State | SortedState,
        pull: Tensor | None,
        solid: Solid,
        keep: bool,
        frozen: Sequence[int] = (),
    ) -> FastRun:
        renewed = self._arrange(start, chunk)
        assert self._pool is not None
        return FastRun(self._pool, renewed, chunk, start, pull, solid, keep, frozen)

    def check_start(self, start: State, pull: Tensor | None, solid: Solid) -> Tensor:
        if self._start_check is None or is_capturing(self.model):
            check = StartCheck(self.model)
            if is_capturing(self.model):
                return check(start, pull, solid)
            self._start_check = check
        return self._start_check(start, pull, solid)

    def _arrange(self, start: State | SortedState, chunk: Chunk) -> bool:
        """Provide a valid particle layout; returns whether it was updated for this initial state."""
        if is_capturing(self.model):
            return self._arrange_blindly(start, chunk)
        self._recorded = LONGEST
        if self._pool is None:
            self._use(ParticleLayout(self.model, start.x))
        elif self._pool.arrangement.outgrown:
            self._use(self._pool.arrangement.grown(start.x))
        elif (
            self._pool.arrangement.stale or self.model.deterministic
        ):  # else results would depend on earlier calls
            self._pool.arrangement.resort(start.x)  # a particle outside the window is reported by the chunk
        else:
            renewed, self._widened = self._widened, False
            return renewed
        self._widened = False
        return True

    def _arrange_blindly(self, start: State | SortedState, chunk: Chunk) -> bool:
        """During a capture staleness cannot be observed, so particles are sorted at fixed intervals."""
        if self._pool is None:
            raise RuntimeError(
                "a CUDA graph is being captured, and this model has not run before on this stream: run the same work once "
                "first, or let softmpm.Graph do it."
            )
        keep_alive(self._pool.arrangement)
        renew = self._recorded >= LONGEST or self.model.deterministic
        if renew:
            self._pool.arrangement.resort(start.x)
            self._recorded = 0
        self._recorded += chunk.length
        return renew

    def _use(self, arrangement: ParticleLayout) -> None:
        self._pool = GraphCache(self.model, arrangement, self._unpacking)

    def accept(self, run: FastRun, words: list[int]) -> bool:
        """False if a particle left the window."""
        *words, cells, near_edge = words
        if outgrown(words):
            self._widen(run)
            return False
        run.pool.arrangement.update_staleness(cells, bool(near_edge))
        return True

    def checkpoint(self, state: State | SortedState) -> State | SortedState:
        return state if isinstance(state, State) else state.copy()

    def to_user(self, state: State | SortedState | SortedAdj) -> State:
        return state if isinstance(state, State) else state.state()

    def _widen(self, run: FastRun) -> None:
        """After a particle left the window: centre it on the initial state the first time, enlarge it from then on."""
        arrangement = run.pool.arrangement
        if run.renewed or arrangement.left:
            self._use(arrangement.grown(run.start.x))
        else:
            arrangement.resort(run.start.x)
            arrangement.left = True
        self._widened = True
