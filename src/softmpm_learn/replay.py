"""Replay: grid velocity of many past simulations, bounded in memory, kept on disk, split by simulation.

Whole simulations are held out for validation: neighbouring pictures of one motion are too alike to test on. Each simulation is
one HDF5 file that is written once and never changed, so a checkpoint need only name its simulations.
"""

import math
import os
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

SPLITS = ("training", "validation")


class Replay:
    """The last so many simulations.

    Args:
        folder: Where the files are.
        simulations: Most simulations.
        megabytes: Most memory [MB]; at least the newest simulation stays.
        validation: Share of the simulations held out: every ⌈1/validation⌉-th, by its number, for good.
    """

    def __init__(
        self, folder: Path, *, simulations: int, megabytes: float = math.inf, validation: float = 0.2
    ):
        self.folder = folder
        self.simulations, self.megabytes = simulations, megabytes
        self.hold_out = round(1 / validation)
        self._pictures: dict[int, Tensor] = {}
        folder.mkdir(parents=True, exist_ok=True)

    @property
    def ids(self) -> list[int]:
        """Numbers of the simulations held, oldest first."""
        return list(self._pictures)

    def add(self, number: int, pictures: Tensor) -> None:
        """Keep the velocities [m/s] of one simulation, shape (frame, dim, *nodes), under a number not used before."""
        if self._pictures and number <= self.ids[-1]:
            raise ValueError(f"simulations are numbered upwards: {number} cannot follow {self.ids[-1]}.")
        pictures = pictures.detach().to("cpu", torch.float32).contiguous()
        _write(self._path(number), pictures.numpy())
        self._pictures[number] = pictures
        while len(self.ids) > 1 and (len(self.ids) > self.simulations or self.nbytes > 1e6 * self.megabytes):
            del self._pictures[self.ids[0]]

    @property
    def nbytes(self) -> int:
        """Memory of the pictures [B]."""
        return sum(p.nbytes for p in self._pictures.values())

    def clear(self) -> None:
        """Forget every simulation; the files stay until :meth:`prune`."""
        self._pictures.clear()

    def split(self, name: str) -> list[Tensor]:
        """Pictures of each simulation of ``training`` or ``validation``, (frame, dim, *nodes) each."""
        if name not in SPLITS:
            raise ValueError(f"split must be training or validation, got {name!r}.")
        last, validation = self.hold_out - 1, name == "validation"
        return [
            pictures
            for number, pictures in self._pictures.items()
            if (number % self.hold_out == last) == validation
        ]

    def sample(self, generator: torch.Generator, batch: int, split: str = "training") -> Tensor:
        """``batch`` pictures drawn evenly, with repetition, shape (batch, dim, *nodes)."""
        simulations = self.split(split)
        if not simulations:
            raise ValueError(f"there is no {split} simulation in the replay buffer yet.")
        ends = torch.tensor([len(pictures) for pictures in simulations]).cumsum(0)
        drawn = torch.randint(int(ends[-1]), (batch,), generator=generator)
        which = torch.bucketize(drawn, ends, right=True)
        return torch.stack(
            [simulations[k][i - ends[k]] for k, i in zip(which.tolist(), drawn.tolist(), strict=True)]
        )

    def load(self, ids: list[int]) -> None:
        """Hold exactly these simulations, from the folder."""
        self._pictures = {number: torch.from_numpy(_read(self._path(number))) for number in ids}

    def prune(self, keep: list[int]) -> None:
        """Remove the files of simulations that are not in ``keep``, and what an interrupted write left behind."""
        names = {self._path(number).name for number in keep}
        for path in self.folder.iterdir():
            if path.name not in names and path.name.endswith((".h5", ".new")):
                path.unlink()

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:08d}.h5"


def _write(path: Path, pictures: np.ndarray) -> None:
    """Whole or not at all, also after a loss of power."""
    draft = path.with_name(path.name + ".new")
    with h5py.File(draft, "w") as file:
        file.create_dataset(
            "velocity", data=pictures, chunks=True, shuffle=True, compression=1, fletcher32=True
        )
    descriptor = os.open(draft, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    os.replace(draft, path)


def _read(path: Path) -> np.ndarray:
    """A file of ours and nothing else: HDF5 could also name other files, or declare more than there is memory for."""
    try:
        with h5py.File(path, "r") as file:
            if not isinstance(file.get("velocity", getlink=True), h5py.HardLink):
                raise ValueError("no plain dataset 'velocity'")
            data = file["velocity"]
            if not isinstance(data, h5py.Dataset) or data.is_virtual or data.external is not None:
                raise ValueError("its dataset is not plain")
            if data.dtype != np.float32 or data.nbytes > 1000 * max(path.stat().st_size, 2**20):
                raise ValueError(f"{data.dtype} of {data.nbytes} bytes is not what this file could hold")
            return data[()]
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} is not a readable simulation of the replay buffer: {error}") from error
