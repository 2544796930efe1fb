"""Pairs of neighbours at rest, against all distances."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

import softmpm
from softmpm import Body, Grid, NeoHookean, Scene

SPACING = 0.05


@pytest.mark.parametrize("corner, size", [((0.3, 0.3), (0.5, 0.25)), ((0.3, 0.3, 0.3), (0.25, 0.2, 0.15))])
def test_the_pairs_are_the_axis_neighbours_of_each_body(corner, size):
    """Of two boxes that touch: each pair of particles of a box one spacing apart once, and none between the boxes."""
    beside = (corner[0] + size[0], *corner[1:])
    solid = NeoHookean(density=1e3, young=1e5, poisson=0.3)
    boxes = [softmpm.box(place, np.add(place, size), SPACING) for place in (corner, beside)]
    grid = Grid(shape=(20,) * len(corner), spacing=0.1)
    scene = Scene(grid=grid, bodies=[Body(box, solid) for box in boxes], dt=1e-4)
    pairs = softmpm.neighbour_pairs(scene)
    x, count = np.concatenate([box.positions for box in boxes]), len(boxes[0])
    near = np.argwhere(np.triu(cdist(x, x) < 1.01 * SPACING, k=1))
    near = near[(near < count).all(axis=1) | (near >= count).all(axis=1)]
    assert len(pairs) == len(near) > 0
    assert {frozenset(pair) for pair in pairs.tolist()} == {frozenset(pair) for pair in near.tolist()}


@pytest.mark.parametrize("size", [(0.5, 1.55), (0.5, 1.3, 1.55), (0.5, 0.5, 1.55)])
def test_rows_close_together_do_not_hide_the_others(size):
    """A thin box has them at 0.775 of its spacing: every axis neighbour is found, along the body too."""
    thin = tuple(SPACING * side if side > 1 else side for side in size)
    box = softmpm.box((0.3,) * len(size), np.add(0.3, thin), SPACING)
    grid = Grid(shape=(20,) * len(size), spacing=0.1)
    scene = Scene(grid=grid, bodies=[Body(box, NeoHookean(density=1e3, young=1e5))], dt=1e-4)
    steps = [len(np.unique(box.positions[:, axis].round(9))) for axis in range(len(size))]
    want = sum(len(box) // n * (n - 1) for n in steps)
    assert len(softmpm.neighbour_pairs(scene)) == want


@pytest.mark.parametrize("rows", [1.5, 2.5])
def test_a_cut_strip_is_in_one_piece(rows):
    """Its rows are as close together as 0.75 of the spacing."""
    corners = np.array([(0.3, 0.3), (0.8, 0.3), (0.8, 0.3 + rows * SPACING), (0.3, 0.3 + rows * SPACING)])
    strip = softmpm.polygons([corners], SPACING, cut_cells=True)
    scene = Scene(
        grid=Grid(shape=(20, 20), spacing=0.1),
        bodies=[Body(strip, NeoHookean(density=1e3, young=1e5))],
        dt=1e-4,
    )
    pairs = softmpm.neighbour_pairs(scene)
    graph = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(strip),) * 2)
    assert connected_components(graph, directed=False)[0] == 1
