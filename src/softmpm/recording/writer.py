"""Recorder: a run to HDF5 as it happens.

The file can be read at every instant, also after ``kill -9``: everything with a name exists before the first row is written; the file
is then in HDF5's single-writer-multiple-reader mode, in which the library orders its writes so that the file is always consistent; and
a frame counts only once its row of ``frame/index`` has followed its data. Layout: ``format.py``.
"""

import contextlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from softmpm.checks import check_whole
from softmpm.inputs import Inputs
from softmpm.model import Model
from softmpm.recording.digest import Content, Hash
from softmpm.recording.file import begin, need_name, open_to_append, put_in_place, room
from softmpm.recording.format import EPISODE, FRAME, PARTS, PER_FRAME, SCALAR, put, static_values, tables
from softmpm.recording.format_checks import check_values
from softmpm.recording.frame_values import as_numpy, of_one_world, strain
from softmpm.state import ContactForces, GridField, State
from softmpm.wall_poses import given_poses

PER_FRAME_TABLES = {f"frame/{name}" for name in PER_FRAME}
"""Tables of which a frame has the row of its own number."""
FURTHER_FRAME = 2**16
"""Bytes that HDF5 may need for itself with each further frame that is written together with others: a page for each row of a table."""


class Recorder:
    """Writes what happens in a run, for people to look at: particles, muscles, grid velocity, losses.

    ::

        with softmpm.Recorder("run.h5", model) as recorder:
            with recorder.episode(iteration=0) as episode:
                episode.frame(0.0, state, activation)
            recorder.scalars(0, {"loss": 0.3})

    A frame of n particles is 20 n bytes in 2D and 28 n in 3D, less what compression saves; a grid velocity comes on top, and forces of
    w walls on s surface points with 8 (w + 1) s bytes in 2D and 12 (w + 1) s in 3D, and a few bytes for each wall that moves.

    Args:
        path: The file to write. It must not exist, unless ``resume_before`` is given.
        model: What is simulated.
        resume_before: Keep the simulations and scalars of iterations before this one of an existing file and go on after them;
            without a file, start one.
        resume_digest: What :attr:`digest` was when these iterations had been recorded; None does not ask.
        every: Record each ``every``-th frame of a simulation only.
        max_particles: Record this many particles, chosen evenly at random, the same in every run; None: all.
        max_points: Record the tractions at this many surface points, likewise; 0 for the forces of the walls only.

    Raises:
        FileExistsError: The file exists, and ``resume_before`` was not given.
        ValueError: The existing file records another scene, or has another digest; ``resume_before`` is no iteration.
        OSError: There is no room on the disk; also from the methods. What was recorded before is safe. From the methods also if
            the file was deleted, or replaced by that of another recorder.
    """

    def __init__(
        self,
        path: str | Path,
        model: Model,
        *,
        resume_before: int | None = None,
        resume_digest: str | None = None,
        every: int = 1,
        max_particles: int | None = None,
        max_points: int | None = None,
    ):
        check_whole("every", every)
        for name, most, least in (("max_particles", max_particles, 1), ("max_points", max_points, 0)):
            if most is not None:
                check_whole(name, most, least)
        if resume_before is not None:
            check_whole("resume_before", resume_before, 0)
        self.path, self.every, self._model = Path(path), every, model
        if resume_before is None and self.path.exists():
            raise FileExistsError(
                f"{self.path} exists; choose another path, or go on with resume_before=<iteration>."
            )
        static = static_values(model, max_particles, max_points)
        check_values(self.path, static)  # as readers do
        self._particles = torch.from_numpy(static["particle"])
        self._points = torch.from_numpy(static["surface_point"])
        self._shape = (model.particle_count, model.scene.grid.dim)
        self._point_count = None if model.surface is None else model.surface.count
        self._content = Content()
        draft = self.path.with_name(f"{self.path.name}.new")
        draft.unlink(missing_ok=True)  # of a killed process, or a link
        try:
            begin(draft, model, static, self.path, resume_before, self._content)
            if resume_digest is not None and self.digest != resume_digest:
                raise ValueError(
                    f"{self.path} does not hold what was recorded before iteration {resume_before}: it was changed, or is of another "
                    "run."
                )
            put_in_place(draft, self.path)
        finally:
            draft.unlink(missing_ok=True)
        self._file = open_to_append(self.path)
        self._tables = tables(self._file)
        self._count = {
            name: len(table) for name, table in self._tables.items() if name not in PER_FRAME_TABLES
        }
        self._waiting: list[_Waiting] | None = None

    @property
    def digest(self) -> str:
        """SHA-256 of all simulations and scalars recorded so far, for ``resume_digest``."""
        return self._content.hexdigest()

    def episode(self, iteration: int, **attributes) -> "Episode":
        """Begin a simulation, shown under this iteration; ``attributes`` are JSON values to keep with it."""
        text = json.dumps(attributes).encode()
        if len(text) > EPISODE["attributes"].itemsize:
            raise ValueError(f"the attributes of an episode must fit in 4096 bytes of JSON, got {len(text)}.")
        self._write("episode", np.array([(_checked(iteration), text)], EPISODE))
        return Episode(self, self._count["episode"] - 1, self._content.episode(int(iteration), text))

    def scalars(self, iteration: int, values: dict[str, float]) -> None:
        """Numbers of one iteration, such as its loss."""
        rows = [(_checked(iteration), name.encode(), float(value)) for name, value in values.items()]
        for _, name, _ in rows:
            if not 0 < len(name) <= SCALAR["name"].itemsize:
                raise ValueError(f"the name of a scalar must have 1 to 64 bytes, got {name.decode()!r}.")
        self._write("scalar", np.array(rows, SCALAR))
        for row in rows:
            self._content.scalar(*row)

    @contextlib.contextmanager
    def together(self) -> Iterator[None]:
        """Write the frames that are recorded inside at the end of the block, all of them or none: the file is flushed twice in all,
        instead of twice for each frame."""
        if self._waiting is not None:
            raise ValueError("frames are being recorded together already.")
        self._waiting = []
        try:
            yield
            if self._waiting:
                self._write_together(self._waiting)
        finally:
            self._waiting = None

    def _write_together(self, frames: "list[_Waiting]") -> None:
        """One row in each table for each frame; they count once the last rows, those of ``frame/index``, are written."""
        self._need_open()
        rows, index, first = dict[str, list[np.ndarray]](), [], self._count["frame/index"]
        for frame in frames:
            for name, one in frame.values.items():
                rows.setdefault(f"frame/{name}", []).append(one)
            at = dict.fromkeys(PARTS, -1)
            for name, one in frame.parts.items():
                many = rows.setdefault(PARTS[name], [])
                at[name] = self._count[PARTS[name]] + len(many)
                many.append(one)
            index.append((frame.episode._row, frame.time, *at.values()))
        size = sum(one.nbytes for many in rows.values() for one in many)
        with room(self._file, size + (len(frames) - 1) * FURTHER_FRAME):
            for table, many in rows.items():
                put(self._tables[table], self._count.get(table, first), np.stack(many))
                if table in self._count:
                    # Before the index has its row, so that none is named twice after an interrupt:
                    self._count[table] += len(many)
        self._write("frame/index", np.array(index, FRAME))
        for frame in frames:
            Content.frame(frame.episode._content, frame.time, frame.values | frame.parts)

    def _contact(self, forces: ContactForces, world: int) -> dict[str, np.ndarray]:
        """Forces of the walls, and tractions and places of the recorded points, of one world."""
        if self._point_count is None:
            raise ValueError(
                "forces need contact at surface points, which the model of this recorder has not; leave them out."
            )
        walls, dim = self._tables["force/total"].shape[1:]
        shapes = ((walls, dim), (walls, self._point_count, dim), (self._point_count, dim))
        for name, tensor, shape in zip(forces._fields, forces, shapes, strict=True):
            if tuple(tensor.shape[1:]) != shape:
                raise ValueError(
                    f"forces.{name} must have shape (world, *{shape}), got {tuple(tensor.shape)}."
                )
        points = self._points.to(forces.total.device)
        total, traction, places = (tensor.detach()[world] for tensor in forces)
        found = {"force": total, "traction": traction[:, points], "places": places[points]}
        return {name: as_numpy(tensor) for name, tensor in found.items() if tensor.numel()}

    def _write(self, name: str, rows: np.ndarray) -> None:
        self._need_open()
        with room(self._file, rows.nbytes):
            put(self._tables[name], self._count[name], rows)
        self._count[name] += len(rows)

    def _need_open(self) -> None:
        if not self._file:
            raise ValueError(f"{self.path}: this recorder is closed.")
        need_name(self._file)

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_) -> None:
        self.close()


