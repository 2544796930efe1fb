"""Digest of the contents of a recording, equal for equal contents however HDF5 stores them.

A resumed run verifies with it that a file is its own: that it contains the same simulations, frames and numbers, to the bit.
"""

import hashlib
import struct
from collections.abc import Mapping
from typing import Protocol

import numpy as np


class Hash(Protocol):
    """Hash object of :mod:`hashlib`."""

    def update(self, data: bytes, /) -> None: ...

    def hexdigest(self) -> str: ...


class Content:
    """SHA-256 of each simulation and of each scalar, fed in the order in which they are recorded."""

    def __init__(self):
        self._episodes: dict[int, Hash] = {}
        self._scalars: dict[bytes, Hash] = {}

    def episode(self, iteration: int, attributes: bytes) -> Hash:
        """Begin a simulation, which replaces an earlier one of this iteration; returns its hash for :meth:`frame`."""
        self._episodes[iteration] = hashlib.sha256(attributes)
        return self._episodes[iteration]

    @staticmethod
    def frame(episode: Hash, time: float, values: Mapping[str, np.ndarray]) -> None:
        """Add one frame to the hash of its simulation."""
        episode.update(struct.pack("<d", time))
        for name in sorted(values):
            episode.update(name.encode() + np.ascontiguousarray(values[name], "<f4").tobytes())

    def scalar(self, iteration: int, name: bytes, value: float) -> None:
        """Add one scalar."""
        self._scalars.setdefault(name, hashlib.sha256()).update(struct.pack("<qd", iteration, value))

    def hexdigest(self) -> str:
        """Digest of all simulations and scalars."""
        whole = hashlib.sha256()
        for key, part in [*sorted(self._episodes.items()), *sorted(self._scalars.items())]:
            whole.update(f"{key!r} {part.hexdigest()}\n".encode())
        return whole.hexdigest()
