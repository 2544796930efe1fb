"""A row of a map: one quantity varied up to its extremes."""

from collections.abc import Callable
from dataclasses import dataclass

from .cells import How


@dataclass(frozen=True, kw_only=True)
class Row:
    """Cells of every law in 2D and 3D along one quantity."""

    name: str
    title: str
    """The varied quantity and its unit."""
    right: str
    """Criteria of a right outcome."""
    values: tuple
    few: tuple
    """Values of the short map."""
    cell: Callable[[type, int, float, How], str]
    """Function of law, dimension, value and settings; returns the note of a right outcome."""
    dims: Callable[[float], tuple[int, ...]] = lambda value: (2, 3)
    """Dimensions in which a value is run."""

    counts_substeps: bool = False
    """True if the values are numbers of substeps, which ``How.longest`` bounds."""

    def label(self, value) -> str:
        if isinstance(value, str):
            return value
        if value == 0 or 0.01 <= abs(value) < 10_000:
            return f"{value:g}"
        return f"{value:.0e}".replace("e+0", "e").replace("e-0", "e-")
