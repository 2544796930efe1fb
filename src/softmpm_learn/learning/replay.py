"""Replay: grid velocity of many past simulations, bounded in memory, kept on disk, split by iteration.

All pictures lie in one tensor on the device of the simulation, a ring of slots with a simulation in each, so a minibatch is one gather.

Iterations are held out for validation with all their worlds, and those beside them are used for neither: the motions of one iteration,
and of two in a row, are too alike to test on. Old motions are no test of what is learned from new ones, so one is held out in each
cycle. Each simulation is one HDF5 file that is written once and never changed, so a checkpoint need only name its simulations, each
with the SHA-256 of its file.
"""

import hashlib
import io
import math
import re
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from softmpm_learn.storage import files

SPLITS = ("training", "validation")
MANY = 509
"""Number of evenly chosen pictures that suffices for validation and for means. A prime: at a whole distance, such as 4, they would
show a gait of 16 pictures in four of its phases only."""
HELD_OUT = 2
"""Place in a cycle of the iteration held out. The one before the next cycle is for training: with a learning phase at the end of each
cycle the autoencoder learns from the newest motion, and validation is two iterations old."""


def cycle(validation: float) -> int:
    """Iterations after which the split repeats: one held out, its neighbours for neither, and at least one for training."""
    return max(4, round(1 / validation))


def split_of(iteration: int, validation: float) -> str | None:
    """Split that the simulations of an iteration belong to, for good; None beside one that is held out.

    Args:
        validation: Share of the iterations held out, at most a quarter.
    """
    away = abs(iteration % cycle(validation) - HELD_OUT)
    return ("validation", None)[away] if away < 2 else "training"


class ReplayError(ValueError):
    """A simulation of the replay buffer is missing, damaged or of another run."""


