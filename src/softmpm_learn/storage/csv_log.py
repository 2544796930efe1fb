"""A CSV file that grows by a row for each iteration and goes on from where a checkpoint sealed it."""

import hashlib
import logging
import math
from pathlib import Path
from typing import TypedDict

from softmpm_learn.storage import files

logger = logging.getLogger("softmpm_learn")


class Seal(TypedDict):
    """Length and hash of a growing file, as stored in a checkpoint."""

    bytes: int
    """Length [B] when the checkpoint was written."""
    sha256: str
    """Hash of these bytes."""


def kept(path: Path, columns: list[str], seal: Seal | None) -> bytes:
    """Content that a :class:`Table` goes on after: the file as it was sealed, or a header.

    Raises:
        ValueError: The file is not the one that was sealed, or has other columns.
    """
    header = (",".join(["iteration", *columns]) + "\n").encode()
    if seal is None or not path.exists():
        return header
    content = files.read(path, seal["bytes"])
    if len(content) != seal["bytes"] or hashlib.sha256(content).hexdigest() != seal["sha256"]:
        raise ValueError(
            f"{path} is damaged or of another run: its first {seal['bytes']} bytes are not those that the checkpoint knows; put the "
            "right file there, or move it away to go on without its rows."
        )
    if not content.startswith(header):
        raise ValueError(
            f"{path} should have the columns {header.decode().strip()}; a run of an earlier version has others. Move the file away to "
            "go on without its rows."
        )
    return content


class Table:
    """Rows of numbers under fixed column names; the first column is ``iteration``, counted without gaps.

    Numbers are written so that they read back to the last bit; nan becomes an empty cell.

    Args:
        path: The file.
        columns: Names after ``iteration``.
        seal: Go on after what this describes, and drop the rest; None begins a new file. Where the file is missing, a new one begins
            too, and the log says so.

    Raises:
        ValueError: The file is not the one that was sealed, or has other columns.
    """

    def __init__(self, path: Path, columns: list[str], seal: Seal | None = None):
        self.path, self.columns = path, columns
        content = kept(path, columns, seal)
        if seal is not None and not path.exists():
            logger.warning("%s is missing; its rows up to here are lost, and a new one begins.", path)
        self._hash, self._bytes = hashlib.sha256(content), len(content)
        self._lines: list[str] = []
        files.replace(path, content)

    @property
    def seal(self) -> Seal:
        """For the checkpoint: what :class:`Table` goes on from, the rows that were flushed."""
        return {"bytes": self._bytes, "sha256": self._hash.hexdigest()}

    def append(self, iteration: int, values: dict[str, float]) -> None:
        """Add the row of an iteration, to be written by :meth:`flush`; a missing value is an empty cell."""
        unknown = set(values) - set(self.columns)
        if unknown:
            raise ValueError(f"{self.path.name} has no column {', '.join(sorted(unknown))}.")
        cells = [values.get(name, math.nan) for name in self.columns]
        self._lines.append(
            ",".join([str(iteration), *("" if math.isnan(c) else repr(c) for c in cells)]) + "\n"
        )

    def flush(self) -> None:
        """Force all rows to the disk."""
        if not self._lines:
            return
        added = "".join(self._lines).encode()
        files.append(self.path, added)
        self._hash.update(added)
        self._bytes += len(added)
        self._lines.clear()
