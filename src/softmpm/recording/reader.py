"""Recording: reads the file of a Recorder, while it is written, after it is closed or after its writer was killed.

A recording may come from another person, so nothing in it is trusted: only the names in ``format.py`` are
read, after the checks of ``format_checks.py``. This prevents a file from reading other files and from filling
memory; it cannot correct faults of the HDF5 library itself.
"""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np
from numpy.typing import ArrayLike

from softmpm.recording.format import (
    FORMAT,
    FRAME,
    PARTS,
    PER_FRAME,
    STATIC,
    TABLES,
    VERSION,
    complete,
    stored,
)
from softmpm.recording.format_checks import check_frames, check_shapes, check_values, names_of, plain_dataset
from softmpm.recording.superblock import readable
from softmpm.scene.actuators import labels
from softmpm.summary import table

_DAMAGE = (OSError, RuntimeError, LookupError, TypeError, AttributeError, OverflowError, MemoryError)
"""Exceptions of h5py for files that HDF5 cannot read."""
_ATTEMPTS, _PATIENCE, _PAUSE = 20, 15, 0.02
"""Most changes of the file by a writer while a reader tries again, most pauses in a row without one, and their length [s]."""
_T = TypeVar("_T")


class Recording:
    """A recorded run.

    Other tools can open the file too: ``h5py.File(path, "r", swmr=True)``; without ``swmr`` HDF5 refuses the
    file of a run that still writes or was killed, and with it HDF5 never returns from one that is damaged.

    Attributes:
        static: What does not change, by name: ``positions`` (particle, dim) [m], ``volume``, ``body``,
            ``particle`` (the model's index of each recorded particle), ``muscle`` (muscle, particle) 0 or 1,
            ``wall_normal``, ``grid_shape``, ``surface_wall`` (number of each separating wall in the scene),
            ``surface_point`` (the model's index of each recorded surface point), ``surface_area`` [m²], ...
        muscle_names: Labels of the muscles and pressures, as of :attr:`softmpm.Scene.muscle_names`.
        version: Of the format: 4; 3, which has no poses of walls; 2, which has no names of muscles either; or 1, without forces.
        dt, spacing: Substep [s] and grid spacing [m].
        share: Part of the model's particles that was recorded, 1 for all.
        episodes: Iterations of the recorded simulations, in the order of the run.
        scalars: Name to (iteration, value), two arrays.
        scalar_rows: Iteration, name and value of each in the order in which they were recorded.

    Raises:
        FileNotFoundError, OSError: There is no such file, or it is damaged.
        ValueError: The file is no recording, or holds what a recording must not.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._place = self.path.absolute()  # also where a program has changed its folder since
        if not self.path.is_file():
            raise FileNotFoundError(f"there is no recording {self.path}.")
        self._steadily(self._load)

    def __repr__(self) -> str:
        return f"Recording({', '.join(f'{name}: {text}' for name, text in self._rows().items())})"

    def _repr_html_(self) -> str:
        return table("softmpm.Recording", self._rows())

    def _rows(self) -> dict[str, str]:
        return {
            "file": str(self.path),
            "particles": f"{len(self.static['positions']):,}, {100 * self.share:.3g} % of the model's",
            "episodes": str(len(self.episodes)),
            "frames": str(len(self._frame)),
            "scalars": ", ".join(self.scalars) or "none",
        }

    def _steadily(self, read: Callable[[], _T]) -> _T:
        """The result of ``read``, which is repeated after a failure while a writer changes the file.

        One that has not changed it for a while may only wait for a processor, so the failure is final after :data:`_PATIENCE` pauses.
        """
        changes, pauses, before = 0, 0, None
        while True:
            try:
                return read()
            except (OSError, ValueError):
                if changes == _ATTEMPTS or pauses == _PATIENCE or not self._place.exists():
                    raise
                before = before or self._stamp()
                time.sleep(_PAUSE)
                now = self._stamp()
                changes, pauses = (changes, pauses + 1) if now == before else (changes + 1, 0)
                before = now

    def _stamp(self) -> tuple[int, ...]:
        found = os.stat(self._place)
        return found.st_mtime_ns, found.st_size, found.st_ino

    def _load(self) -> None:
        try:
            self._file = h5py.File(readable(self._place), "r", locking="best-effort")
        except (*_DAMAGE, ValueError) as error:
            raise OSError(f"{self.path} is not a readable recording: {error}.") from error
        try:
            self._read_tables()
        except _DAMAGE as error:
            self.close()
            raise OSError(f"{self.path} is damaged: {error}.") from error
        except ValueError:
            self.close()
            raise

    def _read_tables(self) -> None:
        attributes = self._file.attrs
        if attributes.get("format") != FORMAT.encode():
            raise ValueError(f"{self.path} is an HDF5 file, but no softmpm recording.")
        if (version := self._number("version")) not in range(1, VERSION + 1):
            raise ValueError(
                f"{self.path} has format version {version:g}; this softmpm reads 1 to {VERSION}."
            )
        self.version = int(version)
        self.dt, self.spacing, self.share = (self._number(name) for name in ("dt", "spacing", "share"))
        found = {
            name: self._dataset(f"static/{name}", dtype)[()]
            for name, (dtype, _) in stored(STATIC, self.version).items()
        }
        absent = {
            name: np.zeros(found["muscle"].shape[:1] if axes == "m" else 0, dtype)
            for name, (dtype, axes) in STATIC.items()
        }
        self.static: dict[str, np.ndarray] = absent | found
        tables = stored(TABLES, self.version).items()
        self._tables = {name: self._dataset(name, dtype) for name, (dtype, _) in tables}
        check_shapes(self.path, self.static, self._tables)
        check_values(self.path, self.static)
        kinds = ("muscle" if fibre.any() else "pressure" for fibre in self.static["muscle_direction"])
        self.muscle_names = labels(kinds, names_of(self.static))
        episodes = complete(self._tables["episode"].fields(["iteration"])[()])
        self._newest = {int(iteration): row for row, iteration in enumerate(episodes["iteration"])}
        self.episodes = tuple(self._newest)
        index = complete(self._tables["frame/index"][()])
        self._frame = np.full(len(index), -1, FRAME)
        for name in index.dtype.names or ():
            self._frame[name] = index[name]
        check_frames(self.path, self._frame, self._tables)
        self.scalar_rows = complete(self._tables["scalar"][()])
        self.scalars = self._by_name(self.scalar_rows)

    def _dataset(self, name: str, dtype: np.dtype) -> h5py.Dataset:
        return plain_dataset(self.path, self._file, name, dtype)

    def _number(self, name: str) -> float:
        value = np.asarray(self._file.attrs[name])
        if value.size != 1 or value.dtype.kind not in "iuf" or not 0 < float(value.item()) < np.inf:
            raise ValueError(f"{self.path}: the attribute {name} must be a number > 0, got {value!r:.100}.")
        return float(value.item())

    def _by_name(self, rows: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        names, first = np.unique(rows["name"], return_index=True)
        found = {name: rows[rows["name"] == name] for name in names[np.argsort(first)]}
        try:
            return {name.decode(): (those["iteration"], those["value"]) for name, those in found.items()}
        except UnicodeDecodeError as error:
            raise OSError(f"{self.path} is damaged: the name of a scalar is not UTF-8: {error}.") from error

    @property
    def dim(self) -> int:
        return self.static["positions"].shape[1]

    @property
    def particle_count(self) -> int:
        return self.static["positions"].shape[0]

    def attributes(self, iteration: int) -> dict:
        """Attributes of this simulation, as passed to :meth:`softmpm.Recorder.episode`."""
        row = self._row(iteration)
        try:
            found = json.loads(bytes(self._one_row("episode", row)["attributes"]) or b"{}")
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise OSError(
                f"{self.path} is damaged: the attributes of iteration {iteration} are no JSON object."
            )
        return found

    def _row(self, iteration: int) -> int:
        if iteration not in self._newest:
            raise KeyError(
                f"{self.path} has no simulation of iteration {iteration}; it has {list(self.episodes)}."
            )
        return self._newest[iteration]

    def rows(self, iteration: int) -> np.ndarray:
        """Rows of this simulation's frames, for :meth:`read`; those of the newer one if it was recorded twice."""
        return np.flatnonzero(self._frame["episode"] == self._row(iteration))

    def recorded(self, name: str, rows: np.ndarray) -> np.ndarray:
        """The subset of ``rows`` at which this quantity was recorded."""
        return rows[self._frame[name][rows] >= 0] if name in PARTS else rows

    def read(self, name: str, rows: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """One quantity, ``time x v strain activation field latent force traction places normals offsets``, at some frames.

        Returns:
            Those of ``rows`` at which it was recorded, and its values there, with a first axis of rows.
        """
        rows = np.asarray(rows, dtype=np.int64)
        if name == "time":
            return rows, self._frame["time"][rows]
        if name in PER_FRAME:
            return rows, self._take(f"frame/{name}", rows)
        rows = self.recorded(name, rows)
        return rows, self._take(PARTS[name], self._frame[name][rows])

    def _take(self, table: str, rows: np.ndarray) -> np.ndarray:
        if table not in self._tables:
            return np.zeros(0, TABLES[table][0])
        data = self._tables[table]
        out = np.zeros((len(rows), *data.shape[1:]), data.dtype)
        for k, row in enumerate(rows if out.size else ()):
            out[k] = self._one_row(table, int(row))
        return out

    def _one_row(self, table: str, row: int) -> np.ndarray:
        if not self._file:
            raise ValueError(f"{self.path}: this recording is closed.")

        def read() -> np.ndarray:
            try:
                return self._tables[table][row]
            except (*_DAMAGE, ValueError) as error:
                raise OSError(f"{self.path} is damaged: row {row} of {table}: {error}.") from error

        return self._steadily(read)

    def frames(self, iteration: int) -> dict[str, np.ndarray]:
        """All frames of one simulation.

        Returns:
            ``time`` (frame,) [s], ``x`` and ``v`` (frame, particle, dim), ``strain`` (frame, particle),
            ``activation`` (frame, muscle); and where they were recorded ``field`` (row, *nodes, dim),
            ``latent`` (row, size), of the separating walls ``force`` (row, wall, dim) [N], ``traction``
            (row, wall, point, dim) [Pa] and ``places`` of the surface points (row, point, dim) [m], and of all walls that are not
            where the scene has them ``normals`` (row, wall, dim) and ``offsets`` (row, wall) [m], each with ``field_frame`` and so on
            (row,), the frame that each row belongs to.
        """
        rows = self.rows(iteration)
        out = {name: self.read(name, rows)[1] for name in ("time", *PER_FRAME)}
        for name in PARTS:
            have, values = self.read(name, rows)
            if len(have):
                out[name], out[f"{name}_frame"] = values, np.searchsorted(rows, have)
        return out

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_) -> None:
        self.close()