class _Waiting(NamedTuple):
    """A frame that is to be written."""

    episode: "Episode"
    time: float
    values: dict[str, np.ndarray]
    parts: dict[str, np.ndarray]


class Episode:
    """One simulation of a recording; from :meth:`Recorder.episode`."""

    def __init__(self, recorder: Recorder, row: int, content: Hash):
        self._recorder, self._row, self._content, self._calls = recorder, row, content, 0

    def frame(
        self,
        time: float,
        state: State,
        activation: Tensor | None = None,
        field: GridField | Tensor | None = None,
        latent: Tensor | None = None,
        forces: ContactForces | None = None,
        *,
        inputs: Inputs | None = None,
        world: int = 0,
    ) -> None:
        """Record one instant of one world. Nothing is differentiated or modified.

        Args:
            time: Time since the start of this simulation [s].
            state: State of all worlds.
            activation: Muscle activation [-], shape (world, muscle) or (muscle,).
            field: Grid velocity [m/s], shape (world, *nodes, dim) or (*nodes, dim), or what ``rasterize`` returns.
            latent: What an observer saw, shape (world, size) or (size,).
            forces: What :func:`softmpm.contact_forces` returns for this state.
            inputs: Of the call that led to ``state``, of which the last pose of the walls is recorded; None leaves the walls where the
                scene has them.
            world: The world to record.
        """
        recorder, self._calls = self._recorder, self._calls + 1
        recorder._need_open()
        if (self._calls - 1) % recorder.every:
            return
        if not math.isfinite(time):
            raise ValueError(f"the time of a frame must be finite, got {time}.")
        if tuple(state.x.shape[1:]) != recorder._shape:
            raise ValueError(
                f"state.x must have shape (world, *{recorder._shape}), got {tuple(state.x.shape)}."
            )
        particles = recorder._particles.to(state.x.device)
        x, v, F = (tensor.detach()[world][particles] for tensor in (state.x, state.v, state.F))
        values = {"x": as_numpy(x), "v": as_numpy(v), "strain": as_numpy(strain(F))}
        row = {name: table.shape[1:] for name, table in recorder._tables.items()}
        values["activation"] = np.full(row["frame/activation"], np.nan, np.float32)
        if activation is not None:
            values["activation"] = of_one_world(
                "activation", activation, state, world, row["frame/activation"]
            )
        parts = {}
        if field is not None:
            velocity = field.velocity if isinstance(field, GridField) else field
            parts["field"] = of_one_world("field", velocity, state, world, row["field/velocity"])
        if latent is not None:  # the first one decides the size
            size = row["latent/value"] if row["latent/value"] != (0,) else tuple(latent.shape[-1:])
            parts["latent"] = of_one_world("latent", latent, state, world, size)
        if forces is not None:
            parts |= recorder._contact(forces, world)
        if (poses := given_poses(recorder._model, inputs)) is not None:
            last = (values[-1, world] for values in poses)
            parts |= {name: as_numpy(value) for name, value in zip(("normals", "offsets"), last, strict=True)}
        frame = _Waiting(self, float(time), values, parts)
        if recorder._waiting is None:
            recorder._write_together([frame])
        else:
            recorder._waiting.append(frame)

    def __enter__(self) -> "Episode":
        return self

    def __exit__(self, *_) -> None:
        pass


def _checked(iteration: int) -> int:
    if not (iteration == int(iteration) and iteration >= 0):
        raise ValueError(f"iteration must be a whole number from 0 on, got {iteration}.")
    return int(iteration)
