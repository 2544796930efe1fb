"""Every rule that needs a whole scene: bodies in the grid, muscles in the bodies, walls in reach, values in the precision.

Each message names the rule, the value received and a remedy. Rules of one object stand in ``scene.py``.
"""

from collections.abc import Sequence

import numpy as np
import torch

from softmpm.scene.scene import Actuator, Grid, Scene
from softmpm.validate import need

SAME_PLACE = 1e-6
"""Two particles nearer than this share of a cell are one particle twice."""
MOST_WALLS = 64
"""Each one is compiled into the kernels of the grid, and its numbers are passed with every launch."""
MIXERS = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)
"""Odd numbers without a pattern, that sums of multiples of them seldom agree modulo 2^64."""


def check_scene(scene: Scene) -> None:
    """Raise ValueError with the first rule that the scene breaks, TypeError if it is none."""
    if not isinstance(scene, Scene):
        raise TypeError(f"a model is built from a softmpm.Scene, got {type(scene).__name__}.")
    _check_bodies(scene)
    _check_distinct(scene)
    _check_muscles(scene)
    _check_indices("scene driven", np.asarray(scene.driven), scene)
    _check_walls(scene)


def check_precision(scene: Scene, dtype: torch.dtype) -> None:
    """Raise ValueError if rounding to ``dtype`` takes a value of the scene out of its bounds.

    What must not vanish has to be a normal number: below, digits are lost one after the other, and a mass of 0 does not move.
    """
    real = np.dtype(str(dtype).removeprefix("torch.")).type
    least, most = float(np.finfo(real).tiny), float(np.finfo(real).max)

    def within(name: str, value: float, low: float, high: float) -> None:
        with np.errstate(over="ignore", under="ignore"):
            rounded = float(real(value))
        need(
            low <= rounded <= high,
            f"{name} of {value:.9g} is {rounded:.9g} in {dtype}, and must lie in [{low:.9g}, {high:.9g}] there; "
            + ("use dtype=torch.float64, or other units." if dtype == torch.float32 else "use other units."),
        )

    heaviest = max(b.material.density * float(np.max(b.particles.volume)) for b in scene.bodies)
    within("dt", scene.dt, least, most)
    within("grid spacing", scene.grid.spacing, least, most)
    for b, body in enumerate(scene.bodies):
        material, volume = body.material, np.asarray(body.particles.volume)
        ends = (float(volume.min()), float(volume.max()))
        for name in ("density", "young"):
            within(f"{name} of body {b}", getattr(material, name), least, most)
        half = float(np.nextafter(real(0.5), real(0)))
        within(f"poisson of body {b}", material.poisson, -2 * half, half)
        if material.viscosity > 0:
            within(f"viscosity of body {b}", material.viscosity, least, most)
        for value in ends:
            within(f"the smallest or largest volume [m³] of body {b}", value, least, most)
            within(f"the smallest or largest mass [kg] of body {b}", material.density * value, least, most)
            within(
                f"the smallest mass of body {b} over the largest of all",
                material.density * value / heaviest,
                least,
                most,
            )
            within(
                f"the smallest or largest volume of body {b} per unit of mass [m³/kg]",
                value / heaviest,
                least,
                most,
            )
    for m, muscle in enumerate(scene.muscles):
        within(f"strength of {_kind(muscle)} {m}", muscle.strength, -most, most)
    for axis, gravity in enumerate(scene.gravity or ()):
        within(f"gravity along axis {axis}", gravity, -most, most)
    for w, wall in enumerate(scene.walls):
        within(f"friction of wall {w}", wall.friction, 0.0, most)
        within(f"offset of wall {w}", wall.offset, -most, most)


def _check_bodies(scene: Scene) -> None:
    grid = scene.grid
    for b, body in enumerate(scene.bodies):
        positions = body.particles.positions
        need(
            positions.shape[1] == grid.dim,
            f"body {b} has {positions.shape[1]}D particles, but the grid {grid.shape} has {grid.dim} axes; "
            "make both 2D or both 3D.",
        )
        base = np.floor(positions / grid.spacing - 0.5)  # first of the three nodes that a particle reaches
        outside = ((base < 0) | (base > np.array(grid.shape) - 3)).any(axis=1)
        if outside.any():
            particle = int(np.argmax(outside))
            raise ValueError(
                f"body {b} leaves the grid: particle {particle} at {_tuple(positions[particle])} m, and "
                f"{outside.sum() - 1} more of its {len(positions)}; all must lie in {_room(grid)} m, "
                "so that the nodes around them exist. Move the body or enlarge the grid."
            )


