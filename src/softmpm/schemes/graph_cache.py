"""Cache of chunk graphs: launches of a chunk that were captured on fixed buffers and are leased to one call at a time."""

import threading
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.capture import is_capturing, keep_alive, once_in_capture

T = TypeVar("T")


class CachedGraph(NamedTuple):
    """A chunk graph and its adjoint graphs, which refer to it, with the shared buffers that each works on."""

    graph: Any
    adjoints: dict[RequestedGrads, tuple[Any, Any]]


RETAINED_SHAPES = {False: 4, True: 2}
"""Number of chunk shapes whose graphs are always retained in the cache, for graphs that store their intermediate states (True) or not
(False). A call has at most two shapes, and graphs that store nothing serve calls both with and without gradient."""


class _FreeList(list[CachedGraph]):
    """Free chunk graphs of one shape: a list that can be weakly referenced, see :func:`_return_to_cache`."""


def _bytes(graphs: list[CachedGraph]) -> int:
    """Bytes of the buffers of graphs and of the accumulators of their adjoints, which graphs may share; without their launches."""
    found = {
        id(one): one
        for cached in graphs
        for one in (adj.buffers.found for _, adj in cached.adjoints.values())
    }
    return sum(cached.graph.buffers.bytes for cached in graphs) + sum(one.bytes for one in found.values())


def _return_to_cache(free: weakref.ref[_FreeList], cached: CachedGraph) -> None:
    """Return a leased graph to its cache, if that still exists; the lease itself does not keep the cache alive."""
    if (graphs := free()) is not None:
        graphs.append(cached)


class GraphCache(ABC):
    """Cache of the chunk graphs that are not in use.

    Graphs of the most recent chunk shapes are always retained. Older ones are retained only while all of them fit into one call's
    share of the memory budget, since calls of different lengths have different shapes.

    A capture by PyTorch takes the graphs that it uses out of the cache, and its calls share them.
    """

    def __init__(self, model: Model):
        self.model = model
        # By whether they store their intermediate states, then by shape, the most recent last:
        self._free: dict[bool, dict[tuple, _FreeList]] = {False: {}, True: {}}
        self._shared: dict[Any, Any] = {}
        # The backward pass of this thread's calls may run in other threads.
        self.lock = threading.RLock()

    @abstractmethod
    def new_graph(self, chunk: Chunk, keep: bool) -> Any:
        """Graph of the chunks of one shape, with ``buffers.bytes``; ``keep`` is True if it stores its intermediate states."""

    @abstractmethod
    def new_shared(self, graph: Any, wanted: RequestedGrads) -> Any:
        """Buffers that all backward passes for the requested gradients share."""

    @abstractmethod
    def new_adjoint(self, graph: Any, shared: Any) -> Any:
        """Adjoint of a graph on these buffers, with its accumulators in ``buffers.found``."""

    def take(self, chunk: Chunk, keep: bool) -> tuple[CachedGraph, _FreeList]:
        """Acquire a graph, and the list that it is returned to."""
        with self.lock:
            shapes = self._free[keep]
            free = shapes[chunk.shape] = shapes.pop(chunk.shape, _FreeList())
            if is_capturing(self.model):
                return self._take_in_capture(chunk, keep, free)
            if free:
                return free.pop(), free
            self._forget(keep)
            return CachedGraph(self.new_graph(chunk, keep), {}), free

    def _take_in_capture(self, chunk: Chunk, keep: bool, free: _FreeList) -> tuple[CachedGraph, _FreeList]:
        """A graph that an earlier call of the capture returned, else one from the cache, else a new one; none is evicted meanwhile."""
        own = once_in_capture((self, keep, chunk.shape), _FreeList)
        if own:
            return own.pop(), own
        if not free:
            return CachedGraph(self.new_graph(chunk, keep), {}), own
        cached = free.pop()
        keep_alive(cached)  # with its adjoints
        return cached, own

    def _forget(self, keep: bool) -> None:
        """Evict old shapes to make room for another graph."""
        shapes, part = self._free[keep], self.model.budget // self.model.calls
        for shape in list(shapes)[: -RETAINED_SHAPES[keep]]:
            if _bytes([cached for free in shapes.values() for cached in free]) <= part:
                break
            del shapes[shape]

    def adjoint(self, cached: CachedGraph, wanted: RequestedGrads) -> Any:
        """The adjoint of a graph for the requested gradients, built on first use."""
        graph, adjoints = cached
        shared = self.shared(wanted, lambda: self.new_shared(graph, wanted))
        known = adjoints.get(wanted)
        if known is None or known[0] is not shared:
            if is_capturing(self.model):
                keep_alive(known)  # no graph may be destroyed now
            known = adjoints[wanted] = shared, self.new_adjoint(graph, shared)
        return known[1]

    def shared(self, key: Any, make: Callable[[], T]) -> T:
        """The buffers with this key, which chunks use one after the other; the first use makes them.

        A capture takes those of the cache, since its replays may run beside other calls.
        """

        def take() -> T:
            return self._shared.pop(key, None) or make()

        if is_capturing(self.model):
            return once_in_capture((self, key), take)
        found = self._shared[key] = take()
        return found


class Lease:
    """Lease of a chunk graph; returned when no result references its buffers."""

    def __init__(self, pool: GraphCache, chunk: Chunk, keep: bool):
        self.cached, free = pool.take(chunk, keep)
        weakref.finalize(self, _return_to_cache, weakref.ref(free), self.cached)
