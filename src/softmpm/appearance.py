"""How a recorded robot looks: colours, sizes, walls, arrows and what to frame. NumPy only."""

from itertools import product

import numpy as np

BODY = np.array([(205, 208, 214), (216, 206, 190), (194, 210, 196), (210, 198, 214)], float)
MUSCLE_SHADE = 0.86  # a muscle at rest is this much darker than its body
CONTRACT, EXTEND = np.array((206, 32, 41), float), np.array((24, 88, 200), float)
STRAIN = np.array([(52, 34, 110), (42, 92, 160), (32, 150, 148), (128, 196, 84), (250, 222, 60)], float)
WALL = {b"stick": (70, 70, 78), b"slip": (120, 160, 190), b"separate": (120, 112, 104)}
MOST_ARROWS = 3000


def pack(rgb: np.ndarray) -> np.ndarray:
    """Colours (..., 3) from 0 to 255 as opaque 0xRRGGBBAA."""
    r, g, b = np.moveaxis(np.clip(np.rint(rgb), 0, 255).astype(np.uint32), -1, 0)
    return (r << 24) | (g << 16) | (b << 8) | np.uint32(255)


def activation_colours(static: dict[str, np.ndarray], activation: np.ndarray) -> np.ndarray:
    """Red where muscles pull, blue where they push, the body's grey at rest.

    Args:
        static: Of a recording.
        activation: Activation [-], shape (frame, muscle); NaN counts as none.

    Returns:
        Packed colours, shape (frame, particle). Muscles that overlap add, and saturate at ±1.
    """
    total = np.clip(np.nan_to_num(activation) @ static["muscle"].astype(np.float32), -1, 1)[..., None]
    shade = np.where(static["muscle"].any(0), MUSCLE_SHADE, 1.0)[:, None]
    body = BODY[static["body"] % len(BODY)] * shade
    return pack(body + np.abs(total) * (np.where(total > 0, CONTRACT, EXTEND) - body))


def strain_colours(strain: np.ndarray, top: float) -> np.ndarray:
    """Dark violet for 0 to yellow for ``top`` and above; strain (frame, particle), as are the packed colours."""
    at = np.clip(np.nan_to_num(strain, nan=top) / top, 0, 1) * (len(STRAIN) - 1)
    return pack(np.stack([np.interp(at, np.arange(len(STRAIN)), channel) for channel in STRAIN.T], -1))


def radii(volume: np.ndarray, shown: float, dim: int) -> np.ndarray:
    """Radius [m] of each particle's dot, so that the dots fill the body when a share ``shown`` of it is drawn."""
    return 0.62 * (volume / shown) ** (1 / dim)


def wall_outline(normal: np.ndarray, offset: float, upper: np.ndarray) -> np.ndarray:
    """Where the surface n·x = offset cuts the box from 0 to ``upper``.

    Returns:
        Corners (corner, dim) in order: 2 in 2D, 3 to 6 in 3D; none if the wall misses the box.
    """
    corners = np.array(list(product(*((0.0, u) for u in upper))))
    side = corners @ normal - offset
    found = [corner for corner, s in zip(corners, side, strict=True) if abs(s) < 1e-9]
    for i, j in product(range(len(corners)), repeat=2):
        if i < j and (corners[i] != corners[j]).sum() == 1 and side[i] * side[j] < 0:
            found.append(corners[i] + (corners[j] - corners[i]) * side[i] / (side[i] - side[j]))
    found = np.unique(np.round(found, 12), axis=0) if found else np.zeros((0, len(upper)))
    if len(found) < len(upper):
        return np.zeros((0, len(upper)))
    if len(upper) == 2:
        return found
    first = found[0] - found.mean(0)
    first /= np.linalg.norm(first)
    around = np.arctan2((found - found.mean(0)) @ np.cross(normal, first), (found - found.mean(0)) @ first)
    return found[np.argsort(around)]


def hatch(outline: np.ndarray, normal: np.ndarray, gap: float) -> np.ndarray:
    """Short strokes on the solid side of a 2D wall, shape (stroke, 2, 2)."""
    start, end = outline
    length = np.linalg.norm(end - start)
    along = (end - start) / max(length, 1e-12)
    feet = start + np.arange(gap / 2, length, gap)[:, None] * along
    return np.stack([feet, feet - gap * (normal + along)], 1)


def arrows(velocity: np.ndarray, spacing: float, top: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arrows on the nodes that move, at most a few thousand, the fastest about three cells long.

    Args:
        velocity: Grid velocity [m/s], shape (*nodes, dim).
        spacing: Of the grid [m].
        top: Speed [m/s] drawn at full length.

    Returns:
        origins [m] and vectors [m], (arrow, dim), and packed colours (arrow,).
    """
    speed = np.linalg.norm(velocity, axis=-1)
    nodes = np.argwhere(speed > 0.01 * top)
    nodes = nodes[:: -(-len(nodes) // MOST_ARROWS) or 1]
    vectors = velocity[tuple(nodes.T)] / top
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    vectors *= 3 * spacing / np.maximum(length, 1)
    return nodes * spacing, vectors, strain_colours(length.T, 1.0)[0]


def frame_box(low: np.ndarray, high: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Part of the grid worth looking at: where the robot was, and some room around it."""
    room = 0.12 * float((high - low).max())
    return np.maximum(low - room, -0.02 * upper.max()), np.minimum(high + room, upper * 1.02)


def eye(low: np.ndarray, high: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where to stand to see a 3D box, a little from above: position and target [m]."""
    target, size = (low + high) / 2, float(np.linalg.norm(high - low))
    extent = high - low
    side = np.array([extent[i] if abs(up[i]) < 0.5 else np.inf for i in range(3)])
    front = np.eye(3)[int(np.argmin(side))]  # look along the robot's thin axis, at its broad side
    across = np.cross(up, front)
    direction = front + 0.45 * across + 0.4 * up
    return target + 1.25 * size * direction / np.linalg.norm(direction), target
