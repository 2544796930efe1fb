"""Modes of PyTorch that a caller may have switched on, and that the learner must not inherit."""

import contextlib
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def plain_torch() -> Iterator[None]:
    """PyTorch inside as it is by default, with gradients."""
    with torch.inference_mode(False), torch.enable_grad(), plain_operations():
        yield


@contextmanager
def plain_operations() -> Iterator[None]:
    """Operations inside are in the precision of their inputs, without autocast, which keeps copies of weights in half precision where
    a step of an optimiser does not reach them; and what is made without a device is on the CPU."""
    elsewhere = torch.get_default_device().type != "cpu"
    with contextlib.ExitStack() as held:
        if elsewhere:  # a default device slows every operation down
            held.enter_context(torch.device("cpu"))
        for kind in ("cpu", "cuda"):
            held.enter_context(torch.autocast(kind, enabled=False))
        yield
