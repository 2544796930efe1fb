"""A file that is written whole or not at all."""

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def draft(path: Path) -> Iterator[Path]:
    """Another name beside a path, for the block to write; what is there at its end takes the place of the path.

    The name is in no other program's use. A process that is killed leaves the unfinished file behind.

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
