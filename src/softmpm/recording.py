"""Recorder: a run to HDF5 as it happens.

The file can be read at every instant, also after ``kill -9``: everything with a name exists before the first
row is written; the file is then in HDF5's single-writer-multiple-reader mode, in which the library orders its
writes so that the file is always consistent; and a frame counts only once its row of ``frame/index`` has
followed its data. Layout: ``layout.py``.
"""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from softmpm.layout import EPISODE, FRAME, PARTS, PER_FRAME, SCALAR, create, put, static_values, tables
from softmpm.model import Model
from softmpm.playback import Recording
from softmpm.state import GridField, State

_OPEN = {"libver": ("v110", "v110"), "locking": "best-effort"}  # the oldest format that has the mode
_PAGES = {"fs_strategy": "page", "fs_page_size": 4096}  # a kill cannot tear what does not cross a page
_ROOM_EXTRA = 2**20  # for HDF5's own tables


class Recorder:
    """Writes what happens in a run, for people to look at: particles, muscles, grid velocity, losses.

    ::

        with softmpm.Recorder("run.h5", model) as recorder:
            with recorder.episode(iteration=0) as episode:
                episode.frame(0.0, state, activation)
            recorder.scalars(0, {"loss": 0.3})

    A frame of n particles is 20 n bytes in 2D and 28 n in 3D, less what compression saves; a grid velocity
    comes on top.

    Args:
        path: The file to write. It must not exist, unless ``resume_before`` is given.
        model: What is simulated.
        resume_before: Keep the simulations and scalars of iterations before this one of an existing file and
            go on after them; without a file, start one.
        every: Record each ``every``-th frame of a simulation only.
        max_particles: Record this many particles, chosen evenly at random, the same in every run; None: all.

    Raises:
        FileExistsError: The file exists, and ``resume_before`` was not given.
        ValueError: The existing file records another scene.
        OSError: There is no room on the disk; also from the methods. What was recorded before is safe.
    """

    def __init__(
        self,
        path: str | Path,
        model: Model,
        *,
        resume_before: int | None = None,
        every: int = 1,
        max_particles: int | None = None,
    ):
        for name, value in (("every", every), ("max_particles", max_particles)):
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        self.path, self.every = Path(path), every
        if resume_before is None and self.path.exists():
            raise FileExistsError(
                f"{self.path} exists; choose another path, or go on with resume_before=<iteration>."
            )
        static = static_values(model, max_particles)
        self._particles = torch.from_numpy(static["particle"])
        self._shape = (model.particle_count, model.scene.grid.dim)
        draft = self.path.with_name(f"{self.path.name}.new")
        try:
            _begin(draft, model, static, self.path, resume_before)
            _put_in_place(draft, self.path)
        finally:
            draft.unlink(missing_ok=True)
        self._file = _open_to_append(self.path)
        self._tables = tables(self._file)
        self._count = {name: len(table) for name, table in self._tables.items()}

    def episode(self, iteration: int, **attributes) -> "Episode":
        """Begin a simulation, shown under this iteration; ``attributes`` are JSON values to keep with it."""
        text = json.dumps(attributes).encode()
        if len(text) > EPISODE["attributes"].itemsize:
            raise ValueError(f"the attributes of an episode must fit in 4096 bytes of JSON, got {len(text)}.")
        self._write("episode", np.array([(_checked(iteration), text)], EPISODE))
        return Episode(self, self._count["episode"] - 1)

    def scalars(self, iteration: int, values: dict[str, float]) -> None:
        """Numbers of one iteration, such as its loss."""
        rows = [(_checked(iteration), name.encode(), float(value)) for name, value in values.items()]
        for _, name, _ in rows:
            if not 0 < len(name) <= SCALAR["name"].itemsize:
                raise ValueError(f"the name of a scalar must have 1 to 64 bytes, got {name.decode()!r}.")
        self._write("scalar", np.array(rows, SCALAR))

    def _frame(
        self, episode: int, time: float, values: dict[str, np.ndarray], parts: dict[str, np.ndarray]
    ) -> None:
        """One row in each table of a frame; it counts once the last, ``frame/index``, is written."""
        rows = {f"frame/{name}": ("frame/index", one) for name, one in values.items()}
        rows |= {PARTS[name]: (PARTS[name], one) for name, one in parts.items()}
        with _room(self._file, sum(one.nbytes for _, one in rows.values())):
            for table, (counted, one) in rows.items():
                put(self._tables[table], self._count[counted], one[None])
        field, latent = (self._count[PARTS[name]] if name in parts else -1 for name in PARTS)
        self._write("frame/index", np.array([(episode, time, field, latent)], FRAME))
        for name in parts:
            self._count[PARTS[name]] += 1

    def _write(self, name: str, rows: np.ndarray) -> None:
        self._need_open()
        with _room(self._file, rows.nbytes):
            put(self._tables[name], self._count[name], rows)
        self._count[name] += len(rows)

    def _need_open(self) -> None:
        if not self._file:
            raise ValueError(f"{self.path}: this recorder is closed.")

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_) -> None:
        self.close()


