"""Files of a run folder: replaced whole or not at all, never through a link, and named when something fails.

A folder may come from somebody else. A link in it could lead a resumed run to write anywhere, and a pipe could make it wait for
ever; so both are refused before anything is opened.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_NO_LINK = getattr(os, "O_NOFOLLOW", 0)


def check_folder(folder: Path) -> None:
    """Raise ValueError for what is neither a file nor a folder, here and in ``replay``."""
    for place in (folder, folder / "replay"):
        if place.is_symlink() and place != folder:
            raise ValueError(_refusal(place, "a link"))
        for entry in sorted(place.iterdir()) if place.is_dir() else ():
            mode = entry.lstat().st_mode
            if stat.S_ISLNK(mode):
                raise ValueError(_refusal(entry, "a link"))
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise ValueError(_refusal(entry, "neither a file nor a folder"))


def _refusal(path: Path, what: str) -> str:
    return (
        f"{path} is {what}, and a run follows none, because it would write where that leads; "
        "put the file itself in its place, or move it out of the folder."
    )


@contextmanager
def named(doing: str, path: Path) -> Iterator[None]:
    """An error of the system names the file and what was to be done with it."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(f"cannot {doing} {path}: {error.strerror}.") from error


def read(path: Path, most: int | None = None) -> bytes:
    """The bytes of a file that is no link, at most so many."""
    with named("read", path), os.fdopen(os.open(path, os.O_RDONLY | _NO_LINK), "rb") as file:
        return file.read() if most is None else file.read(most)


def draft(path: Path, data: bytes) -> Path:
    """Write a file under another name, to be renamed once it is whole and on the disk."""
    place = path.with_name(f"{path.name}.new")
    with named("write", place):
        place.unlink(missing_ok=True)  # of an interrupted write, or a link
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK
        with os.fdopen(os.open(place, flags, 0o666), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    return place


def replace(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, also after a loss of power."""
    place = draft(path, data)
    with named("write", path):
        os.replace(place, path)


def append(path: Path, data: bytes) -> None:
    """Add to a file that is there and no link, and force it to the disk."""
    with named("write", path), os.fdopen(os.open(path, os.O_WRONLY | os.O_APPEND | _NO_LINK), "ab") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def opened_for_lock(path: Path) -> Iterator[int]:
    """Descriptor of a file that is made if need be, and neither read nor changed."""
    with named("open", path):
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | _NO_LINK, 0o666)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
