"""Seeded initialisation that leaves PyTorch's global random state unchanged."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Layers made inside start with weights that follow from ``seed`` alone; make them on the CPU, then move them."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
