"""The fast scheme: chunks of substeps run as captured graphs, on particles sorted by cell and the grid nodes near them."""

from collections.abc import Callable
from typing import ClassVar

from torch import Tensor

from softmpm.kernels.compile import compile_together
from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import LONGEST, Footprint
from softmpm.schemes.alarm_check import StartCheck
from softmpm.schemes.capture import after_replay, is_capturing, keep_alive
from softmpm.schemes.carried import check_start
from softmpm.schemes.device import of_this_stream, stream_of
from softmpm.schemes.failure_report import began_outside, outgrown
from softmpm.schemes.fast.adjoint_buffers import SharedAdjoint
from softmpm.schemes.fast.chunk_graph import ChunkGraph, ChunkGraphAdj
from softmpm.schemes.fast.footprint import FastFootprint, copies
from softmpm.schemes.fast.kernels import first_kernels
from softmpm.schemes.fast.particle_order import ParticleLayout
from softmpm.schemes.fast.sorted_state import SortedAdj, SortedState, Unpacker
from softmpm.schemes.graph_cache import GraphCache, Lease
from softmpm.schemes.inputs import InputsAdj, Values
from softmpm.schemes.surface_start import with_surface
from softmpm.state import State


class LayoutGraphs(GraphCache):
    """Chunk graphs that were built for one particle layout."""

    def __init__(self, model: Model, layout: ParticleLayout, unpacker: Unpacker):
        super().__init__(model)
        self.layout, self.unpacker = layout, unpacker

    def new_graph(self, chunk: Chunk, keep: bool) -> ChunkGraph:
        return ChunkGraph(self.model, self.layout, chunk, keep)

    def new_shared(self, graph: ChunkGraph, wanted: RequestedGrads) -> SharedAdjoint:
        return SharedAdjoint(graph.buffers, wanted)

    def new_adjoint(self, graph: ChunkGraph, shared: SharedAdjoint) -> ChunkGraphAdj:
        return ChunkGraphAdj(graph, shared)


class FastRun:
    """A chunk that has been launched; its chunk graph is leased as long as it or its final state lives. If states are copied, this
    ends with :meth:`release`, and :meth:`vjp` leases a chunk graph again.

    Attributes:
        updated: True if the particle layout was updated for its initial state.
        start, end: Initial and final state, until the run is released; the final one lies in the buffers of the chunk graph.
        words: Status words, see errors.py; then the number of changes of cell along the order of the particles, and whether a
            particle is near the window's edge; shape (world + 2,).
    """

    def __init__(
        self,
        pool: LayoutGraphs,
        updated: bool,
        chunk: Chunk,
        start: State | SortedState,
        values: Values,
        keep: bool,
        frozen: Tensor | None = None,
    ):
        self.pool, self.updated, self.chunk, self.start = pool, updated, chunk, start
        self._lease: Lease | None = Lease(pool, chunk, keep)
        graph, stream = self._lease.cached.graph, stream_of(pool.model.device)
        buffers = graph.buffers
        buffers.load(stream, chunk, start, values, frozen)
        graph.run(stream)
        surface = None if buffers.contact is None else buffers.contact.end
        packed = buffers.base[-1], buffers.rows[-1], buffers.order
        self.end = SortedState(pool.unpacker, *packed, surface, self._lease)
        self.words = buffers.words
        self._values, self._stored = values, None  # StoredStates after release, if they are copied
        self.outgrow: Callable[[], None] | None = pool.layout.outgrow

    def release(self) -> None:
        del self.start, self.end  # each may hold the lease of a chunk graph
        if copies(self.pool.model) and self._lease is not None:
            self._stored, self._lease = self._lease.cached.graph.buffers.copy(), None
            del self.words  # other runs overwrite them; vjp sets new ones

    def vjp(self, adj_end: State | SortedAdj, adj_inputs: InputsAdj, wanted: RequestedGrads) -> SortedAdj:
        """Adjoint of the initial state; the adjoints of the inputs are added into ``adj_inputs``."""
        with self.pool.lock:
            lease, stream = self._lease or self._restored(), stream_of(self.pool.model.device)
            adjoint = self.pool.adjoint(lease.cached, wanted)
            buffers = adjoint.buffers
            buffers.load(stream, adj_end)
            adjoint.run(stream)
            buffers.unload(stream, self.chunk, adj_inputs)
            adj, order = buffers.shared.adj, buffers.forward.order  # both are reused by other runs
            contact = buffers.shared.contact
            surface = None if contact is None else contact.start(self.chunk)
            if self._stored is not None:
                self.words = buffers.forward.words.clone()
            return SortedAdj(self.pool.unpacker, adj.clone(), order.clone(), surface)

    def _restored(self) -> Lease:
        """Lease of a chunk graph into which the copied states were restored."""
        assert self._stored is not None
        lease = Lease(self.pool, self.chunk, keep=True)
        stream = stream_of(self.pool.model.device)
        lease.cached.graph.buffers.restore(stream, self.chunk, self._stored, self._values)
        return lease


