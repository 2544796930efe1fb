"""Checks, before any data is read, that a file has the format that a recorder writes and contains all that it declares.

A recording may come from another person. Each dataset must be plain numbers inside the file (no links, no external
or virtual data), stored as ``format.py`` stores it, and all declared data must be present: HDF5 would otherwise fill
in the missing part, in memory.
"""

from pathlib import Path

import h5py
import numpy as np

from softmpm.recording.format import FRAMES, PARTS, PER_FRAME, SCALAR, STATIC, TABLES
from softmpm.scene.actuators import NAMES, is_name

_CHECKSUM = {h5py.h5z.FILTER_FLETCHER32}
_PACKED = _CHECKSUM | {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE}
_BEST_COMPRESSION = 1100  # deflate never exceeds 1032:1
_UNFINISHED = 2**20  # bytes that a table may declare and lack: a kill between the two


def plain_dataset(path: Path, file: h5py.File, name: str, dtype: np.dtype) -> h5py.Dataset:
    """The named dataset; raise ValueError unless it has the format of that name and lies wholly in this file."""
    node = file
    for part in name.split("/"):
        if not isinstance(node, h5py.Group) or not isinstance(node.get(part, getlink=True), h5py.HardLink):
            raise ValueError(f"{path}: {name} is missing or leads out of the file.")
        node = node[part]
    if not isinstance(node, h5py.Dataset) or node.is_virtual or node.external:
        raise ValueError(f"{path}: {name} is not data of this file.")
    if node.dtype != dtype:
        raise ValueError(f"{path}: {name} must have type {dtype}, got {node.dtype}.")
    created = node.id.get_create_plist()
    filters = {created.get_filter(i)[0] for i in range(created.get_nfilters())}
    known = _CHECKSUM if name.startswith("static/") or dtype in (SCALAR, *FRAMES.values()) else _PACKED
    if not filters <= known:
        raise ValueError(f"{path}: {name} uses HDF5 filters {filters - known}; refused.")
    _check_storage(path, node, name, _BEST_COMPRESSION if filters - _CHECKSUM else 1)
    return node


def _check_storage(path: Path, node: h5py.Dataset, name: str, compression: int) -> None:
    stored, row = node.id.get_storage_size(), node.dtype.itemsize * int(np.prod(node.shape[1:], dtype=object))
    chunk = node.dtype.itemsize * int(np.prod(node.chunks or (0,), dtype=object))
    lacking = 0 if name.startswith("static/") else max(row, _UNFINISHED)
    if node.nbytes > compression * stored + lacking or chunk > compression * max(stored, _UNFINISHED):
        raise ValueError(f"{path}: {name} declares {node.nbytes} bytes, but stores only {stored}.")
    if stored > path.stat().st_size:
        raise ValueError(f"{path}: {name} stores {stored} bytes, more than the file has.")


def check_shapes(path: Path, static: dict[str, np.ndarray], tables: dict[str, h5py.Dataset]) -> None:
    """Check that each axis has the same size in all tables."""
    if static["positions"].ndim != 2 or static["positions"].shape[1] not in (2, 3):
        raise ValueError(f"{path}: static/positions must have shape (particle, 2 or 3).")
    size = dict(zip("pd", ((n,) for n in static["positions"].shape), strict=True))
    size |= {"n": tuple(int(n) for n in static["grid_shape"].ravel())}
    size |= {"m": static["muscle"].shape[:1], "w": static["wall_offset"].shape[:1]}
    size |= {"l": tables["latent/value"].shape[1:]}
    size |= {"k": static["surface_wall"].shape[:1], "s": static["surface_point"].shape[:1]}
    found = {f"static/{name}": (static[name].shape, axes) for name, (_, axes) in STATIC.items()}
    found |= {name: (table.shape[1:], TABLES[name][1][1:]) for name, table in tables.items()}
    for name, (got, axes) in found.items():
        want = sum((size[axis] for axis in axes), ())
        if got != want:
            raise ValueError(f"{path}: {name} must have shape {want} (without rows), got {got}.")


def check_values(path: Path, static: dict[str, np.ndarray]) -> None:
    """Check that all numbers are finite, that the grid has cells, and that the walls exist."""
    for name, values in static.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"{path}: static/{name} must be finite.")
    walls, known = static["surface_wall"], len(static["wall_offset"])
    if len(walls) and not 0 <= walls.min() <= walls.max() < known:
        raise ValueError(f"{path}: static/surface_wall names a wall beyond the {known} that there are.")
    if not all(map(is_name, names_of(static))):
        raise ValueError(f"{path}: each row of static/muscle_name must have {NAMES}.")
    if static["grid_shape"].min() < 2:
        raise ValueError(f"{path}: static/grid_shape must be at least 2, got {static['grid_shape']}.")


def names_of(static: dict[str, np.ndarray]) -> list[str]:
    """Names of the muscles, empty for one without; what is not UTF-8 becomes characters that are not printable."""
    return [name.decode(errors="surrogateescape") for name in static["muscle_name"].tolist()]


def check_frames(path: Path, index: np.ndarray, tables: dict[str, h5py.Dataset]) -> None:
    """Check that the rows that each frame refers to exist and are its own: a recorder appends them, so they ascend. Frames of episodes
    that began after the index was read belong to none."""
    for name, table in PARTS.items():
        count = len(tables[table]) if table in tables else 0
        if len(index) and not -1 <= index[name].min() <= index[name].max() < count:
            raise ValueError(f"{path}: frame/index names rows of {name} beyond the {count} that there are.")
        if (np.diff(index[name][index[name] >= 0]) <= 0).any():
            raise ValueError(f"{path}: frame/index names a row of {name} twice, or after a later one.")
    for table in {f"frame/{name}" for name in PER_FRAME} & tables.keys():
        if len(tables[table]) < len(index):
            raise ValueError(f"{path}: {table} has fewer rows than frame/index.")
    if not np.isfinite(index["time"]).all():
        raise ValueError(f"{path}: the times in frame/index must be finite.")
