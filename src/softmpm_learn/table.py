"""A CSV file that grows by a row for each iteration and can be cut back to where a run resumes."""

import math
import os
from pathlib import Path


class Table:
    """Rows of numbers under fixed column names; the first column is ``iteration``, counted from 0 without gaps.

    Numbers are written so that they read back to the last bit; nan becomes an empty cell.

    Args:
        path: The file.
        columns: Names after ``iteration``.
        rows: Keep this many rows of a file that is there; a row cut short by a kill goes with the rest.
    """

    def __init__(self, path: Path, columns: list[str], rows: int = 0):
        self.path, self.columns = path, columns
        header = ",".join(["iteration", *columns]) + "\n"
        kept = [header]
        if rows:
            old = path.read_text().splitlines(keepends=True) if path.exists() else []
            if len(old) < 1 + rows or old[0] != header:
                raise ValueError(
                    f"{path} should have {rows} rows of {header.strip()}; it has {max(len(old) - 1, 0)}."
                )
            kept = old[: 1 + rows]
        draft = path.with_name(path.name + ".new")
        draft.write_text("".join(kept))
        os.replace(draft, path)

    def append(self, iteration: int, values: dict[str, float]) -> None:
        """Add the row of an iteration and force it to the disk; a missing value is an empty cell."""
        unknown = set(values) - set(self.columns)
        if unknown:
            raise ValueError(f"{self.path.name} has no column {', '.join(sorted(unknown))}.")
        cells = [values.get(name, math.nan) for name in self.columns]
        line = ",".join([str(iteration), *("" if math.isnan(c) else repr(c) for c in cells)])
        with open(self.path, "a") as file:
            file.write(line + "\n")
            file.flush()
            os.fsync(file.fileno())
