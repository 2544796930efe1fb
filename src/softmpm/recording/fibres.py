"""Strokes along the fibres of muscles, which deform with the particles around them. NumPy only."""

import numpy as np

from softmpm.recording.surroundings import Surroundings, of_scene
from softmpm.scene.scene import Scene
from softmpm.validate import need

STROKES = 24
"""Number of strokes that follow each other along the longest side of a picture."""
LENGTH, RADIUS = 0.7, 0.025
"""Length at rest and half the width of a stroke, in distances between two."""
DARK, LIGHT = np.array((44, 44, 52), float), np.array((250, 250, 250), float)
"""Colours of strokes, on light and on dark particles."""
FILLED = 0.73
"""Distance from a particle up to which a dot is in its muscle, in √dim of its radii: half the diagonal of a lattice cell is 0.71."""
OUTSIDE = 0.6
"""Distance between a particle and the mean place of it and its neighbours from which on it is at the surface, in its radii. On a
lattice it is 0.84 at a plane, and one layer below at most 0.59, at a corner."""


def fibre_strokes(scene: Scene, positions: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Strokes along the fibres of muscles, for pictures of one's own; :func:`softmpm.show` draws the same.

    They deform with the particles around them. In 3D they are near the surface, on all sides.

    Args:
        positions: Of the particles [m], shape (particle, dim).
        gap: Distance between two strokes at rest [m].

    Returns:
        Both ends of each stroke [m], shape (stroke, 2, dim), not finite where particles around are not, and the particle in its middle,
        shape (stroke,).

    Raises:
        ValueError: The gap is not above 0, or positions are not those of the scene's particles.
    """
    place, x = of_scene(scene), np.asarray(positions, float)
    need(np.isfinite(gap) and gap > 0, f"gap must be > 0 m, got {gap}; good: a tenth of the robot.")
    need(
        x.shape == place.rest.shape,
        f"positions are those of one world, shape {place.rest.shape}, but have shape {x.shape}; take x[0] of a state.",
    )
    fibres = Fibres(place, gap)
    return fibres.ends(x), fibres.particle


class Fibres:
    """Strokes along the fibres of all muscles of a picture, each through the particle in its middle, as far as the muscle goes.

    Args:
        gap: Distance between two strokes [m].

    Attributes:
        particle: Particle in the middle of each stroke, shape (stroke,).
    """

    def __init__(self, place: Surroundings, gap: float):
        self._place, self.radius = place, RADIUS * gap
        seen = _outside(place) if place.dim == 3 else np.ones(len(place.rest), bool)
        count = 2 * int(np.ceil(LENGTH / (2 * RADIUS))) + 1  # dots overlap by a half
        shares, strokes = np.linspace(-0.5, 0.5, count)[:, None], [_none(count, place.dim)]
        for members, fibre in zip(place.muscle, place.fibre, strict=True):
            if fibre.any() and members.any():  # of few recorded particles a muscle may have none
                shown = members & seen if (members & seen).any() else members
                middle = _spread(place.rest, np.flatnonzero(shown), gap)
                line = place.rest[middle][:, None] + shares * LENGTH * gap * fibre / np.linalg.norm(fibre)
                strokes.append((middle, *_within(place, np.flatnonzero(members), line)))
        self.particle = np.concatenate([middle for middle, _, _ in strokes])
        carrier = np.concatenate([carrier for _, _, carrier in strokes])
        self._offset = np.concatenate([line for _, line, _ in strokes]) - place.rest[carrier]
        self._carriers, row = np.unique(carrier, return_inverse=True)
        self._row = row.reshape(carrier.shape)

    @np.errstate(invalid="ignore")  # the difference of two infinite positions is no number
    def dots(self, positions: np.ndarray) -> np.ndarray:
        """Rows of dots for strokes, which a picture sorts by depth as it does particles [m], shape (stroke, dot, dim), not finite where
        particles around are not."""
        gradient = self._gradient(positions)[self._row]
        return positions[self._carriers][self._row] + (gradient @ self._offset[..., None])[..., 0]

    @np.errstate(invalid="ignore")
    def ends(self, positions: np.ndarray, raised: float = 0.0) -> np.ndarray:
        """Both ends of each stroke [m], shape (stroke, 2, dim), not finite where particles around are not.

        Args:
            raised: Distance by which strokes stand away from the surface of a 3D body [m].
        """
        found = self.dots(positions)[:, [0, -1]]
        if not raised or self._place.dim == 2:
            return found
        outward = positions[self.particle] - positions[self._place.neighbours[self.particle]].mean(1)
        size = np.linalg.norm(outward, axis=-1, keepdims=True)
        return found + (raised * outward / np.maximum(size, 1e-12))[:, None]

    def _gradient(self, positions: np.ndarray) -> np.ndarray:
        """Deformation gradient around particles that carry dots: least squares over neighbours, and none along axes in which they have
        no extent."""
        near = self._place.neighbours[self._carriers]
        rest, now = (x[near] - x[self._carriers][:, None] for x in (self._place.rest, positions))
        inverse = np.linalg.pinv(np.swapaxes(rest, 1, 2) @ rest, rcond=1e-6, hermitian=True)
        flat = np.eye(self._place.dim) - np.swapaxes(rest, 1, 2) @ rest @ inverse
        return np.swapaxes(now, 1, 2) @ rest @ inverse + flat


def _none(count: int, dim: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """No stroke: particle in its middle, dots, and the particle nearest to each."""
    return np.empty(0, int), np.empty((0, count, dim)), np.empty((0, count), int)


def _within(place: Surroundings, members: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dots of strokes, shape (stroke, dot, dim), which end where the muscle of these particles ends, and the particle nearest to each.

    Dots beyond are where the last one inside is.
    """
    from scipy.spatial import KDTree

    distance, nearest = KDTree(place.rest[members]).query(line)
    inside = distance <= FILLED * np.sqrt(place.dim) * place.radii[members[nearest]]
    middle = line.shape[1] // 2
    last = middle + np.cumprod(inside[:, middle + 1 :], axis=1).sum(axis=1)
    first = middle - np.cumprod(inside[:, :middle][:, ::-1], axis=1).sum(axis=1)
    kept = np.clip(np.arange(line.shape[1]), first[:, None], last[:, None])
    carrier = members[np.take_along_axis(nearest, kept, axis=1)]
    return np.take_along_axis(line, kept[..., None], axis=1), carrier


def stroke_colours(rgb: np.ndarray) -> np.ndarray:
    """Colour of a stroke on each of these colours, shape (stroke, 3), 0 to 255: the one that can be told from it."""
    return np.where((rgb @ (0.3, 0.59, 0.11) > 110.0)[:, None], DARK, LIGHT)


def _outside(place: Surroundings) -> np.ndarray:
    """Particles at the surface of their body, shape (particle,), boolean."""
    own = np.arange(len(place.rest))[:, None]
    count = 1 + (place.neighbours != own).sum(1, keepdims=True)
    inward = (place.rest[place.neighbours] - place.rest[:, None]).sum(1) / count
    return np.linalg.norm(inward, axis=-1) > OUTSIDE * place.radii


def _spread(rest: np.ndarray, members: np.ndarray, gap: float) -> np.ndarray:
    """Particles among these, at least one, that are about this far apart: near the middles of cubes, those of full ones first."""
    x = rest[members]
    _, cube, count = np.unique(
        np.floor((x - x.mean(0)) / gap + 0.5), axis=0, return_inverse=True, return_counts=True
    )
    cube, found = cube.ravel(), []
    for k in np.argsort(-count, kind="stable"):
        inside = np.flatnonzero(cube == k)
        middle = inside[np.linalg.norm(x[inside] - x[inside].mean(0), axis=-1).argmin()]
        if all(np.linalg.norm(x[found] - x[middle], axis=-1) > LENGTH * gap):
            found.append(middle)
    return members[found]
