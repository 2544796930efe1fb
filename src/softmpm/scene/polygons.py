"""Unions of polygons: their boundary, and distances from it.

An edge is divided where others meet it; a piece is part of the boundary if one of its sides is inside of the union and the other is
not. So polygons may overlap, share sides, cross themselves and turn either way.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from softmpm.validate import need

SNAP = 1e-7
"""Vertices that are nearer than this share of the extent are one."""


def inside(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """True for each point that lies in a closed polygon (even-odd rule), shape (point,).

    Picks the particles of a muscle by a drawn region: ``np.flatnonzero(softmpm.inside(particles.positions, region))``.

    Args:
        points: Shape (point, 2).
        polygon: Vertices, shape (vertex, 2).
    """
    points, a = np.asarray(points, dtype=np.float64), np.asarray(polygon, dtype=np.float64)
    b = np.roll(a, -1, axis=0)
    x, y = points[:, 0, None], points[:, 1, None]
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])  # a level edge never crosses
    at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
    return ((crosses & (x < at)).sum(axis=1) % 2) == 1


def inside_any(points: np.ndarray, polygons: Sequence[np.ndarray]) -> np.ndarray:
    """True for each point that lies in the union of polygons."""
    return np.any([inside(points, polygon) for polygon in polygons], axis=0)


def union_boundary(polygons: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Boundary of a union as closed polygons, the inside to their left; holes turn the other way round."""
    extent = float(np.ptp(np.concatenate(polygons), axis=0).max())
    start, end = _pieces(polygons, extent)
    along = end - start
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    middle, step = (start + end) / 2, 3 * SNAP * extent
    on_left, on_right = (inside_any(middle + side * step * left, polygons) for side in (1, -1))
    kept = on_left != on_right
    turned = on_right[:, None]
    start, end = np.where(turned, end, start)[kept], np.where(turned, start, end)[kept]
    _, first = np.unique(np.round((start + end) / (8 * SNAP * extent)), axis=0, return_index=True)
    return _joined(start[np.sort(first)], end[np.sort(first)], extent)


def boundary_distance(points: np.ndarray, boundary: Sequence[np.ndarray]) -> np.ndarray:
    """Distance of each point from closed polygons [m], shape (point,)."""
    return np.linalg.norm(points - nearest_on(points, boundary)[0], axis=1)


def nearest_on(points: np.ndarray, boundary: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Nearest point of closed polygons to each point [m], and the unit normal to the left of its edge, shapes (point, 2)."""
    square, nearest, left = np.full(len(points), np.inf), np.empty_like(points), np.empty_like(points)
    for a, along in _edges(boundary):
        share = np.clip((points - a) @ along / (along @ along), 0.0, 1.0)
        place = a + share[:, None] * along
        found = np.square(points - place).sum(axis=1)
        closer = found < square
        square[closer], nearest[closer] = found[closer], place[closer]
        left[closer] = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    return nearest, left


def ray_length(points: np.ndarray, directions: np.ndarray, boundary: Sequence[np.ndarray]) -> np.ndarray:
    """Distance of each point from closed polygons along a unit vector (point, 2) [m], shape (point,); inf where there is nothing."""
    length = np.full(len(points), np.inf)
    for a, along in _edges(boundary):
        across = directions[:, 0] * along[1] - directions[:, 1] * along[0]
        away, slope = a - points, np.where(across == 0.0, np.inf, across)  # a parallel edge is not met
        ahead = (away[:, 0] * along[1] - away[:, 1] * along[0]) / slope
        share = (away[:, 0] * directions[:, 1] - away[:, 1] * directions[:, 0]) / slope
        met = (across != 0.0) & (ahead > 0.0) & (share >= 0.0) & (share <= 1.0)
        length = np.where(met, np.minimum(length, ahead), length)
    return length


def _edges(boundary: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Start and vector of each edge of closed polygons."""
    for polygon in boundary:
        yield from zip(polygon, np.roll(polygon, -1, axis=0) - polygon, strict=True)


def _pieces(polygons: Sequence[np.ndarray], extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends of the parts into which the edges divide each other, shape (piece, 2)."""
    start = np.concatenate(polygons)
    end = np.concatenate([np.roll(polygon, -1, axis=0) for polygon in polygons])
    long = np.linalg.norm(end - start, axis=1) > SNAP * extent
    start, end = start[long], end[long]
    starts, ends = [start[:0]], [end[:0]]
    for a, b in zip(start, end, strict=True):
        along = b - a
        length = np.linalg.norm(along)
        across = np.array([-along[1], along[0]]) / length
        low, high = (start - a) @ across, (end - a) @ across  # heights of all edges above this one
        apart = np.maximum(np.abs(low), np.abs(high)) > SNAP * extent  # the others lie along this one
        crossing = apart & ((low > 0) != (high > 0))
        share = low[crossing] / (low[crossing] - high[crossing])
        met = start[crossing] + share[:, None] * (end - start)[crossing]
        touching = start[np.abs(low) <= SNAP * extent]
        cuts = np.concatenate([met, touching]) - a
        places = np.sort(cuts @ along / length)
        places = places[(places > SNAP * extent) & (places < length - SNAP * extent)]
        places = np.concatenate([[0.0], places[np.diff(places, prepend=0.0) > SNAP * extent], [length]])
        corners = a + places[:, None] / length * along
        corners[-1] = b
        starts.append(corners[:-1])
        ends.append(corners[1:])
    return np.concatenate(starts), np.concatenate(ends)


def _joined(start: np.ndarray, end: np.ndarray, extent: float) -> list[np.ndarray]:
    """Closed polygons of pieces, each continued by the piece that begins where it ends."""
    polygons, free = [], np.ones(len(start), dtype=bool)
    while free.any():
        first = k = int(free.argmax())
        walk = []
        while True:
            walk.append(start[k])
            free[k] = k == first  # the walk ends where it began
            distance = np.where(free, np.linalg.norm(start - end[k], axis=1), np.inf)
            k = int(distance.argmin())
            need(
                float(distance[k]) < 1e3 * SNAP * extent,
                f"the polygons leave a gap of {distance[k]:.3g} m in their boundary near {end[k].tolist()}; vertices closer than "
                f"{SNAP * extent:.1g} m must be the same.",
            )
            if k == first:
                break
        free[first] = False
        polygons.append(np.array(walk))
    return polygons
