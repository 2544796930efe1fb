"""Shapes to outlines: the surface of a box, an ellipsoid, a polygon or a triangle mesh as points with normals and areas.

One point for each spacing along a curve, and for each spacing² of a surface in 3D. With particles half a cell apart that
makes two points for each cell of a 2D outline and four for each face of a cell in 3D. Σ n A vanishes to rounding for each of them.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from softmpm.scene.outline import Outline


def box_outline(lower: np.ndarray, upper: np.ndarray, count: np.ndarray) -> Outline:
    """Sides or faces of a box: the outer faces of its lattice of ``count`` cells along each axis. Exact."""
    dim, step, parts = len(lower), (upper - lower) / count, []
    for axis in range(dim):
        others = [a for a in range(dim) if a != axis]
        along = [lower[a] + (np.arange(count[a]) + 0.5) * step[a] for a in others]
        middles = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, dim - 1)
        for end, sign in ((lower, -1), (upper, 1)):
            points, normals = np.empty((len(middles), dim)), np.zeros((len(middles), dim))
            points[:, others] = middles
            points[:, axis] = end[axis]
            normals[:, axis] = sign
            parts.append((points, normals, np.full(len(middles), step[others].prod())))
    points, normals, areas = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Outline(points, normals, areas)


def ball_outline(center: np.ndarray, radii: np.ndarray, spacing: float) -> Outline:
    """Ellipse in equal arcs, of exact length, or ellipsoid in bands of latitude.

    The ellipsoid is the image of a unit sphere under D = diag(radii), whose patches are exact; a patch of area A with normal n
    becomes one with area and normal det(D) D⁻¹ n A. Hence Σ A x·n / 3 is the exact volume whatever the spacing, the area of a
    sphere is exact, and that of an ellipsoid is accurate to spacing².
    """
    if len(radii) == 2:
        a, b = radii
        edges, middle = equal_arcs(a, b, spacing)
        on_circle = np.stack([np.cos(middle), np.sin(middle)], axis=-1)
        across = on_circle / radii
        normals = across / np.linalg.norm(across, axis=1, keepdims=True)
        return Outline(center + radii * on_circle, normals, np.diff(_arc(a, b, edges)))
    on_sphere, areas = _bands(radii, spacing)
    across = radii.prod() * on_sphere / radii
    length = np.linalg.norm(across, axis=1)
    return Outline(center + radii * on_sphere, across / length[:, None], length * areas)


def polygon_outline(polygons: Sequence[np.ndarray], spacing: float, corner: float = np.pi) -> Outline | None:
    """Closed polygons, the inside to the left, resampled in chords of about one spacing; None if there are none.

    Corners that turn by more than ``corner`` [rad] stay where they are; the default rounds all of them at the spacing, as suits the
    steps of a picture. Without such corners the resampled polygon of a shape that is its own mirror image, left to right, is so too.
    Islets and holes of less than a tenth of a lattice cell are left out.

    Points are the chords' middles, so that lengths, normals and the enclosed area are exactly those of the resampled polygons.
    """
    starts, ends = [], []
    for polygon in polygons:
        x, y = polygon.T
        if abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2 < 0.1 * spacing**2:
            continue
        sharp = np.flatnonzero(np.abs(_turns(polygon)) > corner)
        polygon = np.roll(polygon, -sharp[0], axis=0) if len(sharp) else _from_above(polygon)
        closed = np.concatenate([polygon, polygon[:1]])
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        fixed = [*arc[sharp - sharp[0]], arc[-1]] if len(sharp) else [0.0, arc[-1]]
        multiple = 1 if len(sharp) > 2 else 4
        parts = [
            np.linspace(a, b, multiple * max(1, round((b - a) / (multiple * spacing))), endpoint=False)
            for a, b in pairwise(fixed)
        ]
        places = np.concatenate([*parts, arc[-1:]])
        corners = np.stack([np.interp(places, arc, closed[:, axis]) for axis in (0, 1)], axis=-1)
        starts.append(corners[:-1])
        ends.append(corners[1:])
    if not starts:
        return None
    start, end = np.concatenate(starts), np.concatenate(ends)
    length = np.linalg.norm(end - start, axis=1)
    start, end, length = (values[length > 1e-6 * spacing] for values in (start, end, length))
    right = np.stack([(end - start)[:, 1], -(end - start)[:, 0]], axis=-1)
    return Outline((start + end) / 2, right / length[:, None], length)


def _from_above(polygon: np.ndarray) -> np.ndarray:
    """The polygon from the highest place halfway between its left and right ends, which its mirror image shares.

    An edge may lie along the middle, up to rounding: of its two ends the upper one counts.
    """
    x, (left, right) = polygon[:, 0], (polygon[:, 0].min(), polygon[:, 0].max())
    before = np.where(np.abs(2 * x - left - right) > 1e-9 * (right - left), x - (left + right) / 2, 0.0)
    after = np.roll(before, -1)
    met = np.flatnonzero(np.sign(before) != np.sign(after))
    share = before[met] / (before[met] - after[met])
    places = polygon[met] + share[:, None] * (np.roll(polygon, -1, axis=0) - polygon)[met]
    top = places[:, 1].argmax()
    return np.concatenate([places[top : top + 1], np.roll(polygon, -met[top] - 1, axis=0)])


def _turns(polygon: np.ndarray) -> np.ndarray:
    """Angle by which a closed polygon turns at each vertex [rad], in [−π, π]."""
    after = np.roll(polygon, -1, axis=0) - polygon
    angle = np.arctan2(after[:, 1], after[:, 0])
    return (angle - np.roll(angle, 1) + np.pi) % (2 * np.pi) - np.pi


def split_triangles(triangles: np.ndarray, spacing: float) -> np.ndarray:
    """Triangles (triangle, corner, 3) halved at their longest edge to areas of at most spacing² and edges of at most 2 spacings."""
    done = []
    while len(triangles):
        edges = np.roll(triangles, -1, axis=1) - triangles  # edge k joins the corners k and k + 1
        length = np.linalg.norm(edges, axis=2)
        area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
        large = (area > spacing**2 * (1 + 1e-9)) | (length.max(axis=1) > 2 * spacing * (1 + 1e-9))
        done.append(triangles[~large])
        triangles, longest = triangles[large], length[large].argmax(axis=1)
        row = np.arange(len(triangles))
        a, b, c = (triangles[row, (longest + k) % 3] for k in range(3))
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done) if done else triangles


def triangle_outline(triangles: np.ndarray) -> Outline:
    """Centroids, normals and areas of triangles whose corners turn left as seen from outside. Exact."""
    turned = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    twice = np.linalg.norm(turned, axis=1)
    flat = twice <= 1e-12 * twice.max(initial=0.0)
    triangles, turned, twice = triangles[~flat], turned[~flat], twice[~flat]
    return Outline(triangles.mean(axis=1), turned / twice[:, None], twice / 2)


def equal_arcs(a: float, b: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Angles t of (a cos t, b sin t) that cut an ellipse into equal arcs of about ``spacing``, and at the middle of each arc.

    Their number is a multiple of four, so that the arcs mirror themselves about both axes.
    """
    whole = float(_arc(a, b, 2 * np.pi))
    count = 4 * max(1, round(whole / (4 * spacing)))
    if a == b:
        angles = 2 * np.pi * np.arange(2 * count + 1) / (2 * count)
        return angles[::2], angles[1::2]
    want = np.arange(count // 2 + 1) / (2 * count) * whole  # the first quarter
    table = np.linspace(0.0, np.pi / 2, 16 * count + 1)
    angles = np.interp(want, _arc(a, b, table), table)
    for _ in range(4):
        slope = np.hypot(a * np.sin(angles), b * np.cos(angles))
        angles = np.clip(angles - (_arc(a, b, angles) - want) / slope, 0.0, np.pi / 2)
    angles[0], angles[-1] = 0.0, np.pi / 2
    half = np.concatenate([angles, np.pi - angles[-2::-1]])
    angles = np.concatenate([half, np.pi + half[1:]])
    return angles[::2], angles[1::2]


def _arc(a: float, b: float, angle: np.ndarray | float) -> np.ndarray:
    """Length of the arc of an ellipse from the angle 0: ∫ √(a² sin² t + b² cos² t) dt [m]."""
    from scipy.special import ellipeinc

    return b * ellipeinc(angle, 1.0 - (a / b) ** 2)


def _bands(radii: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and exact areas of patches of the unit sphere that become about spacing² large on the ellipsoid."""
    a, b, c = radii
    meridian, _ = equal_arcs(c, np.sqrt(a * b), spacing)
    height = np.cos(meridian[: len(meridian) // 2 + 1])  # from pole to pole
    points, areas = [], []
    for top, bottom in pairwise(height):
        z = (top + bottom) / 2
        width = np.sqrt(1.0 - z * z)
        edges, middle = equal_arcs(a * width, b * width, spacing)
        points.append(np.stack([width * np.cos(middle), width * np.sin(middle), np.full_like(middle, z)], -1))
        areas.append((top - bottom) * np.diff(edges))
    return np.concatenate(points), np.concatenate(areas)
