"""Capture of CUDA graphs: the process-wide lock, and the objects that a captured graph refers to."""

import contextlib
import gc
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeVar

import torch

from softmpm.model import Model
from softmpm.schemes.failure_report import failed_worlds, outgrown

T = TypeVar("T")


def is_capturing(model: Model) -> bool:
    """True while PyTorch captures a CUDA graph on the current stream; the host must not wait for the device then."""
    return model.device.type == "cuda" and torch.cuda.is_current_stream_capturing()


_capture_lock = threading.Lock()


@contextlib.contextmanager
def exclusive_capture(wait: bool) -> Iterator[bool]:
    """Hold the process-wide capture lock with garbage collection disabled.

    The collector may destroy a CUDA graph, which during a capture invalidates that capture.

    Yields:
        Whether the lock was acquired; always True if ``wait``.
    """
    if not _capture_lock.acquire(blocking=wait):
        yield False
        return
    collects = gc.isenabled()
    gc.disable()
    try:
        yield True
    finally:
        if collects:
            gc.enable()
        _capture_lock.release()


class Status(NamedTuple):
    """Status words of a captured call, one for each world, to be read after each replay."""

    words: torch.Tensor
    outgrow: Callable[[], None] | None = None
    """To be called if a particle left the window; None without a window."""
    collect: Callable[[list[int]], None] | None = None
    """Takes words that report a failure, of a call that collects failures; None if it raises them."""


class GraphResources:
    """Objects that a captured CUDA graph refers to; they must outlive it.

    Attributes:
        statuses: Those of the captured calls, in the order of time.
        uses: Buffers that the graph reads and writes and that existed before the capture. Tensors that are created during the
            capture lie in the graph's own memory pool.
        made: Objects that parts of the capture share, by a key.
        changed: To be called after each replay, since the graph changes on the device what calls outside of it go by.
    """

    def __init__(self):
        self.statuses: list[Status] = []
        self.uses: list[object] = []
        self.made: dict[object, Any] = {}
        self.changed: list[Callable[[], None]] = []

    def collect(self) -> bool:
        """After a replay that failed: give each failure to the call that collects it. False if there is one that is to be raised."""
        found = [(status.collect, words) for status, words in self._reports() if failed_worlds(words)]
        if any(collect is None for collect, _ in found):
            return False  # the work is done again, and collects
        for collect, words in found:
            assert collect is not None
            collect(words)
        return True

    def widen(self) -> bool:
        """After a replay that failed: larger windows where a particle left one. True if there was such a one; capture anew then."""
        left = [one.outgrow for one, words in self._reports() if one.outgrow and outgrown(words)]
        for outgrow in left:
            outgrow()
        return bool(left)

    def _reports(self) -> Iterator[tuple[Status, list[int]]]:
        """All statuses with what the device has written there."""
        if self.statuses:
            yield from zip(self.statuses, _on_host([one.words for one in self.statuses]), strict=True)


def _on_host(words: list[torch.Tensor]) -> list[list[int]]:
    """Copied at once: a long simulation has hundreds."""
    rest = iter(torch.cat(words).tolist())
    return [[next(rest) for _ in range(len(one))] for one in words]


_open: list[GraphResources] = []
"""Resources of the graph that is being captured: one at a time, and its backward pass runs in another thread."""


@contextlib.contextmanager
def collected_resources() -> Iterator[GraphResources]:
    """Collect the resources of the graph that is captured inside."""
    _open.append(GraphResources())
    try:
        yield _open[-1]
    finally:
        _open.pop()


def defer_status_check(
    words: torch.Tensor,
    outgrow: Callable[[], None] | None = None,
    collect: Callable[[list[int]], None] | None = None,
) -> None:
    """Check these status words after each replay of the graph that is being captured; arguments are those of :class:`Status`."""
    _resources().statuses.append(Status(words, outgrow, collect))


def keep_alive(used: object) -> None:
    """Keep an object alive for as long as the graph that is being captured."""
    _resources().uses.append(used)


def after_replay(changed: Callable[[], None]) -> None:
    """Call this after each replay of the graph that is being captured."""
    _resources().changed.append(changed)


def once_in_capture(key: object, make: Callable[[], T]) -> T:
    """An object of the graph that is being captured, made on first use."""
    made = _resources().made
    if key not in made:
        made[key] = make()
    return made[key]


def _resources() -> GraphResources:
    if not _open:
        raise RuntimeError(
            "softmpm cannot report failures inside a CUDA graph of your own: capture it with softmpm.Graph."
        )
    return _open[-1]
