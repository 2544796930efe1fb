"""A file that is written whole or not at all."""

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def draft(path: Path) -> Iterator[Path]:
    """Path of a temporary file in the same folder, for the block to write. If the block succeeds, the file replaces ``path``; else it
    is deleted, and ``path`` stays as it was.

    The name is random. A process that is killed leaves the temporary file behind.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "there is no such folder", str(path.parent))
    place = path.absolute().with_name(f"{path.stem}.unfinished-{secrets.token_hex(4)}{path.suffix}")
    try:
        yield place
        os.replace(place, path)
    finally:
        place.unlink(missing_ok=True)
