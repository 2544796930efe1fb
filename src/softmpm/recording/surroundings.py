"""The constant part of a picture: grid, walls, sizes of the particles, bodies and actuators. NumPy only."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from softmpm.recording import style
from softmpm.recording.reader import Recording
from softmpm.scene.scene import Scene

REACH, NEIGHBOURS = 3.2, 64
"""Distance in radii, and most number, of the particles whose mean place gives the outward direction at a particle: on a lattice 57."""
SHOWN_DEPTH = 0.06
"""Depth of a wall in the picture, in sizes of the bodies."""


@dataclass(frozen=True)
class Surroundings:
    """Everything in a picture that does not move, of a scene or of a recording."""

    rest: np.ndarray
    """Rest positions [m], shape (particle, dim)."""
    radii: np.ndarray
    """Radius of each particle's dot [m], shape (particle,)."""
    body: np.ndarray
    """Index of each particle's body, shape (particle,)."""
    muscle: np.ndarray
    """Membership of each actuator, shape (muscle, particle), boolean."""
    fibre: np.ndarray
    """Fibre direction of each actuator at rest [-], shape (muscle, dim); zero of one without fibres, such as a pressure."""
    actuators: tuple[str, ...]
    """Label of each actuator."""
    driven: np.ndarray
    """Driven particles, shape (particle,), boolean; a recording does not contain them."""
    normals: np.ndarray
    """Of the walls, shape (wall, dim)."""
    offsets: np.ndarray
    """Of the walls [m], shape (wall,)."""
    contacts: tuple[bytes, ...]
    """Kind of each wall."""
    spacing: float
    """Of the grid [m]."""
    upper: np.ndarray
    """The grid reaches from 0 to here [m], shape (dim,)."""
    gravity: np.ndarray
    """[m/s²], shape (dim,)."""

    @property
    def dim(self) -> int:
        return self.rest.shape[1]

    @property
    def up(self) -> np.ndarray:
        """Unit vector that points up in the picture, shape (dim,)."""
        return style.upward(self.gravity)

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Particles of the same body near each one at rest, shape (particle, neighbour); itself where there are fewer."""
        from scipy.spatial import KDTree

        found = np.repeat(np.arange(len(self.rest))[:, None], NEIGHBOURS, axis=1)
        reach = REACH * float(self.radii.max())
        for body in np.unique(self.body):
            own = np.flatnonzero(self.body == body)
            tree = KDTree(self.rest[own])
            near = tree.query(self.rest[own], k=NEIGHBOURS, distance_upper_bound=reach)[1]
            found[own] = np.where(near < len(own), own[np.minimum(near, len(own) - 1)], own[:, None])
        return found

    def window(
        self, positions: np.ndarray, normals: np.ndarray, offsets: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Box to frame [m]: around some positions (…, dim), as far as the grid goes, with those of these walls that are near."""
        x = positions.reshape(-1, self.dim)
        x = x[np.isfinite(x).all(-1)]
        x = self.rest if len(x) == 0 else x
        low, high = x.min(0) - self.radii.max(), x.max(0) + self.radii.max()
        size = float((high - low).max())
        for normal, offset in zip(normals, offsets, strict=True):
            gap = float((x @ normal).min()) - offset
            if gap < size:
                reach = max(gap, 0.0) + SHOWN_DEPTH * size
                low = np.minimum(low, x.min(0) - reach * np.maximum(normal, 0.0))
                high = np.maximum(high, x.max(0) + reach * np.maximum(-normal, 0.0))
        return style.frame_box(low, high, self.upper)


def of_scene(scene: Scene) -> Surroundings:
    """Surroundings in a scene."""
    parts = [body.particles for body in scene.bodies]
    count = [len(part) for part in parts]
    dim, every = scene.grid.dim, sum(count)
    fibre = np.array([getattr(one, "direction", (0.0,) * dim) for one in scene.muscles], float)
    muscle = np.zeros((len(scene.muscles), every), bool)
    for row, actuator in zip(muscle, scene.muscles, strict=True):
        row[actuator.particles] = True
    driven = np.zeros(every, bool)
    driven[np.asarray(scene.driven, dtype=np.int64)] = True
    return Surroundings(
        rest=np.concatenate([part.positions for part in parts]),
        radii=style.radii(np.concatenate([part.volume for part in parts]), 1.0, dim),
        body=np.repeat(np.arange(len(parts)), count),
        muscle=muscle,
        fibre=fibre.reshape(-1, dim),
        actuators=scene.muscle_names,
        driven=driven,
        normals=np.array([wall.normal for wall in scene.walls]).reshape(-1, dim),
        offsets=np.array([wall.offset for wall in scene.walls], float),
        contacts=tuple(wall.contact.encode() for wall in scene.walls),
        spacing=scene.grid.spacing,
        upper=(np.array(scene.grid.shape) - 1) * scene.grid.spacing,
        gravity=np.array(scene.gravity, float),
    )


def of_recording(recording: Recording) -> Surroundings:
    """Surroundings in a recording."""
    static, dim = recording.static, recording.dim
    return Surroundings(
        rest=static["positions"].astype(float),
        radii=style.radii(static["volume"].astype(float), recording.share, dim),
        body=static["body"],
        muscle=static["muscle"].astype(bool),
        fibre=static["muscle_direction"].astype(float),
        actuators=recording.muscle_names,
        driven=np.zeros(recording.particle_count, bool),
        normals=static["wall_normal"].astype(float),
        offsets=static["wall_offset"].astype(float),
        contacts=tuple(static["wall_contact"].tolist()),
        spacing=recording.spacing,
        upper=(static["grid_shape"] - 1) * recording.spacing,
        gravity=static["gravity"].astype(float),
    )
