"""Random streams: one for each part of a run, so that a change of one part leaves the random numbers of the others as they are."""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_LOCK = threading.RLock()


def stream_seed(seed: int, name: str) -> int:
    """Seed of the stream ``name`` of a run with this seed."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name}".encode()).digest()[:8], "big") >> 1


def stream(seed: int, name: str) -> torch.Generator:
    """Generator of the stream ``name`` of a run with this seed."""
    return torch.Generator().manual_seed(stream_seed(seed, name))


@contextmanager
def seeded(seed: int, device: torch.device | None = None) -> Iterator[None]:
    """Random numbers drawn inside follow from ``seed`` alone, on the CPU and, if it is given, on a GPU. Layers are made on the CPU, not
    on a default device of the caller's; move them afterwards. PyTorch's global random state is unchanged; it is that of all threads,
    so that only one of them is inside."""
    devices = [device] if device is not None and device.type == "cuda" else []
    with _LOCK, torch.device("cpu"), torch.random.fork_rng(devices=devices):
        torch.manual_seed(seed)
        yield
