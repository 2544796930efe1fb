"""A whole closed loop, its gradient included, as one CUDA graph."""

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

from softmpm.errors import NEVER
from softmpm.schemes.capture import GraphResources, collected_resources, exclusive_capture

Result = TypeVar("Result")


class Graph(Generic[Result]):
    """A function, which may call :func:`softmpm.simulate`, captured once as a CUDA graph and replayed without any launch from the host.

    On the CPU the function is called each time. After a replay in which a call collected failures (:class:`softmpm.Failures`) they are
    known; after one in which another call failed, the function is called without the graph, which raises the error. The captured graph
    stays. If a particle only left the allocated part of the grid, that part is enlarged, the function is called, and the next call
    captures again.

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

    def __init__(self, work: Callable[[], Result], device: torch.device | str):
        self.work, self.device = work, torch.device(device)
        self._stream = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._resources: GraphResources | None = None
        self._warm = False
        self._any_failed: torch.Tensor | None = None

    def __call__(self) -> Result:
        """The result of the function; once captured, in the same tensors each time.

        Raises:
            UnstableError: As ``simulate`` does.
        """
        if self._stream is None:
            return self.work()
        if not self._warm:
            result = self._run(self._stream)
            # It created what a capture must not: kernels, buffers, an order of the particles.
            self._warm = True
            return result
        if self._graph is None:
            self._warm = False  # should it fail, whatever was missing
            self._graph, self._resources = self._capture(self._stream)
            self._warm = True
        assert self._resources is not None
        self._graph.replay()
        for changed in self._resources.changed:
            changed()
        if self._any_failed is not None and self._any_failed.item():
            if self._resources.widen():
                self._graph = self._resources = None
                del self._result  # its memory is that of the graph
                self._warm = False
                return self()
            if not self._resources.collect():
                return self._run(self._stream)  # where sums in another order did not fail
        return self._result

    def _run(self, stream: torch.cuda.Stream) -> Result:
        """Call the function on the stream of the capture, for which the buffers exist."""
        stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(stream):
            result = self.work()
        torch.cuda.current_stream(self.device).wait_stream(stream)
        return result

    def _capture(self, stream: torch.cuda.Stream) -> tuple[torch.cuda.CUDAGraph, GraphResources]:
        if torch.cuda.is_current_stream_capturing():
            raise RuntimeError(
                "a softmpm.Graph is being captured already: call the inner graph's function instead."
            )
        graph = torch.cuda.CUDAGraph()
        # The stream is entered here as well: PyTorch does not leave it when a capture fails.
        with exclusive_capture(wait=True), torch.cuda.stream(stream), collected_resources() as resources:
            torch.cuda.synchronize(self.device)
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self._result = self.work()
                words = [status.words for status in resources.statuses]
                self._any_failed = (torch.cat(words) != NEVER).any() if words else None
        return graph, resources
