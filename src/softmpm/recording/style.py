"""Appearance of a recorded robot: colours, sizes, walls, arrows and camera. NumPy only."""

import numpy as np

BODY = np.array([(205, 208, 214), (216, 206, 190), (194, 210, 196), (210, 198, 214)], float)
MUSCLE_SHADE = 0.86  # a muscle at rest is this much darker than its body
CONTRACT, EXTEND = np.array((206, 32, 41), float), np.array((24, 88, 200), float)
STRAIN = np.array([(52, 34, 110), (42, 92, 160), (32, 150, 148), (128, 196, 84), (250, 222, 60)], float)
WALL = {
    b"stick": (70, 70, 78),
    b"slip": (120, 160, 190),
    b"separate": (120, 112, 104),
    b"clamp": (52, 52, 60),
    b"symmetry": (150, 180, 205),
}
MOST_ARROWS = 3000
LEAST_ARROW = 0.01  # of the longest
LONGEST = 3.0  # length of the longest arrow [cells]
TRACTION = (20, 110, 50)


def pack(rgb: np.ndarray) -> np.ndarray:
    """Colours (..., 3) from 0 to 255 as opaque 0xRRGGBBAA."""
    r, g, b = np.moveaxis(np.clip(np.rint(rgb), 0, 255).astype(np.uint32), -1, 0)
    return (r << 24) | (g << 16) | (b << 8) | np.uint32(255)


def activation_colours(static: dict[str, np.ndarray], activation: np.ndarray) -> np.ndarray:
    """Red where the activation is positive, as of muscles that pull, blue where it is negative, the body's grey at rest.

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
    """Packed colours of strain (frame, particle): dark violet for 0 to yellow for ``top`` and above."""
    at = np.clip(np.nan_to_num(strain, nan=top) / top, 0, 1) * (len(STRAIN) - 1)
    return pack(np.stack([np.interp(at, np.arange(len(STRAIN)), channel) for channel in STRAIN.T], -1))


def radii(volume: np.ndarray, shown: float, dim: int) -> np.ndarray:
    """Radius [m] of each particle's dot; a part ``shown`` of all dots then fills the body."""
    return 0.7 * (volume / shown) ** (1 / dim)


def wall_outlines(normals: np.ndarray, offsets: np.ndarray, upper: np.ndarray) -> list[np.ndarray]:
    """Visible part of the surface n·x = offset of each wall.

    Args:
        normals, offsets: Of the walls, shapes (wall, dim) and (wall,).
        upper: The grid reaches from 0 to here, shape (dim,) [m].

    Returns:
        For each wall its corners (corner, dim) in order, two in 2D; none if it is outside or hidden.
    """
    dim, outlines = len(upper), []
    free = [(axis, 0.0) for axis in np.eye(dim)] + [
        (-axis, -u) for axis, u in zip(np.eye(dim), upper, strict=True)
    ]
    for k, (normal, offset) in enumerate(zip(normals, offsets, strict=True)):
        across = np.linalg.svd(normal[None])[2][1:]  # unit vectors in the surface
        corners = np.concatenate([across, -across])  # of a square, or the ends of a line
        outline = offset * normal + 10 * (np.linalg.norm(upper) + abs(offset)) * corners
        others = [other for j, other in enumerate(zip(normals, offsets, strict=True)) if j != k]
        for limit_normal, limit in [*free, *others]:
            outline = clip(outline, limit_normal, limit - 1e-6 * upper.max())
        outlines.append(outline)
    return outlines


def clip(corners: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """Part of a convex polygon, or of a line of two points, with n·x ≥ offset (Sutherland and Hodgman 1974)."""
    side = corners @ normal - offset
    kept = []
    for i, j in zip(range(len(corners)), np.roll(range(len(corners)), -1), strict=True):
        if side[i] >= 0:
            kept.append(corners[i])
        if side[i] * side[j] < 0 and (len(corners) > 2 or i < j):  # a line has no edge back to its start
            kept.append(corners[i] + (corners[j] - corners[i]) * side[i] / (side[i] - side[j]))
    return np.array(kept).reshape(-1, corners.shape[1])


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
    nodes = np.argwhere(speed > LEAST_ARROW * top)
    nodes = nodes[:: -(-len(nodes) // MOST_ARROWS) or 1]
    vectors = velocity[tuple(nodes.T)] / top
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return nodes * spacing, _drawn(vectors, spacing), strain_colours(length.T, 1.0)[0]


def traction_arrows(
    places: np.ndarray, traction: np.ndarray, spacing: float, top: float
) -> tuple[np.ndarray, np.ndarray]:
    """Arrows at the surface points that a wall touches, the greatest about three cells long.

    Args:
        places: Of the points [m], shape (point, dim).
        traction: Of all walls [Pa], shape (wall, point, dim).
        top: Traction [Pa] drawn at full length.

    Returns:
        origins [m] and vectors [m], (arrow, dim).
    """
    total = traction.sum(0)
    touched = np.linalg.norm(total, axis=-1) > LEAST_ARROW * top
    return places[touched], _drawn(total[touched] / top, spacing)


def _drawn(vectors: np.ndarray, spacing: float) -> np.ndarray:
    """Arrows of the greatest length for vectors of length one and more."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors * (LONGEST * spacing / np.maximum(length, 1))


def frame_box(low: np.ndarray, high: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Part of the world worth looking at: where the robot was, and some room around it that is in the grid."""
    room = 0.12 * float((high - low).max())
    return (
        np.minimum(low, np.maximum(low - room, -0.02 * upper.max())),
        np.maximum(high, np.minimum(high + room, upper * 1.02)),
    )


def upward(gravity: np.ndarray) -> np.ndarray:
    """Unit vector that points up in pictures and in Rerun, shape (dim,): against gravity, or without any along axis 1, y."""
    size = float(np.linalg.norm(gravity))
    return -gravity / size if size else np.eye(len(gravity))[1]


def eye(low: np.ndarray, high: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Camera for a 3D box, a little from above: position and target [m]."""
    extent = high - low
    flat = [extent[i] if abs(up[i]) < 0.5 else np.inf for i in range(3)]
    front = np.eye(3)[int(np.argmin(flat))]  # look along the thinner horizontal axis, at the broad side
    right = np.cross(up, front)
    if right.sum() < 0:  # the other horizontal axis points to the right
        front, right = -front, -right
    direction = front + 0.4 * right + 0.45 * up
    target = (low + high) / 2
    return target + 1.1 * np.linalg.norm(extent) * direction / np.linalg.norm(direction), target
