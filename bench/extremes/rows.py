"""A row of a map: one quantity taken to its extremes, and every row there is."""

from collections.abc import Callable
from dataclasses import dataclass

from .cells import How


@dataclass(frozen=True, kw_only=True)
class Row:
    """Cells of every law in 2D and 3D along one quantity."""

    name: str
    title: str
    """What varies, and by which measure."""
    right: str
    """What a right cell has to show."""
    values: tuple
    few: tuple
    """Values of the short map."""
    cell: Callable[[type, int, float, How], str]
    """Law, dimension, value and setting to the note of a right cell."""
    dims: Callable[[float], tuple[int, ...]] = lambda value: (2, 3)
    """Dimensions in which a value has a cell."""

    counts_substeps: bool = False
    """Whether the values are substeps, of which a run may have a limit."""

    def label(self, value) -> str:
        if isinstance(value, str):
            return value
        if value == 0 or 0.01 <= abs(value) < 10_000:
            return f"{value:g}"
        return f"{value:.0e}".replace("e+0", "e").replace("e-0", "e-")
