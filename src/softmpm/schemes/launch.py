"""Kernel launches that are made once and then repeated: one on other tensors each time, or a list on fixed ones as a graph."""

import functools
import threading
from collections.abc import Callable, Sequence

import torch
import warp as wp

from softmpm.kernels.compile import launch
from softmpm.model import Model
from softmpm.schemes.capture import alone, recording


class Launcher:
    """Launches kernels on one stream, or collects the launches to be repeated later."""

    def __init__(self, model: Model, stream: wp.Stream | None, collected: list | None = None):
        self.device, self.stream, self.collected = model.wp_device, stream, collected

    def __call__(self, kernel, dim, *inputs, block_dim: int = 256) -> None:
        collect = self.collected is not None
        settings = dict(stream=self.stream, block_dim=block_dim, record_cmd=collect)
        made = launch(kernel, dim, inputs, self.device, **settings)
        if self.collected is not None:
            self.collected.append(made)


class Command:
    """A launch on other tensors each time: only their addresses are put in.

    Args:
        inputs: Of the kernel, some of which are slots, or structs that hold slots.
        slots: These, from :func:`softmpm.buffers.slot`; each is filled in place, so they belong to this command alone.
    """

    def __init__(self, model: Model, kernel, dim, inputs: Sequence, slots: Sequence):
        self._slots = slots
        made = launch(kernel, dim, inputs, device=model.wp_device, record_cmd=True)
        assert made is not None
        self._launch, self._filling = made, threading.Lock()

    def __call__(self, stream: wp.Stream | None, *tensors: torch.Tensor) -> None:
        """Launch it on contiguous tensors of the slots' shapes and precision.

        A backward pass runs in a thread of its own and shares commands with that of the call: one of them at a time.
        """
        assert all(tensor.is_contiguous() for tensor in tensors)
        with self._filling:
            for slot, tensor in zip(self._slots, tensors, strict=True):
                slot.data = tensor.data_ptr()
            self._launch.launch(stream)


class Replay:
    """Runs ``launches(launcher)`` the first time to record it, as a CUDA graph or, on the CPU, as a list of launches.

    It is given the launches each time and does not hold them: whoever makes them holds it.

    While PyTorch itself records a CUDA graph, the launches become part of that one. Warp's CPU graphs would be faster still, but
    take up what other threads launch meanwhile.
    """

    def __init__(self, model: Model):
        self.model = model
        self._graph: wp.Graph | None = None
        self._list: list | None = None

    def run(self, stream: wp.Stream | None, launches: Callable[[Launcher], None]) -> None:
        if stream is None:
            self._run_list(launches)
        elif recording(self.model):
            launches(Launcher(self.model, stream))
        else:
            if self._graph is None:
                self._graph = self._record(launches)
            if self._graph is None:
                launches(Launcher(self.model, stream))
            else:
                wp.capture_launch(self._graph, stream=stream)

    def _run_list(self, launches: Callable[[Launcher], None]) -> None:
        if self._list is None:
            collected = []
            launches(Launcher(self.model, None, collected))
            self._list = collected  # only now: an interruption, while they compile, would leave a part of it
        for command in self._list:
            command.launch()

    def _record(self, launches: Callable[[Launcher], None]) -> wp.Graph | None:
        """The graph, or None while another thread records, which may be waiting for this one."""
        with alone(wait=False) as turn:
            if not turn:
                return None
            stream = _recorder(self.model.device)
            with wp.ScopedCapture(stream=stream, force_module_load=False) as capture:
                launches(Launcher(self.model, stream))
            assert capture.graph is not None
            return capture.graph


@functools.lru_cache(maxsize=None)
def _recorder(device: torch.device) -> wp.Stream:
    """Where programs are recorded, one at a time. Of high priority, since those are few: PyTorch hands its streams out again and
    again, and what another thread launches on one that records would become part of the recording.
    """
    return wp.stream_from_torch(torch.cuda.Stream(device, priority=-1))
