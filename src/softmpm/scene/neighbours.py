"""Neighbours at rest: pairs of particles whose separation is numerical fracture."""

import math

import numpy as np

from softmpm.scene.scene import Scene

REACH = 1.25
"""Neighbours are nearer than this many spacings of their body: the axis neighbours of a lattice, not the diagonal ones. The spacing is
the typical distance of particles, or the width of the volume of one where that is larger: a thin body has its rows closer together."""
ROOM = 1.35
"""They may at least stretch by this factor before they are too far apart: pairs that are nearly so at rest are no neighbours."""


def rest_neighbours(scene: Scene, longest: float) -> np.ndarray:
    """Up to ``dim`` neighbours of each particle, by index, filled up with -1; shape (particle, dim), int32.

    Each pair of neighbours is listed once. Bodies have no neighbours in others, since those may part.

    Args:
        longest: Largest distance that neighbours may have in a run [m].
    """
    parts, first = [], 0
    for body in scene.bodies:
        width = float(np.median(body.particles.volume)) ** (1 / body.particles.positions.shape[1])
        found = _within(body.particles.positions, width, longest / ROOM)
        parts.append(np.where(found < 0, -1, found + first))
        first += len(body.particles)
    return np.concatenate(parts).astype(np.int32)


def neighbour_pairs(scene: Scene) -> np.ndarray:
    """Pairs of particles of a body that are neighbours at rest, each pair once: indices into the particles of the scene, shape
    (pair, 2).

    Where a body tears they part, and their deformation gradients hardly tell.
    """
    found = rest_neighbours(scene, math.inf)
    one, place = np.nonzero(found >= 0)
    return np.stack([one, found[one, place]], axis=1)


def _within(positions: np.ndarray, width: float, longest: float) -> np.ndarray:
    from scipy.spatial import KDTree

    count, dim = positions.shape
    if count == 1:
        return np.full((1, dim), -1)
    nearest = min(2 * dim, count - 1)
    found = KDTree(positions).query(positions, k=nearest + 1, workers=-1)
    distance, index = (np.asarray(part)[:, 1:] for part in found)  # without the particle itself
    spacing = max(np.median(distance[:, 0]), width)
    own = np.arange(count)[:, None]
    near = (distance <= REACH * spacing) & (distance <= longest)
    mutual = (index[index] == own[..., None]).any(-1)  # else only this particle lists the pair
    chosen = near & ((index > own) | ~mutual)
    order = np.argsort(~chosen, axis=1, kind="stable")[:, :dim]
    index = np.where(chosen, index, -1)
    return np.pad(
        np.take_along_axis(index, order, 1), ((0, 0), (0, max(0, dim - nearest))), constant_values=-1
    )
