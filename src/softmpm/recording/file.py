"""The file of a recorder: begun with what is kept of an older one, then open to be appended to.

The old file stays until the new one is whole; room on the disk is claimed before HDF5 writes.
"""

import contextlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from softmpm.model import Model
from softmpm.recording.digest import Content
from softmpm.recording.format import EPISODE, FRAME, PARTS, PER_FRAME, SCALAR, create, put, tables
from softmpm.recording.reader import Recording

_OPEN = {"libver": ("v110", "v110"), "locking": "best-effort"}  # the oldest format that has the mode
_PAGES = {"fs_strategy": "page", "fs_page_size": 4096}  # a kill cannot tear what does not cross a page
_ROOM_EXTRA = 2**20  # for HDF5's own tables
_PATIENCE = 10.0  # seconds that a reader may take to open a file


def begin(
    draft: Path,
    model: Model,
    static: dict[str, np.ndarray],
    path: Path,
    resume_before: int | None,
    content: Content,
) -> None:
    """Write a recording with what is kept of the one at ``path``."""
    resumed = resume_before is not None and path.exists()
    kept = path.stat().st_size if resumed else 0
    size = sum(values.nbytes for values in static.values()) + kept
    try:
        with h5py.File(draft, "x", **_OPEN, **_PAGES) as file, room(file, size):
            create(file, model, static)
            if resumed:
                with Recording(path) as old:
                    _copy(old, file, static, resume_before or 0, content)
    except RuntimeError as error:  # HDF5 cannot close a file for which there is no room
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


def _copy(
    old: Recording, file: h5py.File, static: dict[str, np.ndarray], before: int, content: Content
) -> None:
    """Everything of iterations before ``before``."""
    for name, values in static.items():
        if not np.array_equal(values, old.static[name]):
            raise ValueError(f"{old.path} records another scene ({name} differs); record to another path.")

    new = tables(file)

    def extend(name: str, rows: np.ndarray) -> None:
        put(new[name], len(new[name]), rows)

    for iteration in (i for i in old.episodes if i < before):
        text = json.dumps(old.attributes(iteration)).encode()
        extend("episode", np.array([(iteration, text)], EPISODE))
        episode = content.episode(iteration, text)
        for row in old.rows(iteration):
            values = {name: old.read(name, [row])[1] for name in PER_FRAME}
            parts = {name: rows for name in PARTS if len(rows := old.read(name, [row])[1])}
            at = {name: len(new[PARTS[name]]) if name in parts else -1 for name in PARTS}
            for name, rows in values.items():
                extend(f"frame/{name}", rows)
            for name, rows in parts.items():
                extend(PARTS[name], rows)
            when = old.read("time", [row])[1][0]
            extend(
                "frame/index", np.array([(len(new["episode"]) - 1, when, at["field"], at["latent"])], FRAME)
            )
            Content.frame(episode, when, values | parts)
    for name, (iterations, values) in old.scalars.items():
        kept = [(i, name.encode(), v) for i, v in zip(iterations, values, strict=True) if i < before]
        extend("scalar", np.array(kept, SCALAR))
        for row in kept:
            content.scalar(*row)


@contextlib.contextmanager
def room(file: h5py.File, size: int) -> Iterator[None]:
    """Claim room for ``size`` bytes on the disk, write, and give back the rest.

    HDF5 must not meet a full disk itself: after a write that failed it crashes the process.
    """
    handle, end = file.id.get_vfd_handle(), file.id.get_filesize()
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(handle, end, size + _ROOM_EXTRA)
    except OSError as error:
        with contextlib.suppress(OSError):  # there may not even be room for that; the first error counts
            os.ftruncate(handle, end)
        text = f"no room to record ({error.strerror}); what was recorded is safe"
        raise OSError(error.errno, text, file.filename) from error
    yield
    file.flush()
    os.ftruncate(handle, file.id.get_filesize())


def open_to_append(path: Path) -> h5py.File:
    """Open straight into reader-safe mode; a kill between "r+" and ``swmr_mode`` locks a file.

    Readers hold a lock while they open the file: waited for.
    """
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_V110, h5py.h5f.LIBVER_V110)
    access.set_file_locking(True, True)
    flags = h5py.h5f.ACC_RDWR | h5py.h5f.ACC_SWMR_WRITE
    end = time.monotonic() + _PATIENCE
    while True:
        try:
            return h5py.File(h5py.h5f.open(os.fsencode(path), flags, fapl=access))
        except BlockingIOError as error:
            if time.monotonic() > end:
                text = "cannot record: another program has had the file open for a while; close it"
                raise BlockingIOError(error.errno, text, os.fspath(path)) from error
            time.sleep(0.01)


def put_in_place(draft: Path, path: Path) -> None:
    """At every instant there is the old file or the finished new one."""
    with open(draft, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(draft, path)
