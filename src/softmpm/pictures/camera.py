"""Perspective view of a 3D scene: places in the picture, sizes, order and shading. NumPy only."""

import itertools

import numpy as np

from softmpm.recording import style
from softmpm.recording.surroundings import Surroundings

AMBIENT = 0.6
"""Brightness of a surface that is turned away from the light."""


class Camera:
    """Pinhole camera a little above a box, from which lengths in the picture are those at the centre of the box [m].

    Attributes:
        position: Of the pinhole [m], shape (3,).
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, up: np.ndarray):
        self.position, target = style.eye(low, high, up)
        forward = target - self.position
        self._distance = float(np.linalg.norm(forward))
        forward = forward / self._distance
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        self._axes = np.stack([right, np.cross(right, forward), forward])
        light = self._axes.T @ np.array([-0.45, 0.75, -0.8])  # from the upper left, behind the camera
        self._light = light / np.linalg.norm(light)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Place of points (point, 3) in the picture (point, 2), and magnification (point,): larger is nearer."""
        across, above, depth = self._axes @ (points - self.position).T
        scale = self._distance / np.maximum(depth, 0.05 * self._distance)
        return np.stack([across * scale, above * scale], -1), scale

    def nearer(self, points: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Points (…, 3), moved towards the camera by a distance (…, 1) [m]."""
        way = self.position - points
        return points + distance * way / np.linalg.norm(way, axis=-1, keepdims=True)

    def shading(self, place: Surroundings, positions: np.ndarray) -> np.ndarray:
        """Brightness of each particle (particle,): Lambert's law."""
        cosine = _outward(place, positions) @ self._light
        return AMBIENT + (1.0 - AMBIENT) * np.clip(cosine, 0.0, 1.0)

    @np.errstate(invalid="ignore")
    def sees(self, place: Surroundings, positions: np.ndarray) -> np.ndarray:
        """True for particles at faces that are turned to the camera, shape (particle,)."""
        return (_outward(place, positions) * (self.position - positions)).sum(-1) > 0.0

    def frame(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the picture that contains a box."""
        corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
        places, _ = self.project(corners)
        return places.min(0), places.max(0)


@np.errstate(invalid="ignore")  # the difference of two infinite positions is no number
def _outward(place: Surroundings, positions: np.ndarray) -> np.ndarray:
    """Unit vector from the centre of the neighbours of each particle to it, the normal of the surface there, shape (particle, dim)."""
    outward = positions - positions[place.neighbours].mean(1)
    return outward / np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-12)


def tiles(outline: np.ndarray, gap: float) -> np.ndarray:
    """Lines across a convex polygon in space, along and across its longest edge, at multiples of ``gap`` [m]; shape (line, 2, 3)."""
    edges = np.roll(outline, -1, axis=0) - outline
    along = edges[np.linalg.norm(edges, axis=1).argmax()]
    along = along / np.linalg.norm(along)
    normal = np.cross(edges[0], edges[1])
    lines = []
    for axis in (along, np.cross(normal / np.linalg.norm(normal), along)):
        axis = axis * np.sign(axis[np.abs(axis).argmax()])
        heights = outline @ axis
        for level in np.arange(np.ceil(heights.min() / gap), np.floor(heights.max() / gap) + 1) * gap:
            cut = _crossings(outline, heights - level)
            if len(cut) == 2:
                lines.append(cut)
    return np.array(lines).reshape(-1, 2, 3)


def _crossings(outline: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Places where a polygon's edges change side."""
    after, far = np.roll(side, -1), np.roll(outline, -1, axis=0)
    change = (side >= 0) != (after >= 0)
    share = side[change] / (side[change] - after[change])
    return outline[change] + share[:, None] * (far[change] - outline[change])


def round_length(extent: float) -> float:
    """The largest of 1, 2, 5 · 10ⁿ that is at most a fifth of an extent."""
    return round_below(extent / 5)


def round_below(most: float) -> float:
    """The largest of 1, 2, 5 · 10ⁿ that is at most this."""
    unit = 10.0 ** np.floor(np.log10(most))
    return float(unit * max(step for step in (1, 2, 5) if step * unit <= most * (1 + 1e-9)))
