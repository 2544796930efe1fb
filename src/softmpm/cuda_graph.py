"""A whole closed loop, its gradient included, as one CUDA graph."""

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

from softmpm.errors import NEVER
from softmpm.schemes.capture import Ledger, alone, opened_ledger

Result = TypeVar("Result")


class Graph(Generic[Result]):
    """Work that calls :func:`softmpm.simulate`, recorded once and replayed: no launch costs the host anything any more.

    On the CPU, where simulations are replayed anyway, it calls the work each time. A replay that fails is done again by
    calling the work, which raises what there is to raise. If a particle only left the part of the grid that is in memory, a
    larger part is taken before. Once a call has come through, the next one records again.

    Args:
        work: Takes nothing and gives tensors. It must do the same on the same tensors each time, without asking the device
            for a number: what changes between calls is written into tensors that it reads. Gradients are taken inside it.
        device: Where it runs.

    Example:
        >>> def work():
        ...     loss = closed_loop(policy)
        ...     return loss.detach(), grad(loss, list(policy.parameters()))
        >>> graph = softmpm.Graph(work, model.device)
        >>> loss, gradients = graph()  # overwritten by the next call
    """

    def __init__(self, work: Callable[[], Result], device: torch.device):
        self.work, self.device = work, device
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._ledger: Ledger | None = None
        self._warm = False

    def __call__(self) -> Result:
        """What the work gives; once recorded, in the same tensors each time.

        Raises:
            UnstableError: As ``simulate`` does.
        """
        if self._stream is None:
            return self.work()
        if not self._warm:
            result = self._run(self._stream)
            # It made what a recording must not: kernels, buffers, an order of the particles.
            self._warm = True
            return result
        if self._graph is None:
            self._warm = False  # should it fail, whatever was missing
            self._graph = self._record(self._stream)
            self._warm = True
        self._graph.replay()
        if self._failed.item():
            assert self._ledger is not None
            self._ledger.widen()
            self._graph = self._ledger = None
            self._warm = False
            return self()
        return self._result

    def _run(self, stream: torch.cuda.Stream) -> Result:
        """The work itself, on the stream of the recording, which knows the buffers."""
        stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(stream):
            result = self.work()
        torch.cuda.current_stream(self.device).wait_stream(stream)
        return result

    def _record(self, stream: torch.cuda.Stream) -> torch.cuda.CUDAGraph:
        if torch.cuda.is_current_stream_capturing():
            raise RuntimeError("a softmpm.Graph is being recorded already: call the inner one's work itself.")
        graph = torch.cuda.CUDAGraph()
        # The stream is entered here as well: where a recording fails, PyTorch does not leave it.
        with alone(wait=True), torch.cuda.stream(stream), opened_ledger() as ledger:
            torch.cuda.synchronize(self.device)
            with torch.cuda.graph(graph, stream=stream):
                self._result = self.work()
                self._failed = (torch.cat([words for words, _ in ledger.words]) != NEVER).any()
        self._ledger = ledger
        return graph
