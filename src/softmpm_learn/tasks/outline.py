"""Drawing robots by code: smooth outlines, tapered limbs and feet, which ``softmpm.polygons`` fills; limbs are split for muscles.

All lengths are in metres unless a robot says otherwise; points are (x, y), y up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softmpm import inside


def smooth(points: Sequence, steps: int = 12) -> np.ndarray:
    """Closed Catmull-Rom curve through ``points``, shape (point · steps, 2)."""
    b = np.asarray(points, dtype=float)
    a, c, d = np.roll(b, 1, axis=0), np.roll(b, -1, axis=0), np.roll(b, -2, axis=0)
    t = np.linspace(0.0, 1.0, steps, endpoint=False)[:, None, None]
    return _catmull_rom(a, b, c, d, t).transpose(1, 0, 2).reshape(-1, b.shape[1])


def smooth_line(points: Sequence, steps: int = 12) -> np.ndarray:
    """Open Catmull-Rom curve through ``points``; further columns (a width) are blended along."""
    p = np.asarray(points, dtype=float)
    p = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = np.linspace(0.0, 1.0, steps, endpoint=False)[:, None, None]
    curve = _catmull_rom(p[:-3], p[1:-2], p[2:-1], p[3:], t).transpose(1, 0, 2).reshape(-1, p.shape[1])
    return np.concatenate([curve, p[-2:-1]])


def _catmull_rom(a, b, c, d, t):
    return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)


BEVEL = 0.27
"""Place of the edge between two facets on the way from the middle of the bevel to the corner: the three turns are then the same."""


def foot(outline: np.ndarray, edge: float) -> np.ndarray:
    """Region that a closed outline (point, 2) encloses above the floor y = 0, which cuts it once, with a flat sole and bevelled edges.

    A sharp edge that pushes the robot off carries the friction of its foot, and tears.

    Args:
        edge: Distance from a corner at which its bevel, of two facets, leaves the sole and the side [m].
    """
    ahead, above = np.roll(outline, -1, axis=0), []
    for a, b in zip(outline, ahead, strict=True):
        if a[1] > 0:
            above.append(a)
        if (a[1] > 0) != (b[1] > 0):
            above.append(a + (b - a) * a[1] / (a[1] - b[1]))
    ring = np.array(above)
    on_floor = np.isclose(ring[:, 1], 0.0, atol=1e-12)
    last = int(np.flatnonzero(on_floor & np.roll(on_floor, 1))[0])
    ring = np.roll(ring, -last, axis=0)  # up one side of the foot and down the other
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])

    def bevel(corner: np.ndarray, sole: np.ndarray, leave: float) -> np.ndarray:
        """From the sole, towards its other end, to the place on the side that is ``leave`` along the ring."""
        start = corner + edge * (sole - corner) / np.linalg.norm(sole - corner)
        end = np.array([np.interp(leave, way, axis) for axis in ring.T])
        middle = (start + end) / 2 + BEVEL * (corner - (start + end) / 2)
        return np.array([start, middle, end])

    up, down = bevel(ring[0], ring[-1], edge), bevel(ring[-1], ring[0], way[-1] - edge)
    return np.concatenate([up, ring[(way > edge) & (way < way[-1] - edge)], down[::-1]])


HALVES = {1: "front", -1: "back"}
"""Names of the two sides of a limb that hangs down from a robot that faces right, whose left side is then the front."""


@dataclass(frozen=True, eq=False)
class Limb:
    """A stroke of changing width along a line: a leg, a trunk, an arm."""

    line: np.ndarray
    """Points from the root to the tip, shape (point, 2)."""
    width: np.ndarray
    """Full width at each point, shape (point,)."""
    round_tip: bool = False

    @property
    def _frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit tangent and left-hand normal at each point."""
        tangent = np.gradient(self.line, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        return tangent, np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)

    def outline(self) -> np.ndarray:
        """Closed polygon around the limb, shape (point, 2)."""
        tangent, normal = self._frame
        half = self.width[:, None] / 2
        angle = np.linspace(0.0, np.pi, 13)[1:-1, None] if self.round_tip else np.empty((0, 1))
        tip = self.line[-1] + half[-1] * (np.cos(angle) * normal[-1] + np.sin(angle) * tangent[-1])
        return np.concatenate([self.line + half * normal, tip, (self.line - half * normal)[::-1]])

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of points: position along the limb, 0 at the root and 1 at the tip, and offset to the left of its line [m]."""
        start, step = self.line[:-1], np.diff(self.line, axis=0)
        length = np.linalg.norm(step, axis=1)
        share = ((points[:, None] - start) * step).sum(-1) / length**2
        offset = points[:, None] - start - np.clip(share, 0.0, 1.0)[..., None] * step
        nearest = np.linalg.norm(offset, axis=-1).argmin(axis=1)
        row = np.arange(len(points))
        along = (np.cumsum(length) - length)[nearest] + np.clip(share[row, nearest], 0.0, 1.0) * length[
            nearest
        ]
        left = step[nearest, 0] * offset[row, nearest, 1] - step[nearest, 1] * offset[row, nearest, 0]
        return along / length.sum(), left / length[nearest]

    def direction(self, start: float, end: float) -> tuple[float, ...]:
        """Unit vector from one place along the limb to another, both in [0, 1]."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.line, axis=0), axis=1))])
        along /= along[-1]
        first, last = (np.array([np.interp(t, along, axis) for axis in self.line.T]) for t in (start, end))
        return tuple((last - first) / np.linalg.norm(last - first))

    def part(self, points: np.ndarray, start: float, end: float, side: int = 0) -> np.ndarray:
        """Indices of the points of a piece of the limb; ``side`` 1 keeps its left half, -1 its right."""
        of_limb = np.flatnonzero(inside(points, self.outline()))
        along, left = self.locate(points[of_limb])
        chosen = (along >= start) & (along < end)
        return of_limb[chosen if side == 0 else chosen & (np.sign(left) == side)]


def legs(ends: Mapping[str, tuple], shape: np.ndarray) -> dict[str, Limb]:
    """Straight legs by name.

    Args:
        ends: Hip and sole of each, x and y.
        shape: Way down from the hip, 1 at the sole, and width there, shape (place, 2).
    """
    way, width = shape.T
    return {
        name: Limb(np.array(hip) + way[:, None] * np.subtract(sole, hip), width)
        for name, (hip, sole) in ends.items()
    }
