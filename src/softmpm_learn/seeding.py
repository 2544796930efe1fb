"""Random streams: one for each part of a run, so that a change of one part leaves the random numbers of the others as they are."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def stream_seed(seed: int, name: str) -> int:
    """Seed of the stream ``name`` of a run with this seed."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:8], "big") >> 1


def stream(seed: int, name: str) -> torch.Generator:
    """Generator of the stream ``name`` of a run with this seed."""
    return torch.Generator().manual_seed(stream_seed(seed, name))


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Layers made inside start with weights that follow from ``seed`` alone; make them on the CPU, then move them. PyTorch's global
    random state is unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
