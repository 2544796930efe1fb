"""Capture of CUDA graphs: the process-wide lock, and the objects that a captured graph refers to."""

import contextlib
import gc
import threading
from collections.abc import Callable, Iterator

import torch

from softmpm.model import Model
from softmpm.schemes.failure_report import outgrown


def recording(model: Model) -> bool:
    """Whether PyTorch is recording a CUDA graph on the current stream: nothing may wait for the device then."""
    return model.device.type == "cuda" and torch.cuda.is_current_stream_capturing()


_recording = threading.Lock()


@contextlib.contextmanager
def alone(wait: bool) -> Iterator[bool]:
    """One recording at a time, and no garbage collected meanwhile: to destroy a graph that waits for the collector would end it.

    Yields:
        Whether it is this one's turn; always, for who waits.
    """
    if not _recording.acquire(blocking=wait):
        yield False
        return
    collects = gc.isenabled()
    gc.disable()
    try:
        yield True
    finally:
        if collects:
            gc.enable()
        _recording.release()


class Ledger:
    """What belongs to a CUDA graph: it must live as long.

    Attributes:
        words: Watch words of the calls that the graph holds, to be read after each replay, and what to call if they say that a
            particle left the window; None where there is no window.
        uses: What the graph reads and writes though it was made before. What is made while it is recorded lies in its own memory.
    """

    def __init__(self):
        self.words: list[tuple[torch.Tensor, Callable[[], None] | None]] = []
        self.uses: list[object] = []

    def widen(self) -> None:
        """After a replay that failed: see to it that the next recording has larger windows where a particle left one."""
        for words, outgrow in self.words:
            if outgrow and outgrown(words.tolist()):
                outgrow()


_open: list[Ledger] = []
"""The ledger of the graph that PyTorch is recording, which is one at a time; its backward pass runs in another thread."""


@contextlib.contextmanager
def opened_ledger() -> Iterator[Ledger]:
    _open.append(Ledger())
    try:
        yield _open[-1]
    finally:
        _open.pop()


def note(words: torch.Tensor, outgrow: Callable[[], None] | None = None) -> None:
    """Leave the reading of these words, one for each world, to whoever replays the graph being recorded; see :class:`Ledger`."""
    _ledger().words.append((words, outgrow))


def hold(used: object) -> None:
    """Let what was made before live as long as the graph that is being recorded."""
    _ledger().uses.append(used)


def _ledger() -> Ledger:
    if not _open:
        raise RuntimeError(
            "softmpm cannot tell whether a simulation fails inside a CUDA graph of your own: record it with softmpm.Graph."
        )
    return _open[-1]
