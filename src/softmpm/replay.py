"""A fixed list of launches, recorded as a graph when it first runs and replayed afterwards, on a GPU and on the CPU."""

import threading
from collections.abc import Callable

import torch
import warp as wp

from softmpm.model import Model

_recording = threading.Lock()
"""Warp records one CPU graph at a time."""


def recording(model: Model) -> bool:
    """Whether PyTorch is recording a CUDA graph on the current stream: nothing may wait for the device then."""
    return model.device.type == "cuda" and torch.cuda.is_current_stream_capturing()


class Ledger:
    """Watch words of the calls that a CUDA graph holds, to be read after each replay."""

    def __init__(self):
        self.words: list[torch.Tensor] = []


_open: list[Ledger] = []
"""The ledger of the graph that PyTorch is recording, which is one at a time; its backward pass runs in another thread."""


def open_ledger() -> Ledger:
    _open.append(Ledger())
    return _open[-1]


def close_ledger() -> None:
    _open.pop()


def note(words: torch.Tensor) -> None:
    """Leave the reading of these words, one for each world, to whoever replays the graph that is being recorded."""
    if not _open:
        raise RuntimeError(
            "softmpm cannot tell whether a simulation fails inside a CUDA graph of your own: record it with softmpm.Graph."
        )
    _open[-1].words.append(words)


class Replay:
    """Calls ``launches(stream)`` once to record it.

    While PyTorch itself records a CUDA graph, the launches become part of that one.
    """

    def __init__(self, model: Model, launches: Callable[[wp.Stream | None], None]):
        self.model, self.launches = model, launches
        self._graph: wp.Graph | None = None

    def run(self, stream: wp.Stream | None) -> None:
        if recording(self.model):
            self.launches(stream)
            return
        if self._graph is None:
            self._graph = self._record()
        wp.capture_launch(self._graph, stream=stream)

    def _record(self) -> wp.Graph:
        if self.model.device.type == "cpu":
            with _recording, wp.ScopedCapture(device=self.model.wp_device) as capture:
                self.launches(None)
            return capture.graph
        stream = wp.stream_from_torch(torch.cuda.Stream(self.model.device))
        with wp.ScopedCapture(stream=stream, force_module_load=False) as capture:
            self.launches(stream)
        return capture.graph