class Fast:
    """See :class:`softmpm.schemes.scheme.Scheme`. Each thread and stream has its own, since its buffers serve one run at a time."""

    footprint: ClassVar[Footprint] = FastFootprint()

    @classmethod
    def of(cls, model: Model) -> "Fast":
        return of_this_stream(cls, model)

    def __init__(self, model: Model):
        self.model = model
        compile_together(first_kernels(model), model.wp_device)
        self._pool: LayoutGraphs | None = None
        self._unpacker = Unpacker(model)
        self._start_check: StartCheck | None = None
        self._widened = False  # the window was just centred on the initial state of the next chunk
        # Substeps since the particles were last sorted, in the graph that is being captured:
        self._since_sort = LONGEST

    def run(
        self,
        chunk: Chunk,
        start: State | SortedState,
        values: Values,
        keep: bool,
        frozen: Tensor | None = None,
    ) -> FastRun:
        updated = self._provide_layout(start, chunk)
        assert self._pool is not None
        return FastRun(self._pool, updated, chunk, start, values, keep, frozen)

    def check_start(self, start: State, values: Values) -> Tensor:
        check = self._start_check
        if check is None or is_capturing(self.model):
            check = StartCheck(self.model)
            if not is_capturing(self.model):
                self._start_check = check
        words = check(start, values)
        if start.surface is not None:
            check_start(self.model, start, values, words)
        return words

    def _provide_layout(self, start: State | SortedState, chunk: Chunk) -> bool:
        """Provide a valid particle layout; True if it was updated for this initial state."""
        if is_capturing(self.model):
            return self._layout_in_capture(start, chunk)
        self._since_sort = LONGEST
        if self._pool is None:
            self._use(ParticleLayout(self.model, start.x))
        elif self._pool.layout.outgrown:
            self._use(self._pool.layout.grown(start.x))
        elif (
            self._pool.layout.stale or self.model.deterministic
        ):  # else results would depend on earlier calls
            self._pool.layout.resort(start.x)  # a particle outside the window is reported by the chunk
        else:
            updated, self._widened = self._widened, False
            return updated
        self._widened = False
        return True

    def _layout_in_capture(self, start: State | SortedState, chunk: Chunk) -> bool:
        """Sort at fixed intervals during a capture, since staleness cannot be read back, and centre the window for each call."""
        if self._pool is None:
            raise RuntimeError(
                "a CUDA graph is being captured, and this model has not run before on this stream: run the same work once "
                "first, or let softmpm.Graph do it."
            )
        keep_alive(self._pool.layout)
        layout, resorts = self._pool.layout, self._since_sort >= LONGEST or self.model.deterministic
        updates = resorts or isinstance(start, State)
        if resorts:
            layout.resort(start.x)
            self._since_sort = 0
        elif updates:
            layout.centre(start.x)
        if updates:
            after_replay(layout.changed)
        self._since_sort += chunk.length
        return updates

    def _use(self, layout: ParticleLayout) -> None:
        self._pool = LayoutGraphs(self.model, layout, self._unpacker)

    def accept(self, run: FastRun, words: list[int]) -> bool:
        """Update the staleness of the layout; False if a particle or a surface point left the window."""
        *words, cells, near_edge = words
        if outgrown(words):
            self._widen(run, began_outside(words))
            return False
        run.pool.layout.update_staleness(cells, bool(near_edge))
        return True

    def checkpoint(self, state: State | SortedState) -> State | SortedState:
        return state if isinstance(state, State) else state.copy()

    def to_user(self, state: State | SortedState | SortedAdj) -> State:
        return state if isinstance(state, State) else state.state()

    particles = to_user

    def rest(self) -> State:
        state = self.model.rest()
        return state if self.model.surface is None else with_surface(self.model, state, {})

    def _widen(self, run: FastRun, began_outside: bool) -> None:
        """After a particle left the window: centre it on the initial state the first time, enlarge it from then on.

        A call that began elsewhere, as each episode does after a walk, says nothing about the room that a chunk needs.
        """
        layout = run.pool.layout
        if run.updated or (layout.left and not began_outside):
            self._use(layout.grown(run.start.x))
        else:
            layout.resort(run.start.x)
            if not began_outside:
                layout.left = True
        self._widened = True
