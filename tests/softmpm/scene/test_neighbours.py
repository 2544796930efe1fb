"""Pairs of neighbours at rest, against all distances."""

import numpy as np
import pytest
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