class Episode:
    """One simulation of a recording; from :meth:`Recorder.episode`."""

    def __init__(self, recorder: Recorder, row: int):
        self._recorder, self._row, self._calls = recorder, row, 0

    def frame(
        self,
        time: float,
        state: State,
        activation: Tensor | None = None,
        field: GridField | Tensor | None = None,
        latent: Tensor | None = None,
        *,
        world: int = 0,
    ) -> None:
        """Record one instant of one world. Nothing is differentiated or modified.

        Args:
            time: Time since the start of this simulation [s].
            state: State of all worlds.
            activation: Muscle activation [-], shape (world, muscle) or (muscle,).
            field: Grid velocity [m/s], shape (world, *nodes, dim) or (*nodes, dim), or what ``rasterize``
                returns.
            latent: What an observer saw, shape (world, size) or (size,).
            world: The world to record.
        """
        recorder, self._calls = self._recorder, self._calls + 1
        recorder._need_open()
        if (self._calls - 1) % recorder.every:
            return
        if tuple(state.x.shape[1:]) != recorder._shape:
            raise ValueError(
                f"state.x must have shape (world, *{recorder._shape}), got {tuple(state.x.shape)}."
            )
        particles = recorder._particles.to(state.x.device)
        x, v, F = (tensor.detach()[world][particles] for tensor in (state.x, state.v, state.F))
        values = {"x": _numpy(x), "v": _numpy(v), "strain": _numpy(strain(F))}
        row = {name: table.shape[1:] for name, table in recorder._tables.items()}
        values["activation"] = np.full(row["frame/activation"], np.nan, np.float32)
        if activation is not None:
            values["activation"] = _one_world("activation", activation, world, row["frame/activation"])
        parts = {}
        if field is not None:
            velocity = field.velocity if isinstance(field, GridField) else field
            parts["field"] = _one_world("field", velocity, world, row["field/velocity"])
        if latent is not None:  # the first one decides the size
            size = row["latent/value"] if row["latent/value"] != (0,) else tuple(latent.shape[-1:])
            parts["latent"] = _one_world("latent", latent, world, size)
        recorder._frame(self._row, float(time), values, parts)

    def __enter__(self) -> "Episode":
        return self

    def __exit__(self, *_) -> None:
        pass


def strain(F: Tensor) -> Tensor:
    """Size of the Green strain, ‖(FᵀF − I)/2‖ [-], zero for every rigid motion; F is (..., dim, dim)."""
    eye = torch.eye(F.shape[-1], dtype=F.dtype, device=F.device)
    return torch.linalg.matrix_norm(F.mT @ F - eye) / 2


def _checked(iteration: int) -> int:
    if not (iteration == int(iteration) and iteration >= 0):
        raise ValueError(f"iteration must be a whole number from 0 on, got {iteration}.")
    return int(iteration)


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", torch.float32).numpy()


def _one_world(name: str, tensor: Tensor, world: int, shape: tuple[int, ...]) -> np.ndarray:
    one = tensor[world] if tensor.ndim == len(shape) + 1 else tensor
    if tuple(one.shape) != shape:
        raise ValueError(
            f"{name} must have shape {shape}, or that after a first axis world, got {tuple(tensor.shape)}; a frame is one instant, "
            "so of many control steps it takes one."
        )
    return _numpy(one)


def _begin(
    draft: Path, model: Model, static: dict[str, np.ndarray], path: Path, resume_before: int | None
) -> None:
    """Write a recording with what is kept of the one at ``path``."""
    kept = path.stat().st_size if path.exists() else 0
    size = sum(values.nbytes for values in static.values()) + kept
    with h5py.File(draft, "w", **_OPEN, **_PAGES) as file, _room(file, size):
        create(file, model, static)
        if kept and resume_before is not None:
            with Recording(path) as old:
                _copy(old, file, static, resume_before)


def _copy(old: Recording, file: h5py.File, static: dict[str, np.ndarray], before: int) -> None:
    """Everything of iterations before ``before``."""
    for name, values in static.items():
        if not np.array_equal(values, old.static[name]):
            raise ValueError(f"{old.path} records another scene ({name} differs); record to another path.")

    new = tables(file)

    def extend(name: str, rows: np.ndarray) -> None:
        put(new[name], len(new[name]), rows)

    for iteration in (i for i in old.episodes if i < before):
        extend("episode", np.array([(iteration, json.dumps(old.attributes(iteration)).encode())], EPISODE))
        for row in old.rows(iteration):
            for name in PER_FRAME:
                extend(f"frame/{name}", old.read(name, [row])[1])
            parts = {name: old.read(name, [row])[1] for name in PARTS}
            at = {name: len(new[PARTS[name]]) if len(values) else -1 for name, values in parts.items()}
            for name, values in parts.items():
                if len(values):
                    extend(PARTS[name], values)
            time = old.read("time", [row])[1][0]
            extend(
                "frame/index", np.array([(len(new["episode"]) - 1, time, at["field"], at["latent"])], FRAME)
            )
    for name, (iterations, values) in old.scalars.items():
        kept = [(i, name.encode(), v) for i, v in zip(iterations, values, strict=True) if i < before]
        extend("scalar", np.array(kept, SCALAR))


@contextlib.contextmanager
def _room(file: h5py.File, size: int) -> Iterator[None]:
    """Claim room for ``size`` bytes on the disk, write, and give back the rest.

    HDF5 must not meet a full disk itself: after a write that failed it crashes the process.
    """
    handle, end = file.id.get_vfd_handle(), file.id.get_filesize()
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(handle, end, size + _ROOM_EXTRA)
    except OSError as error:
        os.ftruncate(handle, end)
        text = f"no room to record ({error.strerror}); what was recorded is safe"
        raise OSError(error.errno, text, file.filename) from error
    yield
    file.flush()
    os.ftruncate(handle, file.id.get_filesize())


def _open_to_append(path: Path) -> h5py.File:
    """Open straight into reader-safe mode; a kill between "r+" and ``swmr_mode`` locks a file."""
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_V110, h5py.h5f.LIBVER_V110)
    access.set_file_locking(True, True)
    flags = h5py.h5f.ACC_RDWR | h5py.h5f.ACC_SWMR_WRITE
    return h5py.File(h5py.h5f.open(os.fsencode(path), flags, fapl=access))


def _put_in_place(draft: Path, path: Path) -> None:
    """At every instant there is the old file or the finished new one."""
    with open(draft, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(draft, path)
