"""What a recording holds, and how to read it: the other half of ``recording.py``.

A recording is one HDF5 file of tables that only grow. Row k of a table is complete once its first number is not negative:

    episode         {iteration, attributes}         one row per recorded simulation
    scalar          {iteration, name, value}        one row per number, such as a loss
    frame/index     {episode, time}                 one row per frame, written after the frame's data
    frame/x, v      (frame, particle, dim)          [m], [m/s]
    frame/strain    (frame, particle)               ‖(FᵀF − I)/2‖ [-], zero for a rigid motion
    frame/activation  (frame, muscle)               [-], NaN where none was given
    field/index, field/velocity                     frame number; (row, *nodes, dim) [m/s]
    latent/index, latent/value                      frame number; (row, size)
    static/*                                        rest shape, muscles, walls: see :class:`softmpm.Recorder`

A file may come from somebody else, so nothing in it is trusted: only these names are read, each must be plain numbers in this
file (no links, no external or virtual data), and none may claim more data than the file can hold.
"""

import json
from pathlib import Path

import h5py
import numpy as np

FORMAT, VERSION = b"softmpm recording", 1
EPISODE = np.dtype([("iteration", "<i8"), ("attributes", "S4096")])
SCALAR = np.dtype([("iteration", "<i8"), ("name", "S64"), ("value", "<f8")])
FRAME = np.dtype([("episode", "<i8"), ("time", "<f8")])
REAL, INDEX = np.dtype("<f4"), np.dtype("<i8")

STATIC = {  # name: type, axes; p particles, d dim, m muscles, w walls
    "positions": (REAL, "pd"),
    "volume": (REAL, "p"),
    "body": (INDEX, "p"),
    "particle": (INDEX, "p"),
    "gravity": (REAL, "d"),
    "muscle": (np.dtype("u1"), "mp"),
    "muscle_direction": (REAL, "md"),
    "muscle_strength": (REAL, "m"),
    "wall_normal": (REAL, "wd"),
    "wall_offset": (REAL, "w"),
    "wall_friction": (REAL, "w"),
    "wall_contact": (np.dtype("S8"), "w"),
    "grid_shape": (INDEX, "d"),
}
TABLES = {  # as above; r any number of rows, n the grid's nodes, l the size of the latent
    "episode": (EPISODE, "r"),
    "scalar": (SCALAR, "r"),
    "frame/index": (FRAME, "r"),
    "frame/x": (REAL, "rpd"),
    "frame/v": (REAL, "rpd"),
    "frame/strain": (REAL, "rp"),
    "frame/activation": (REAL, "rm"),
    "field/index": (INDEX, "r"),
    "field/velocity": (REAL, "rnd"),
    "latent/index": (INDEX, "r"),
    "latent/value": (REAL, "rl"),
}
PER_FRAME = ("x", "v", "strain", "activation")
_SAFE_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
_BEST_COMPRESSION = 1100  # deflate never exceeds 1032:1


