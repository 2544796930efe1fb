"""PyTorch's current GPU and stream, as Warp must see them."""

import functools
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

import torch
import warp as wp

from softmpm.model import Model

P = ParamSpec("P")
T = TypeVar("T")


def on_its_gpu(work: Callable[Concatenate[Model, P], T]) -> Callable[Concatenate[Model, P], T]:
    """Work for a model, whose GPU is PyTorch's current one meanwhile: Warp makes it so and would leave it so."""

    @functools.wraps(work)
    def working(model: Model, *args: P.args, **kwargs: P.kwargs) -> T:
        with torch.cuda.device(model.device.index if model.device.type == "cuda" else -1):
            return work(model, *args, **kwargs)

    return working


def stream_of(device: torch.device) -> wp.Stream | None:
    """PyTorch's current stream as Warp sees it; None on the CPU."""
    if device.type != "cuda":
        return None
    return _known_stream(device, torch.cuda.current_stream(device).cuda_stream)


@functools.lru_cache(maxsize=None)
def _known_stream(device: torch.device, handle: int) -> wp.Stream:
    """Made once for each: Warp registers a stream when it is made, and takes it off when it goes."""
    return wp.Stream(wp.device_from_torch(device), cuda_stream=handle)
