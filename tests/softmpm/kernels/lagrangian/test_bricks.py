"""Bricks of cells: the order of their cells suits the shared memory of a GPU."""

import numpy as np
import pytest

from softmpm.kernels.lagrangian.bricks import Bricks

LARGE = Bricks((4, 4, 4), 2, lattice=True)
WARP, BANKS = 32, 8
"""Threads of a warp, and nodes of 16 bytes that the banks of shared memory have at a time."""


def cells_in_order(bricks: Bricks) -> np.ndarray:
    return np.stack(np.unravel_index(np.argsort(bricks.cell_numbers, axis=None), bricks.cells), axis=-1)


@pytest.mark.parametrize(
    "bricks", [LARGE, LARGE._replace(serial=True), Bricks((4, 4, 2), 2), Bricks((8, 8), 4)]
)
def test_each_cell_has_a_number(bricks):
    """Numbers count the cells, on the CPU in the order of their coordinates."""
    cells = cells_in_order(bricks)
    assert (bricks.cell_numbers[tuple(cells.T)] == np.arange(bricks.cell_count)).all()
    if bricks.serial:
        assert (np.diff(np.ravel_multi_index(tuple(cells.T), bricks.cells)) == 1).all()


def test_eight_threads_load_from_different_banks():
    """The first nodes of eight cells in a row lie in different banks."""
    corners = np.ravel_multi_index(tuple(cells_in_order(LARGE).T), LARGE.window)
    for start in range(0, len(corners), BANKS):
        assert len(set(corners[start : start + BANKS] % BANKS)) == BANKS


def test_a_slice_lies_in_one_warp():
    """Cells with the same first coordinate, which take turns in adding to a node, belong to one warp."""
    warp = np.arange(LARGE.cell_count) // WARP
    for first in range(LARGE.cells[0]):
        assert len(set(warp[cells_in_order(LARGE)[:, 0] == first])) == 1
