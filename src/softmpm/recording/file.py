"""File of a recorder: it begins with the retained part of an older file, and is then open for appending.

The old file remains until the new one is complete; disk space is reserved before HDF5 writes.
"""

import contextlib
import errno
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from softmpm.model import Model
from softmpm.recording.digest import Content
from softmpm.recording.format import (
    EPISODE,
    FRAME,
    PARTS,
    PER_FRAME,
    STATIC,
    create,
    put,
    stored,
    tables,
)
from softmpm.recording.reader import Recording

_OPEN = {"libver": ("v110", "v110"), "locking": "best-effort"}  # the oldest format that has the mode
_PAGES = {"fs_strategy": "page", "fs_page_size": 4096}  # a kill cannot leave a page half written
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
    """Write a new recording that begins with the simulations of the file at ``path`` before iteration ``resume_before``."""
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
    """Copy everything of the iterations before ``before``. The names of muscles are labels, and may have changed."""
    for name in stored(STATIC, old.version):
        if name != "muscle_name" and not np.array_equal(static[name], old.static[name]):
            raise ValueError(f"{old.path} records another scene ({name} differs); record to another path.")
    for name in ("dt", "spacing"):
        if file.attrs[name] != getattr(old, name):
            then, now = getattr(old, name), file.attrs[name]
            raise ValueError(
                f"{old.path} records another scene ({name} was {then:g} and is {now:g}); record to another path."
            )

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
            extend("frame/index", np.array([(len(new["episode"]) - 1, when, *at.values())], FRAME))
            Content.frame(episode, when, values | parts)
    kept = old.scalar_rows[old.scalar_rows["iteration"] < before]
    extend("scalar", kept)
    for row in kept.tolist():
        content.scalar(*row)


@contextlib.contextmanager
def room(file: h5py.File, size: int) -> Iterator[None]:
    """Reserve ``size`` bytes on the disk for the writes inside, and release the unused rest.

    HDF5 must not encounter a full disk itself: after a failed write it crashes the process.
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
    """Open a file directly in reader-safe mode; a kill between "r+" and ``swmr_mode`` would leave it locked.

    Readers lock the file while they open it; this waits for them.
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
    """Replace the old file by the finished new one atomically."""
    with open(draft, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(draft, path)


def need_name(file: h5py.File) -> None:
    """Raise FileNotFoundError if the file has no name any more: nobody could read what is written to it."""
    if os.fstat(file.id.get_vfd_handle()).st_nlink == 0:
        text = "cannot record: the file was deleted, or replaced by another recorder; give each recorder a path of its own"
        raise FileNotFoundError(errno.ENOENT, text, file.filename)