def _room(grid: Grid) -> str:
    return " × ".join(f"[{0.5 * grid.spacing:.5g}, {(n - 1.5) * grid.spacing:.5g})" for n in grid.shape)


def _check_distinct(scene: Scene) -> None:
    positions = np.concatenate([body.particles.positions for body in scene.bodies])
    # An offset that no lattice has keeps two copies, equal up to rounding, on the same side of a bin's edge.
    bins = np.floor(positions / (SAME_PLACE * scene.grid.spacing) + 0.381966).astype(np.int64)
    order = _suspects(bins)
    order = order[np.lexsort(bins[order].T)]
    twice = (np.diff(bins[order], axis=0) == 0).all(axis=1)
    if twice.any():
        first = int(np.argmax(twice))
        i, j = sorted(order[first : first + 2].tolist())
        bodies = np.repeat(np.arange(len(scene.bodies)), [len(body.particles) for body in scene.bodies])
        raise ValueError(
            f"particles {i} (body {bodies[i]}) and {j} (body {bodies[j]}) are at the same place, "
            f"{_tuple(positions[i])} m, and {twice.sum() - 1} more such pairs: bodies must not overlap. "
            "Move one, or keep only the particles that the other has not."
        )


def _suspects(bins: np.ndarray) -> np.ndarray:
    """Rows that may equal another one: numbers made of the rows do. To sort these is far quicker than to sort the rows."""
    mixed = (bins.astype(np.uint64) * np.array(MIXERS[: bins.shape[1]], dtype=np.uint64)).sum(axis=1)
    ordered = np.sort(mixed)
    return np.flatnonzero(np.isin(mixed, ordered[1:][ordered[1:] == ordered[:-1]]))


def _check_muscles(scene: Scene) -> None:
    for m, muscle in enumerate(scene.muscles):
        _check_indices(f"{_kind(muscle)} {m}", muscle.particles, scene)
        direction = getattr(muscle, "direction", None)
        if direction is not None:
            _check_axes(f"muscle {m} direction", direction, scene.grid)


def _check_indices(name: str, particles: np.ndarray, scene: Scene) -> None:
    count = sum(len(body.particles) for body in scene.bodies)
    low, high = particles.min(initial=0), particles.max(initial=0)
    need(
        low >= 0 and high < count,
        f"{name} names particle {low if low < 0 else high}, but the scene's {count} particles are "
        f"0 to {count - 1}, counted through the bodies in their order.",
    )


def _kind(actuator: Actuator) -> str:
    return type(actuator).__name__.lower()


def _check_walls(scene: Scene) -> None:
    grid = scene.grid
    need(
        len(scene.walls) <= MOST_WALLS,
        f"a scene has at most {MOST_WALLS} walls, since each is compiled into its kernels; got {len(scene.walls)}. "
        "Leave out those that no body reaches.",
    )
    for w, wall in enumerate(scene.walls):
        _check_axes(f"wall {w} normal", wall.normal, grid)
        # n·x along the grid's edges:
        reach = np.array(wall.normal) * (np.array(grid.shape) - 1) * grid.spacing
        low, high = np.minimum(reach, 0.0).sum(), np.maximum(reach, 0.0).sum()
        need(
            low <= wall.offset,
            f"wall {w} covers no node: n·x ≤ {wall.offset:.5g} m, but n·x is {low:.5g} to {high:.5g} m "
            "on the grid, so it would do nothing. Move it into the grid or leave it out.",
        )
        need(
            wall.offset < high,
            f"wall {w} covers every node: n·x ≤ {wall.offset:.5g} m, and n·x is {low:.5g} to {high:.5g} m "
            "on the grid. Its normal must point out of the wall, into the free space.",
        )


def _check_axes(name: str, vector: Sequence[float], grid: Grid) -> None:
    need(
        len(vector) == grid.dim,
        f"{name} needs {grid.dim} numbers, one per axis of the grid, got {_tuple(vector)}.",
    )


def _tuple(values: np.ndarray | Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.5g}" for value in values) + ")"