class Replay:
    """The last so many simulations.

    Args:
        folder: Where the files are.
        shape: That of the pictures of a simulation, (frame, dim, *nodes).
        simulations: Most simulations.
        megabytes: Most memory [MB]; at least the newest simulation stays.
        validation: Share of the iterations held out, see :func:`split_of`.
        worlds: Simulations of an iteration: number n is of iteration n // worlds.
        iterations: Iterations that it has to span, at most a cycle of the split.
        device: Where the pictures are.
    """

    def __init__(
        self,
        folder: Path,
        shape: tuple[int, ...],
        *,
        simulations: int,
        megabytes: float = math.inf,
        validation: float = 0.2,
        worlds: int = 1,
        iterations: int | None = None,
        device: torch.device | str = "cpu",
    ):
        self.folder, self.shape, self.device = folder, shape, device
        self.simulations, self.megabytes = simulations, megabytes
        self.validation, self.worlds = validation, worlds
        self.iterations = min(iterations or cycle(validation), cycle(validation))
        self._slots: dict[int, int] = {}
        self._next = 0
        self._sha256: dict[int, str] = {}
        with files.named("make the folder", folder):
            folder.mkdir(parents=True, exist_ok=True)

    @property
    def capacity(self) -> int:
        """Most simulations, by number and by memory."""
        room = self.megabytes / (4e-6 * math.prod(self.shape))
        return max(1, int(min(self.simulations, room * (1 + 1e-12))))

    @property
    def per_iteration(self) -> int:
        """Most simulations of an iteration, so that the buffer spans ``iterations``: a cycle of the split has both kinds."""
        return max(1, self.capacity // self.iterations)

    @cached_property
    def memory(self) -> Tensor:
        """Velocities [m/s], shape (slot, frame, dim, *nodes) in float32; the same tensor for good, made when it is first used."""
        return torch.empty(self.capacity, *self.shape, device=self.device)

    @property
    def pictures(self) -> Tensor:
        """The pictures of all slots one after another, shape (slot · frame, dim, *nodes), not copied."""
        return self.memory.flatten(0, 1)

    @property
    def ids(self) -> list[int]:
        """Numbers of the simulations held, oldest first."""
        return list(self._slots)

    def add(self, number: int, pictures: Tensor) -> None:
        """Keep the velocities [m/s] of one simulation under a number not used before."""
        if self._slots and number <= self.ids[-1]:
            raise ValueError(f"simulations are numbered upwards: {number} cannot follow {self.ids[-1]}.")
        if tuple(pictures.shape) != self.shape:
            raise ValueError(f"the pictures must have shape {self.shape}, got {tuple(pictures.shape)}.")
        pictures = pictures.detach().float()
        data = _packed(pictures.cpu().contiguous().numpy())
        files.replace(self._path(number), data)
        self._store(number, pictures, hashlib.sha256(data).hexdigest())

    def _store(self, number: int, pictures: Tensor, sha256: str) -> None:
        """Put a simulation into the next slot, which is that of the oldest once all are taken."""
        if len(self._slots) == len(self.memory):
            oldest = self.ids[0]
            del self._slots[oldest], self._sha256[oldest]
        self.memory[self._next].copy_(pictures)
        self._slots[number], self._sha256[number] = self._next, sha256
        self._next = (self._next + 1) % len(self.memory)

    @property
    def seal(self) -> dict[int, str]:
        """For the checkpoint: what :meth:`load` takes, the SHA-256 of each simulation's file by its number."""
        return dict(self._sha256)

    def clear(self) -> None:
        """Forget every simulation; the files stay until :meth:`prune`."""
        self._slots.clear()
        self._sha256.clear()

    def places(self, split: str) -> Tensor:
        """Places in :attr:`pictures` of those of ``training`` or ``validation``, oldest simulation first; on the CPU."""
        if split not in SPLITS:
            raise ValueError(f"split must be training or validation, got {split!r}.")
        slots = [
            slot
            for number, slot in self._slots.items()
            if split_of(number // self.worlds, self.validation) == split
        ]
        frames = self.shape[0]
        return (frames * torch.tensor(slots, dtype=torch.long)[:, None] + torch.arange(frames)).flatten()

    def some(self, split: str) -> Tensor:
        """At most :data:`MANY` evenly chosen pictures of a split, oldest first, shape (picture, dim, *nodes)."""
        places = self.places(split)
        count = min(len(places), MANY)
        chosen = places[torch.arange(count) * len(places) // max(1, count)]
        return self.pictures.index_select(0, chosen.to(self.device))

    def draw(self, generator: torch.Generator, count: int, split: str = "training") -> Tensor:
        """Places in :attr:`pictures` of ``count`` pictures drawn evenly, with repetition; on the CPU."""
        places = self.places(split)
        if not len(places):
            raise ValueError(f"there is no {split} simulation in the replay buffer yet.")
        return places[torch.randint(len(places), (count,), generator=generator)]

    def load(self, seal: dict[int, str]) -> None:
        """Hold exactly the simulations of an earlier :attr:`seal`, from the folder.

        Raises:
            ReplayError: A file is missing, is not the one that was sealed, or does not hold finite pictures of :attr:`shape`; or
                they are more than the buffer may hold.
        """
        if len(seal) > self.capacity:
            size = 4e-6 * math.prod(self.shape)
            raise ReplayError(
                f"the checkpoint names {len(seal)} simulations of {size:.3g} MB each; the replay buffer in {self.folder} may have "
                f"{self.simulations}, and {self.megabytes:g} MB in all."
            )
        self.clear()
        for number, sha256 in sorted(seal.items()):
            self._store(number, self._read(number, sha256), sha256)

    def _read(self, number: int, sha256: str) -> Tensor:
        path = self._path(number)
        most = 2**20 + 8 * math.prod(self.shape)  # more than the pictures take unpacked
        try:
            data = files.read(path, most)
            if hashlib.sha256(data).hexdigest() != sha256:
                raise ValueError(
                    "it is damaged or of another run, its SHA-256 is not the one in the checkpoint"
                )
            pictures = _unpacked(data, self.shape)
        except (OSError, ValueError, RuntimeError, LookupError, TypeError) as error:
            raise ReplayError(
                f"{path} is not the simulation that the checkpoint names: {str(error).rstrip('.')}. The run cannot go on without it; "
                "put the right file there."
            ) from error
        return torch.from_numpy(pictures)

    def prune(self, keep: list[int]) -> None:
        """Remove the files of simulations that are not in ``keep``, and drafts of an interrupted write; no other files."""
        names = {self._path(number).name for number in keep}
        for path in self.folder.iterdir():
            if path.name not in names and re.fullmatch(r"\d{8}\.h5(\.new)?", path.name):
                path.unlink()

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:08d}.h5"


def _packed(pictures: np.ndarray) -> bytes:
    """An HDF5 file, made in memory: HDF5 must not meet a full disk itself. Not compressed: that took 10 ms of an iteration. Without
    checksums of its own, which took as long as the rest: the checkpoint has that of the file."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.create_dataset("velocity", data=pictures)
    return buffer.getvalue()


def _unpacked(data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """A file of ours and nothing else: HDF5 could also name other files, or declare more than there is memory for."""
    with h5py.File(io.BytesIO(data), "r") as file:
        if not isinstance(file.get("velocity", getlink=True), h5py.HardLink):
            raise ValueError("there is no plain dataset 'velocity'")
        found = file["velocity"]
        if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external is not None:
            raise ValueError("its dataset is not plain")
        if found.dtype != np.float32 or found.shape != shape:
            raise ValueError(f"it has {found.dtype} of shape {found.shape}, not float32 of shape {shape}")
        if math.prod(found.chunks or (0,)) > math.prod(shape):
            raise ValueError(f"its chunks of {found.chunks} are larger than its pictures")
        pictures = found[()]
    if not np.isfinite(pictures).all():
        raise ValueError("its velocities are not finite")
    return pictures
