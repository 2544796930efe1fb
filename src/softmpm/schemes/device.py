"""PyTorch's current GPU and stream, for Warp."""

import functools
import weakref
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

import torch
import warp as wp

from softmpm.model import Model

P = ParamSpec("P")
T = TypeVar("T")


def on_its_gpu(work: Callable[Concatenate[Model, P], T]) -> Callable[Concatenate[Model, P], T]:
    """Decorator that makes the model's GPU the current one for a function and restores the previous one, which Warp would not."""

    @functools.wraps(work)
    def working(model: Model, *args: P.args, **kwargs: P.kwargs) -> T:
        with torch.cuda.device(model.device.index if model.device.type == "cuda" else -1):
            return work(model, *args, **kwargs)

    return working


def stream_of(device: torch.device) -> wp.Stream | None:
    """PyTorch's current stream as a Warp stream; None on the CPU."""
    if device.type != "cuda":
        return None
    return _known_stream(device, torch.cuda.current_stream(device).cuda_stream)


@functools.lru_cache(maxsize=None)
def _known_stream(device: torch.device, handle: int) -> wp.Stream:
    """The Warp stream of a handle, created once: Warp registers a stream on creation and unregisters it on deletion."""
    return wp.Stream(wp.device_from_torch(device), cuda_stream=handle)


def of_this_stream(kind: Callable[[Model], T], model: Model) -> T:
    """The object of this kind for the current thread and stream, cached in the model's workspace; it refers to the model weakly, to
    avoid a cycle."""
    stream = torch.cuda.current_stream(model.device).cuda_stream if model.device.type == "cuda" else 0
    return model.workspace.get((kind, stream), lambda: kind(weakref.proxy(model)))
