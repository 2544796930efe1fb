"""Capture of CUDA graphs: the process-wide lock, and the objects that a captured graph refers to."""

import contextlib
import gc
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

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


class GraphResources:
    """Objects that a captured CUDA graph refers to; they must outlive it.

    Attributes:
        words: Status words of the captured calls, to be read after each replay, each with the function to call if they report
            that a particle left the window; None in its place without a window.
        uses: Buffers that the graph reads and writes and that existed before the capture. Tensors that are created during the
            capture lie in the graph's own memory pool.
        made: Objects that parts of the capture share, by a key.
        changed: To be called after each replay, since the graph changes on the device what calls outside of it go by.
    """

    def __init__(self):
        self.words: list[tuple[torch.Tensor, Callable[[], None] | None]] = []
        self.uses: list[object] = []
        self.made: dict[object, Any] = {}
        self.changed: list[Callable[[], None]] = []

    def failed(self) -> list[int]:
        """Worlds that the last replay reports as failed."""
        reports = [words.tolist() for words, _ in self.words]
        return sorted({world for words in reports for world in failed_worlds(words)})

    def widen(self) -> bool:
        """After a replay that failed: larger windows where a particle left one. True if there was such a one; capture anew then."""
        left = [outgrow for words, outgrow in self.words if outgrow and outgrown(words.tolist())]
        for outgrow in left:
            outgrow()
        return bool(left)


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


def defer_status_check(words: torch.Tensor, outgrow: Callable[[], None] | None = None) -> None:
    """Check these status words, one for each world, after each replay of the graph that is being captured."""
    _resources().words.append((words, outgrow))


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
