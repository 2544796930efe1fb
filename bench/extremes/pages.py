"""Every row of the maps, in the order and on the pages of docs/limits.md."""

from . import loads, material, numerics, starts
from .rows import Row

PAGES: dict[str, list[Row]] = {
    "material": material.ROWS,
    "loads": loads.ROWS,
    "starts": starts.ROWS,
    "numerics": numerics.ROWS,
}