class Recording:
    """A recorded run, read while it is written, after it ended, or after it was killed.

    Other tools can open the file too: ``h5py.File(path, "r", swmr=True)``; without ``swmr`` HDF5 refuses the file of a run
    that still writes or was killed.

    Attributes:
        static: What does not change, by name: ``positions`` (particle, dim) [m], ``volume``, ``body``, ``particle`` (the
            model's index of each recorded particle), ``muscle`` (muscle, particle) 0 or 1, ``wall_normal``, ``grid_shape``, ...
        dt, spacing: Substep [s] and grid spacing [m].
        episodes: Iterations of the recorded simulations, in the order of the run.
        scalars: Name to (iteration, value), two arrays.

    Raises:
        FileNotFoundError, OSError: There is no such file, or it is damaged.
        ValueError: The file is no recording, or holds what a recording must not.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"there is no recording {self.path}.")
        try:
            self._file = h5py.File(self.path, "r", swmr=True, locking="best-effort")
        except OSError as error:
            raise OSError(f"{self.path} is not a readable recording: {error}.") from error
        try:
            self._load()
        except OSError as error:
            self.close()
            raise OSError(f"{self.path} is damaged: {error}.") from error
        except Exception:
            self.close()
            raise

    def _load(self) -> None:
        attributes = self._file.attrs
        if attributes.get("format") != FORMAT:
            raise ValueError(f"{self.path} is an HDF5 file, but no softmpm recording.")
        if attributes["version"] != VERSION:
            raise ValueError(f"{self.path} has format version {attributes['version']}; this softmpm reads {VERSION}.")
        self.dt, self.spacing = float(attributes["dt"]), float(attributes["spacing"])
        self.static = {name: self._dataset(f"static/{name}", *STATIC[name])[()] for name in STATIC}
        self._check_static()
        self._tables = {name: self._dataset(name, *TABLES[name]) for name in TABLES}
        self._check_tables()
        rows = _complete(self._tables["episode"][()], "iteration")
        self._frame = _complete(self._tables["frame/index"][()], "episode")
        self._newest = {int(iteration): row for row, iteration in enumerate(rows["iteration"])}
        self._attributes = rows["attributes"]
        self.episodes = tuple(self._newest)
        self.scalars = _by_name(_complete(self._tables["scalar"][()], "iteration"))

    def _dataset(self, name: str, dtype: np.dtype, axes: str) -> h5py.Dataset:
        """The named dataset, if it is what a recording holds under that name and lies wholly in this file."""
        node = self._file
        for part in name.split("/"):
            if not isinstance(node, h5py.Group) or not isinstance(node.get(part, getlink=True), h5py.HardLink):
                raise ValueError(f"{self.path}: {name} is missing or leads out of the file.")
            node = node[part]
        if not isinstance(node, h5py.Dataset) or node.is_virtual or node.external:
            raise ValueError(f"{self.path}: {name} is not data of this file.")
        if node.dtype != dtype:
            raise ValueError(f"{self.path}: {name} must have type {dtype}, got {node.dtype}.")
        created = node.id.get_create_plist()
        filters = {created.get_filter(i)[0] for i in range(created.get_nfilters())}
        if not filters <= _SAFE_FILTERS:
            raise ValueError(f"{self.path}: {name} uses HDF5 filters {filters - _SAFE_FILTERS}; refused.")
        if node.nbytes > _BEST_COMPRESSION * self.path.stat().st_size:
            raise ValueError(f"{self.path}: {name} claims {node.nbytes} bytes, more than the file can hold.")
        dim = int(self._file.attrs["dim"])
        if node.ndim != len(axes) + (dim - 1) * axes.count("n") or dim not in (2, 3):
            raise ValueError(f"{self.path}: {name} has shape {node.shape}, which does not suit {dim}D.")
        return node

    def _check_static(self) -> None:
        size = {"p": self.particle_count, "d": self.dim}
        size |= {"m": len(self.static["muscle"]), "w": len(self.static["wall_offset"])}
        for name, (_, axes) in STATIC.items():
            self._check_shape(f"static/{name}", self.static[name].shape, tuple(size[axis] for axis in axes))

    def _check_tables(self) -> None:
        size = {"p": (self.particle_count,), "d": (self.dim,), "m": (len(self.static["muscle"]),)}
        size["n"] = tuple(int(n) for n in self.static["grid_shape"])
        size["l"] = self._tables["latent/value"].shape[1:]
        for name, (_, axes) in TABLES.items():
            want = sum((size[axis] for axis in axes[1:]), ())
            self._check_shape(name, self._tables[name].shape[1:], want)

    def _check_shape(self, name: str, got: tuple, want: tuple) -> None:
        if got != want:
            raise ValueError(f"{self.path}: rows of {name} must have shape {want}, got {got}.")

    @property
    def dim(self) -> int:
        return self.static["positions"].shape[1]

    @property
    def particle_count(self) -> int:
        return self.static["positions"].shape[0]

    def attributes(self, iteration: int) -> dict:
        """What :meth:`softmpm.Recorder.episode` was given for this simulation."""
        return json.loads(self._attributes[self._row(iteration)] or b"{}")

    def _row(self, iteration: int) -> int:
        if iteration not in self._newest:
            raise KeyError(f"{self.path} has no simulation of iteration {iteration}; it has {list(self.episodes)}.")
        return self._newest[iteration]

    def rows(self, iteration: int) -> np.ndarray:
        """Row numbers of this simulation's frames, for :meth:`read`. If it was recorded twice, of the newer one."""
        return np.flatnonzero(self._frame["episode"] == self._row(iteration))

    def read(self, name: str, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows of one quantity: which of ``rows`` have it, and its values there.

        ``name`` is one of ``time x v strain activation field latent``.
        """
        rows = np.asarray(rows, dtype=np.int64)
        if name == "time":
            return rows, self._frame["time"][rows]
        if name in PER_FRAME:
            return rows, self._take(f"frame/{name}", rows)
        table = {"field": "field/velocity", "latent": "latent/value"}[name]
        index = self._tables[f"{name}/index"][: len(self._tables[table])]
        have = np.flatnonzero(np.isin(index, rows))
        return index[have], self._take(table, have)

    def _take(self, table: str, rows: np.ndarray) -> np.ndarray:
        data = self._tables[table]
        out = np.empty((len(rows), *data.shape[1:]), data.dtype)
        try:
            for k, row in enumerate(rows):
                data.read_direct(out, np.s_[int(row)], np.s_[k])
        except OSError as error:
            raise OSError(f"{self.path} is damaged: {table}, row {row}: {error}.") from error
        return out

    def frames(self, iteration: int) -> dict[str, np.ndarray]:
        """All frames of one simulation.

        Returns:
            ``time`` (frame,) [s], ``x`` and ``v`` (frame, particle, dim), ``strain`` (frame, particle), ``activation``
            (frame, muscle); and where they were recorded ``field`` (row, *nodes, dim) and ``latent`` (row, size), with
            ``field_frame`` and ``latent_frame`` (row,), the frame that each row belongs to.
        """
        rows = self.rows(iteration)
        out = {name: self.read(name, rows)[1] for name in ("time", *PER_FRAME)}
        for name in ("field", "latent"):
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


def _complete(rows: np.ndarray, key: str) -> np.ndarray:
    """Rows up to the first that a killed run did not finish."""
    unfinished = np.flatnonzero(rows[key] < 0)
    return rows[: unfinished[0]] if len(unfinished) else rows


def _by_name(rows: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    names, first = np.unique(rows["name"], return_index=True)
    select = {name: rows[rows["name"] == name] for name in names[np.argsort(first)]}
    return {name.decode(): (found["iteration"], found["value"]) for name, found in select.items()}
