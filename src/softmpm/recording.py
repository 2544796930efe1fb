"""Recorder: a run to HDF5 as it happens.

The file can be read at every instant, also after ``kill -9``: all tables exist before the first row is written, the file is
then in HDF5's single-writer-multiple-reader mode, where the library orders its writes so that what is on disk is always
consistent, and each frame counts only once its row in ``frame/index`` follows its data. Layout: ``playback.py``.
"""

import json
import os
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from softmpm.model import Model
from softmpm.playback import EPISODE, FORMAT, FRAME, PER_FRAME, SCALAR, STATIC, TABLES, VERSION, Recording
from softmpm.state import GridField, State

_OPEN = {"libver": ("v110", "v110"), "locking": "best-effort"}  # the oldest format that has the reader-safe mode
_PAGES = {"fs_strategy": "page", "fs_page_size": 4096}  # no small piece crosses a page, so a kill cannot tear one
_LATENT_CHUNK, _LATENT_MOST = 64, 65536


class Recorder:
    """Writes what happens in a run, for people: particles, muscles, grid velocity, latent values, losses.

    ::

        with softmpm.Recorder("run.h5", model) as recorder:
            with recorder.episode(iteration=0) as episode:
                episode.frame(0.0, state, activation)
            recorder.scalars(0, {"loss": 0.3})

    One frame of n particles takes about 5·n numbers of 4 bytes in 2D, 7·n in 3D, less what compression saves.

    Args:
        path: The file to write. It must not exist, unless ``resume_before`` is given.
        model: What is simulated.
        resume_before: Keep the simulations and scalars of iterations before this one of an existing file and go on after
            them; without a file, start one.
        every: Record each ``every``-th frame of a simulation only.
        max_particles: Record this many particles, chosen evenly at random, the same in every run; None for all.
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
        if every < 1:
            raise ValueError(f"every must be at least 1, got {every}.")
        if max_particles is not None and max_particles < 1:
            raise ValueError(f"max_particles must be at least 1, got {max_particles}.")
        self.path, self.every = Path(path), every
        if resume_before is None and self.path.exists():
            raise FileExistsError(f"{self.path} exists; choose another path, or resume it with resume_before=<iteration>.")
        self._scene_shape = (model.particle_count, model.dim)
        static = _static(model, max_particles)
        self._particle = torch.from_numpy(static["particle"])
        draft = self.path.with_name(self.path.name + ".new")
        with h5py.File(draft, "w", **_OPEN, **_PAGES) as file:
            _create(file, model, static)
            if resume_before is not None and self.path.exists():
                with Recording(self.path) as old:
                    _copy(old, file, static, resume_before)
        _replace(draft, self.path)
        self._file = h5py.File(self.path, "r+", **_OPEN)
        self._file.swmr_mode = True
        self._tables = {name: self._file[name] for name in TABLES}
        self._count = {name: len(table) for name, table in self._tables.items()}

    def episode(self, iteration: int, **attributes) -> "Episode":
        """Begin a simulation, to be shown under this iteration; ``attributes`` are any JSON values to keep with it."""
        text = json.dumps(attributes).encode()
        if iteration < 0:
            raise ValueError(f"iteration must not be negative, got {iteration}.")
        if len(text) > EPISODE["attributes"].itemsize:
            raise ValueError(f"the attributes of an episode must fit in 4096 bytes of JSON, got {len(text)}.")
        self._append("episode", np.array([(iteration, text)], EPISODE))
        self._file.flush()
        return Episode(self, self._count["episode"] - 1)

    def scalars(self, iteration: int, values: dict[str, float]) -> None:
        """Numbers of one iteration, such as its loss."""
        if iteration < 0:
            raise ValueError(f"iteration must not be negative, got {iteration}.")
        rows = [(iteration, name.encode(), float(value)) for name, value in values.items()]
        for _, name, _ in rows:
            if not 0 < len(name) <= SCALAR["name"].itemsize:
                raise ValueError(f"the name of a scalar must have 1 to 64 bytes, got {name.decode()!r}.")
        if rows:
            self._append("scalar", np.array(rows, SCALAR))
            self._file.flush()

    def _append(self, name: str, rows: np.ndarray) -> None:
        """Write rows after the last one of a table; a failed attempt is overwritten by the next."""
        if not self._file:
            raise ValueError(f"{self.path}: this recorder is closed.")
        table, start = self._tables[name], self._count[name]
        if table.shape != (start + len(rows), *rows.shape[1:]):
            table.resize((start + len(rows), *rows.shape[1:]))
        table[start:] = rows
        self._count[name] = start + len(rows)

    def _append_frame(self, episode: int, time: float, frame: dict[str, np.ndarray], parts: dict[str, np.ndarray]) -> None:
        number = self._count["frame/index"]
        before = dict(self._count)
        try:
            for name, values in frame.items():
                self._append(f"frame/{name}", values[None])
            for name, values in parts.items():
                self._append(name, values[None])
                self._append(f"{name.split('/')[0]}/index", np.array([number]))
            self._file.flush()  # the data is on its way before the row that declares it complete
            self._append("frame/index", np.array([(episode, time)], FRAME))
            self._file.flush()
        except BaseException:
            self._count = before
            raise

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
        """Record one instant of one world.

        Args:
            time: Time since the start of this simulation [s].
            state: State of all worlds.
            activation: Muscle activation [-], shape (world, muscle) or (muscle,).
            field: Grid velocity [m/s], shape (world, *nodes, dim) or (*nodes, dim), or what ``rasterize`` returns.
            latent: What an observer saw, shape (world, size) or (size,).
            world: The world to record.
        """
        recorder, self._calls = self._recorder, self._calls + 1
        if (self._calls - 1) % recorder.every:
            return
        if tuple(state.x.shape[1:]) != recorder._scene_shape:
            raise ValueError(f"state.x must have shape (world, *{recorder._scene_shape}), got {tuple(state.x.shape)}.")
        index = recorder._particle.to(state.x.device)
        x, v, F = (t.detach()[world][index] for t in (state.x, state.v, state.F))
        muscles = recorder._tables["frame/activation"].shape[1:]
        values = {"x": _numpy(x), "v": _numpy(v), "strain": _numpy(strain(F))}
        values["activation"] = np.full(muscles, np.nan, np.float32)
        if activation is not None:
            values["activation"] = _one_world("activation", activation, world, muscles)
        parts = {}
        if field is not None:
            velocity = field.velocity if isinstance(field, GridField) else field
            parts["field/velocity"] = _one_world("field", velocity, world, recorder._tables["field/velocity"].shape[1:])
        if latent is not None:
            size = recorder._tables["latent/value"].shape[1:]
            parts["latent/value"] = _one_world("latent", latent, world, size if size != (0,) else latent.shape[-1:])
        recorder._append_frame(self._row, float(time), values, parts)

    def __enter__(self) -> "Episode":
        return self

    def __exit__(self, *_) -> None:
        pass


def strain(F: Tensor) -> Tensor:
    """Size of the Green strain, ‖(FᵀF − I)/2‖ [-]: zero for every rigid motion. F (..., dim, dim) gives (...)."""
    eye = torch.eye(F.shape[-1], dtype=F.dtype, device=F.device)
    return torch.linalg.matrix_norm(F.mT @ F - eye) / 2


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", torch.float32).numpy()


def _one_world(name: str, tensor: Tensor, world: int, shape: tuple[int, ...]) -> np.ndarray:
    one = tensor[world] if tensor.ndim == len(shape) + 1 else tensor
    if tuple(one.shape) != tuple(shape):
        raise ValueError(f"{name} must have shape (world, *{tuple(shape)}) or {tuple(shape)}, got {tuple(tensor.shape)}.")
    return _numpy(one)


def _static(model: Model, max_particles: int | None) -> dict[str, np.ndarray]:
    """What does not change, for the particles that are recorded."""
    scene, n = model.scene, model.particle_count
    particle = np.arange(n)
    if max_particles is not None and max_particles < n:
        particle = np.sort(np.random.default_rng(0).choice(n, max_particles, replace=False))
    muscle = np.zeros((len(scene.muscles), n))
    for row, one in zip(muscle, scene.muscles, strict=True):
        row[one.particles] = 1
    body = np.repeat(np.arange(len(scene.bodies)), [len(b.particles) for b in scene.bodies])
    volume = np.concatenate([b.particles.volume for b in scene.bodies])
    values = {
        "positions": np.concatenate([b.particles.positions for b in scene.bodies])[particle],
        "volume": volume[particle],
        "body": body[particle],
        "particle": particle,
        "gravity": scene.gravity,
        "muscle": muscle[:, particle],
        "muscle_direction": np.array([m.direction for m in scene.muscles]).reshape(-1, model.dim),
        "muscle_strength": [m.strength for m in scene.muscles],
        "wall_normal": np.array([w.normal for w in scene.walls]).reshape(-1, model.dim),
        "wall_offset": [w.offset for w in scene.walls],
        "wall_friction": [w.friction for w in scene.walls],
        "wall_contact": [w.contact for w in scene.walls],
        "grid_shape": scene.grid.shape,
    }
    return {name: np.asarray(values[name]).astype(dtype) for name, (dtype, _) in STATIC.items()}


def _create(file: h5py.File, model: Model, static: dict[str, np.ndarray]) -> None:
    """Everything that the file will ever have a name for; later only rows are added."""
    grid = model.scene.grid
    file.attrs["format"], file.attrs["version"] = np.bytes_(FORMAT), VERSION
    file.attrs["dim"], file.attrs["dt"], file.attrs["spacing"] = model.dim, model.scene.dt, grid.spacing
    for name, values in static.items():
        checked = {"fletcher32": True, "chunks": values.shape} if values.size else {}
        file.create_dataset(f"static/{name}", data=values, **checked)
    size = {"p": (len(static["particle"]),), "d": (model.dim,), "m": (model.muscle_count,), "n": tuple(grid.shape)}
    for name, (dtype, axes) in TABLES.items():
        row = sum((size[axis] for axis in axes[1:] if axis != "l"), ())
        most, chunk = (None, *row), (1, *(max(n, 1) for n in row))
        if axes.endswith("l"):
            row, most, chunk = (0,), (None, _LATENT_MOST), (1, _LATENT_CHUNK)
        fill = np.full((), -1, dtype) if dtype.kind == "i" else np.zeros((), dtype)
        if dtype.names:
            fill[dtype.names[0]] = -1
        big = dtype.itemsize > 100 or len(axes) > 1
        squeeze = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if big else {}
        file.create_dataset(
            name, (0, *row), dtype, maxshape=most, chunks=chunk, fillvalue=fill, fletcher32=True, **squeeze
        )


def _copy(old: Recording, file: h5py.File, static: dict[str, np.ndarray], before: int) -> None:
    """Everything of iterations before ``before``; the table's rows of all others are left out."""
    for name, values in static.items():
        if not np.array_equal(values, old.static[name]):
            raise ValueError(f"{old.path} records another scene ({name} differs); record to another path.")
    kept, frames = 0, 0
    for iteration in old.episodes:
        if iteration >= before:
            continue
        row = np.array([(iteration, json.dumps(old.attributes(iteration)).encode())], EPISODE)
        _extend(file["episode"], row)
        rows = old.rows(iteration)
        for number, source in enumerate(rows, start=frames):
            for name in PER_FRAME:
                _extend(file[f"frame/{name}"], old.read(name, [source])[1])
            for name, table in (("field", "field/velocity"), ("latent", "latent/value")):
                values = old.read(name, [source])[1]
                if len(values):
                    _extend(file[table], values)
                    _extend(file[f"{name}/index"], np.array([number]))
            _extend(file["frame/index"], np.array([(kept, old.read("time", [source])[1][0])], FRAME))
        kept, frames = kept + 1, frames + len(rows)
    for name, (iterations, values) in old.scalars.items():
        keep = iterations < before
        rows = [(i, name.encode(), v) for i, v in zip(iterations[keep], values[keep], strict=True)]
        _extend(file["scalar"], np.array(rows, SCALAR))


def _extend(table: h5py.Dataset, rows: np.ndarray) -> None:
    start = len(table)
    table.resize((start + len(rows), *rows.shape[1:]))
    table[start:] = rows


def _replace(draft: Path, path: Path) -> None:
    """Put a finished file in the place of another one, so that at every instant there is one or the other."""
    with open(draft, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(draft, path)
