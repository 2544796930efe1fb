"""Nodes, bricks and cells of the reference formulation at rest."""

import numpy as np
import pytest

from softmpm.rest_grid import WARP, packed


@pytest.mark.parametrize("cells", [16, 64, 128])
def test_cells_take_as_few_warps_as_their_slices_allow(cells):
    """Cells of one warp of a full brick stay in one warp, in their order, and no two have one slot. With two warps nothing is left to
    gain: one suffices whenever the cells fit into it."""
    rng, brick, cell = np.random.default_rng(0), [], []
    for b in range(200):
        number = int(rng.integers(1, cells + 1))
        cell.append(np.sort(rng.choice(cells, number, replace=False)))
        brick.append(np.full(number, b))
    brick, cell = np.concatenate(brick), np.concatenate(cell)
    slot = packed(brick, cell)
    for b in range(200):
        own, numbers = slot[brick == b], cell[brick == b]
        assert (np.diff(own) > 0).all() and own[0] == 0 and own[-1] < cells
        for whole in np.unique(numbers // WARP):
            assert len(np.unique(own[numbers // WARP == whole] // WARP)) == 1
        if cells <= 2 * WARP:
            assert own[-1] // WARP == (len(own) - 1) // WARP
