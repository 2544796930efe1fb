"""Cut cells: lattice cells that the surface of a shape crosses, each with the volume and the centroid of its inner part.

A weighted quadrature of the shape, as finite cell and cut finite element methods use: mass and its centre converge with spacing²,
where a lattice of whole cells is off by its steps. Slivers would be light particles that deform first, so each joins a neighbour.
"""

from itertools import product

import numpy as np

SAMPLES = 4
"""Samples of a cell along each axis."""
SLIVER = 0.35
"""Parts below this share of a cell join the fullest neighbour: particles below a third of a cell inverted first."""
NOTHING = 1e-6
"""Shares below this are rounding, not part of the shape."""


def sample_points(middles: np.ndarray, spacing: float) -> np.ndarray:
    """Middles of the parts into which cells are sampled, shape (cell, SAMPLES**dim, dim), the last axis fastest."""
    along = ((np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5) * spacing
    dim = middles.shape[1]
    return middles[:, None] + np.stack(np.meshgrid(*[along] * dim, indexing="ij"), axis=-1).reshape(-1, dim)


def share_inside(distance: np.ndarray, width: float, thickness: np.ndarray | float = np.inf) -> np.ndarray:
    """Share of a small cube of this width that lies inside, from the signed distance of its middle, negative inside [m].

    Exact for planes along its sides, and for sheets between two of them; for others the error is odd in the distance and averages
    out.

    Args:
        distance: Of the nearest point of the surface [m].
        width: Of the cube [m].
        thickness: From that point on to the surface opposite [m]: a sheet thinner than the cube fills a part of it.
    """
    return np.clip(0.5 - distance / width, 0.0, 1.0) - np.clip(0.5 - (distance + thickness) / width, 0.0, 1.0)


def inward(
    points: np.ndarray, nearest: np.ndarray, normal: np.ndarray, distance: np.ndarray, shift: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rays into a shape from the nearest points of its surface: starts, shifted inwards [m], and unit vectors, shapes (point, dim).

    Args:
        normal: Unit inward normals there, for points no farther than the shift, shape (point, dim).
        distance: Signed distance of the points, negative inside [m].
    """
    size = np.abs(distance)[:, None]
    away = (nearest - points) * np.where(distance > 0.0, 1.0, -1.0)[:, None]
    direction = np.where(size > shift, away / np.maximum(size, shift), normal)
    return nearest + shift * direction, direction


def inner_parts(middles: np.ndarray, weights: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Share of each cell that is inside, and centroid of that part, from the shares of its samples, shape (cell, sample)."""
    (offsets,) = sample_points(np.zeros((1, middles.shape[1])), spacing)
    total = np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    return weights.mean(axis=1), middles + weights @ offsets / total


def merge_slivers(
    share: np.ndarray, centroid: np.ndarray, count: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and volumes of the parts of a lattice of ``count`` cells, shape (prod(count),); slivers join a neighbour.

    Volume and centre of mass are preserved. Among neighbours that are equally full the nearest is taken; equally near ones share the
    sliver, which keeps shapes symmetric. A sliver without a neighbour that is none stays, as in sheets thinner than that.
    """
    dim = len(count)
    shape = tuple(int(n) + 2 for n in count)  # with an empty cell around, so that all have neighbours
    inner = np.arange(np.prod(shape)).reshape(shape)[(slice(1, -1),) * dim].ravel()
    full, place = np.zeros(np.prod(shape)), np.zeros((np.prod(shape), dim))
    full[inner], place[inner] = np.where(share > NOTHING, share, 0.0), centroid
    small = np.round(full, 9) < SLIVER  # whatever its rounding
    sliver = np.flatnonzero((full > 0) & small)
    steps = np.array([step for step in product((-1, 0, 1), repeat=dim) if any(step)])
    near = sliver[:, None] + steps @ np.array([np.prod(shape[axis + 1 :], dtype=int) for axis in range(dim)])
    apart = np.linalg.norm(place[near] - place[sliver, None], axis=2) / spacing
    merit = np.where(small[near], -np.inf, np.round(full[near], 6) - 1e-7 * apart)
    best = merit.max(axis=1, initial=-np.inf, keepdims=True)
    chosen = np.isfinite(best) & (merit >= best - 1e-13)
    part = chosen / np.maximum(chosen.sum(axis=1, keepdims=True), 1)
    moment = place * full[:, None]
    np.add.at(moment, near, part[:, :, None] * moment[sliver, None])
    np.add.at(full, near, part * full[sliver, None])
    full[sliver[chosen.any(axis=1)]] = 0.0
    kept = np.flatnonzero(full)
    return moment[kept] / full[kept, None], full[kept] * spacing**dim
