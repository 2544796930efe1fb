"""Every row of the maps, in the order and on the pages of docs/limits.md."""

from . import actuators, loads, material, numerics, starts, viscosity, walls
from .rows import Row

PAGES: dict[str, list[Row]] = {
    "material": material.ROWS,
    "viscosity": viscosity.ROWS,
    "loads": loads.ROWS,
    "actuators": actuators.ROWS,
    "walls": walls.ROWS,
    "starts": starts.ROWS,
    "numerics": numerics.ROWS,
}
