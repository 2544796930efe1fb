"""Recording: read what a Recorder wrote, while it writes, after it ended or after it was killed.

A recording may come from somebody else, so nothing in it is trusted: only the names in ``layout.py`` are
read, each must be plain numbers inside this file (no links, no external or virtual data), and none may claim
more than the file can hold. That keeps a file from reading other files and from filling memory; it cannot
mend faults of the HDF5 library itself.
"""

import json
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike

from softmpm.layout import FORMAT, PARTS, PER_FRAME, STATIC, TABLES, VERSION, complete

_SAFE_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
_BEST_COMPRESSION = 1100  # deflate never exceeds 1032:1


class Recording:
    """A recorded run.

    Other tools can open the file too: ``h5py.File(path, "r", swmr=True)``; without ``swmr`` HDF5 refuses the
    file of a run that still writes or was killed.

    Attributes:
        static: What does not change, by name: ``positions`` (particle, dim) [m], ``volume``, ``body``,
            ``particle`` (the model's index of each recorded particle), ``muscle`` (muscle, particle) 0 or 1,
            ``wall_normal``, ``grid_shape``, ...
        dt, spacing: Substep [s] and grid spacing [m].
        share: Part of the model's particles that was recorded, 1 for all.
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
            self._file = h5py.File(self.path, "r", swmr=_unclosed(self.path), locking="best-effort")
        except OSError as error:
            raise OSError(f"{self.path} is not a readable recording: {error}.") from error
        try:
            self._load()
        except ValueError:
            self.close()
            raise
        except Exception as error:  # h5py reports damage as OSError, RuntimeError, KeyError or TypeError
            self.close()
            raise OSError(f"{self.path} is damaged: {error}.") from error

    def _load(self) -> None:
        attributes = self._file.attrs
        if attributes.get("format") != FORMAT.encode():
            raise ValueError(f"{self.path} is an HDF5 file, but no softmpm recording.")
        version = np.asarray(attributes["version"]).item()
        if version != VERSION:
            raise ValueError(f"{self.path} has format version {version}; this softmpm reads {VERSION}.")
        numbers = (float(np.asarray(attributes[name]).item()) for name in ("dt", "spacing", "share"))
        self.dt, self.spacing, self.share = numbers
        self.static = {
            name: self._dataset(f"static/{name}", dtype)[()] for name, (dtype, _) in STATIC.items()
        }
        self._tables = {name: self._dataset(name, dtype) for name, (dtype, _) in TABLES.items()}
        self._check_shapes()
        episodes = complete(self._tables["episode"][()])
        self._attributes = episodes["attributes"]
        self._newest = {int(iteration): row for row, iteration in enumerate(episodes["iteration"])}
        self.episodes = tuple(self._newest)
        self._frame = complete(self._tables["frame/index"][()])
        self.scalars = _by_name(complete(self._tables["scalar"][()]))

    def _dataset(self, name: str, dtype: np.dtype) -> h5py.Dataset:
        """The named dataset, if it is what a recording holds under that name and lies wholly in this file."""
        node = self._file
        for part in name.split("/"):
            if not isinstance(node, h5py.Group) or not isinstance(
                node.get(part, getlink=True), h5py.HardLink
            ):
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
        if max(node.nbytes, _chunk_bytes(node)) > _BEST_COMPRESSION * self.path.stat().st_size:
            raise ValueError(f"{self.path}: {name} claims {node.nbytes} bytes, more than the file can hold.")
        return node

    def _check_shapes(self) -> None:
        """One size for each axis, everywhere."""
        static = self.static
        if static["positions"].ndim != 2 or static["positions"].shape[1] not in (2, 3):
            raise ValueError(f"{self.path}: static/positions must have shape (particle, 2 or 3).")
        size = {
            "p": (self.particle_count,),
            "d": (self.dim,),
            "n": tuple(int(n) for n in static["grid_shape"]),
        }
        size |= {"m": static["muscle"].shape[:1], "w": static["wall_offset"].shape[:1]}
        size |= {"l": self._tables["latent/value"].shape[1:]}
        found = {f"static/{name}": (static[name].shape, axes) for name, (_, axes) in STATIC.items()}
        found |= {name: (self._tables[name].shape[1:], axes[1:]) for name, (_, axes) in TABLES.items()}
        for name, (got, axes) in found.items():
            want = sum((size[axis] for axis in axes), ())
            if got != want:
                raise ValueError(f"{self.path}: {name} must have shape {want} (without rows), got {got}.")

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
            raise KeyError(
                f"{self.path} has no simulation of iteration {iteration}; it has {list(self.episodes)}."
            )
        return self._newest[iteration]

    def rows(self, iteration: int) -> np.ndarray:
        """Rows of this simulation's frames, for :meth:`read`; of the newer one, if it was recorded twice."""
        return np.flatnonzero(self._frame["episode"] == self._row(iteration))

    def recorded(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Those of ``rows`` at which this quantity was recorded."""
        return rows[self._frame[name][rows] >= 0] if name in PARTS else rows

    def read(self, name: str, rows: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """One quantity, ``time x v strain activation field latent``, at some frames.

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
        data = self._tables[table]
        out = np.zeros((len(rows), *data.shape[1:]), data.dtype)
        for k, row in enumerate(rows if out.size else ()):
            try:
                data.read_direct(out, np.s_[int(row)], np.s_[k])
            except (OSError, TypeError, ValueError) as error:
                raise OSError(f"{self.path} is damaged: row {row} of {table}: {error}.") from error
        return out

    def frames(self, iteration: int) -> dict[str, np.ndarray]:
        """All frames of one simulation.

        Returns:
            ``time`` (frame,) [s], ``x`` and ``v`` (frame, particle, dim), ``strain`` (frame, particle),
            ``activation`` (frame, muscle); and where they were recorded ``field`` (row, *nodes, dim) and
            ``latent`` (row, size), with ``field_frame`` and ``latent_frame`` (row,), the frame that each row
            belongs to.
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


def _unclosed(path: Path) -> bool:
    """Whether its writer still writes or was killed. Only such a file is read in the mode for that: on a damaged
    file this mode would wait for a writer to mend it, for ever.

    Source: HDF5 File Format Specification 3.0, II.A, superblock version 3.
    """
    with open(path, "rb") as file:
        head = file.read(36)
    version, flags, end = head[8:9], head[11:12], int.from_bytes(head[28:36], "little")
    if version != b"\x03" or not flags or not flags[0] & 4:
        return False
    if path.stat().st_size < end:
        raise OSError(f"it was cut to {path.stat().st_size} of at least {end} bytes")
    return True


def _chunk_bytes(dataset: h5py.Dataset) -> int:
    """Memory that reading one number of it takes."""
    return dataset.dtype.itemsize * int(np.prod(dataset.chunks or (0,), dtype=object))


def _by_name(rows: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    names, first = np.unique(rows["name"], return_index=True)
    found = {name: rows[rows["name"] == name] for name in names[np.argsort(first)]}
    return {name.decode(): (those["iteration"], those["value"]) for name, those in found.items()}
