"""Every rule that needs a whole scene: bodies in the grid, muscles in the bodies, walls in reach, values in the precision.

Each message names the rule, the value received and a remedy. Rules of one object stand with its class.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch

from softmpm.scene.actuators import title
from softmpm.scene.check_mirrors import check_mirrors
from softmpm.scene.outline import Outline
from softmpm.scene.scene import Grid, Particles, Scene
from softmpm.validate import need

SAME = 1e-11
"""Distance within which two places in a cell are the same [cells]: the rounding of positions."""
SAME_PLACE = 1e-6
"""Two particles nearer than this share of a cell are one particle twice."""
FILLED = 0.9
"""Share of a box of two cells or more that two bodies must not both fill."""
OPEN = 0.05
"""Largest |Σ n A| of an outline as a share of its area; a cube without one face has 0.2, exact quadrature 0."""
MOST_WALLS = 64
"""Each one is compiled into the kernels of the grid, and its numbers are passed with every launch."""
MIXERS = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)
"""Odd numbers without a pattern, that sums of multiples of them seldom agree modulo 2^64."""


def check_scene(scene: Scene) -> None:
    """Raise ValueError with the first rule that the scene breaks, TypeError if it is none."""
    if not isinstance(scene, Scene):
        raise TypeError(f"a model is built from a softmpm.Scene, got {type(scene).__name__}.")
    _check_bodies(scene)
    _check_outlines(scene)
    _check_distinct(scene)
    if len(scene.bodies) > 1:
        _check_apart(scene)
    _check_muscles(scene)
    _check_indices("scene driven", np.asarray(scene.driven), scene)
    _check_walls(scene)
    check_mirrors(scene)


def least_damping(dt: float, dtype: torch.dtype) -> float:
    """Damping [1/s] below which rounding of the velocity in each substep changes its rate by more than 3 %, or stops it."""
    return 16 * torch.finfo(dtype).eps / dt


def check_precision(scene: Scene, dtype: torch.dtype) -> None:
    """Raise ValueError if rounding to ``dtype`` takes a value of the scene out of its bounds.

    What must not vanish has to be a normal number: below, digits are lost one after the other, and a mass of 0 does not move. That
    includes the stress at a strain of a rounding error.
    """
    real = np.dtype(str(dtype).removeprefix("torch.")).type
    least, most = float(np.finfo(real).tiny), float(np.finfo(real).max)
    strain = float(np.finfo(real).eps)

    def within(name: str, value: float, low: float, high: float) -> None:
        with np.errstate(over="ignore", under="ignore"):
            rounded = float(real(value))
        need(
            low <= rounded <= high,
            f"{name} of {value:.9g} is {rounded:.9g} in {dtype}, and must lie in [{low:.9g}, {high:.9g}] there; "
            + ("use dtype=torch.float64, or other units." if dtype == torch.float32 else "use other units."),
        )

    heaviest = max(b.material.density * float(np.max(b.particles.volume)) for b in scene.bodies)
    least_rate = least_damping(scene.dt, dtype)
    need(
        scene.damping == 0 or scene.damping >= least_rate,
        f"damping must be 0 or at least {least_rate:.3g} 1/s in {dtype} with dt={scene.dt:g} s, for less is lost in rounding, got "
        f"{scene.damping:g} 1/s; use {'dtype=torch.float64 or ' * (dtype == torch.float32)}damping=0.",
    )
    within("dt", scene.dt, least, most)
    within("grid spacing", scene.grid.spacing, least, most)
    for b, body in enumerate(scene.bodies):
        material, volume = body.material, np.asarray(body.particles.volume)
        ends = (float(volume.min()), float(volume.max()))
        for name in ("density", "young"):
            within(f"{name} of body {b}", getattr(material, name), least, most)
        half = float(np.nextafter(real(0.5), real(0)))
        within(f"poisson of body {b}", material.poisson, -2 * half, half)
        stress, about = material.young * strain, f"the stress of body {b} at a strain of {strain:.2g}"
        within(f"{about} [Pa]", stress, least, most)
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
            per_mass, by = value / heaviest, f"the smallest or largest volume of body {b} per unit of mass"
            within(f"{by} [m³/kg]", per_mass, least, most)
            within(f"{by} times dt [m³ s/kg]", scene.dt * per_mass, least, most)
            within(f"{about} times {by} [J/kg]", stress * per_mass, least, most)
    for m, muscle in enumerate(scene.muscles):
        within(f"strength of {title(muscle, m)}", muscle.strength, -most, most)
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
        outside = lacks_nodes(positions, grid)
        if outside.any():
            particle = int(np.argmax(outside))
            raise ValueError(
                f"body {b} leaves the grid: particle {particle} at {_tuple(positions[particle])} m, and "
                f"{outside.sum() - 1} more of its {len(positions)}; all must lie in {_room(grid)} m, "
                "so that the nodes around them exist. Move the body or enlarge the grid."
            )


def lacks_nodes(places: np.ndarray, grid: Grid) -> np.ndarray:
    """True for each place [m], shape (place, dim), without all 3^dim nodes around it; one midway between nodes has the upper ones."""
    base = places / grid.spacing - 0.5  # rounded down, the first of three nodes along each axis
    return np.asarray(((base < 0) | (base + SAME >= np.array(grid.shape) - 2)).any(axis=1))


def _room(grid: Grid) -> str:
    return " × ".join(f"[{0.5 * grid.spacing:.5g}, {(n - 1.5) * grid.spacing:.5g})" for n in grid.shape)


def _check_outlines(scene: Scene) -> None:
    for b, body in enumerate(scene.bodies):
        outline = body.particles.outline
        if outline is not None:
            _check_place(f"the outline of body {b}", outline, body.particles, scene.grid)
            _check_closed(f"the outline of body {b}", outline, body.particles)


def _check_place(name: str, outline: Outline, particles: Particles, grid: Grid) -> None:
    """In the grid, and around the particles: moving one without the other is an easy mistake."""
    reach = (np.array(grid.shape) - 1) * grid.spacing
    outside = ((outline.points < 0) | (outline.points > reach)).any(axis=1)
    if outside.any():
        point = int(np.argmax(outside))
        raise ValueError(
            f"{name} leaves the grid: point {point} at {_tuple(outline.points[point])} m, and {outside.sum() - 1} more of its "
            f"{len(outline)}; all must lie between the nodes, from 0 to {_tuple(reach)} m. Move the body or enlarge the grid."
        )
    slack = particles.spacing
    low, high = outline.points.min(axis=0) - slack, outline.points.max(axis=0) + slack
    beyond = ((particles.positions < low) | (particles.positions > high)).any(axis=1)
    if 2 * beyond.sum() > len(beyond):  # specks of a picture may be particles without an outline
        particle = int(np.argmax(beyond))
        raise ValueError(
            f"{name} must surround its particles, but particle {particle} at {_tuple(particles.positions[particle])} m and "
            f"{beyond.sum() - 1} more of {len(beyond)} lie beyond the outline, which spans {_tuple(low + slack)} to "
            f"{_tuple(high - slack)} m. Move both together, or leave the outline out."
        )


def _check_closed(name: str, outline: Outline, particles: Particles) -> None:
    """Closed, and around as much volume as the particles have.

    A lattice takes its cells as a whole, so that its surface may lie half a spacing s off the true one. For a box that changes
    the volume V to V (1 + s / 2h)^dim, h = dim V / A, and for other shapes by less.
    """
    area = float(outline.areas.sum())
    rest = float(np.linalg.norm(outline.areas @ outline.normals))
    need(
        rest <= OPEN * area,
        f"{name} must be closed: the sum of areas times normals has length {rest:.4g}, at most {OPEN:.0%} of its area of "
        f"{area:.4g} are allowed. Add the missing parts of the surface, with normals out of the body.",
    )
    inside, volume = outline.enclosed_volume, float(np.sum(particles.volume))
    need(inside > 0, f"{name} must have normals out of the body, got normals into it; use -normals.")
    room = (1 + 0.5 * particles.spacing * area / (outline.dim * inside)) ** outline.dim - 1
    need(
        abs(volume - inside) <= room * inside,
        f"{name} must enclose the volume of its particles, {volume:.4g}, to half a particle spacing along the surface, "
        f"got {inside:.4g} (± {room * inside:.2g} allowed). Give both in metres and each particle the volume of its cell, or "
        "leave the outline out: Particles(positions, volume).",
    )


def _check_distinct(scene: Scene) -> None:
    positions = scene.positions
    # An offset that no lattice has keeps two copies, equal up to rounding, on the same side of a bin's edge.
    bins = np.floor(positions / (SAME_PLACE * scene.grid.spacing) + 0.381966).astype(np.int64)
    order = _suspects(bins)
    order = order[np.lexsort(bins[order].T)]
    twice = (np.diff(bins[order], axis=0) == 0).all(axis=1)
    if twice.any():
        first = int(np.argmax(twice))
        i, j = sorted(order[first : first + 2].tolist())
        bodies = scene.body_index
        raise ValueError(
            f"particles {i} (body {bodies[i]}) and {j} (body {bodies[j]}) are at the same place, "
            f"{_tuple(positions[i])} m, and {twice.sum() - 1} more such pairs: bodies must not overlap. "
            "Move one, or keep only the particles that the other has not."
        )


def _check_apart(scene: Scene) -> None:
    """Raise ValueError for bodies that fill the same space: a box of two cells along each axis or, for shapes, of as many distances of
    their particles as reach two cells, so that their lattice fills it wherever it lies."""
    count, positions, dx = len(scene.bodies), scene.positions, scene.grid.spacing
    if count == 1:
        return
    volumes = np.concatenate([np.broadcast_to(b.particles.volume, len(b.particles)) for b in scene.bodies])
    shapes = [2.0 * dx if b.particles.outline is None else b.particles.spacing for b in scene.bodies]
    for spacing in {float(f"{length / dx:.6g}") for length in shapes}:  # [cells]
        edge = math.ceil(2.0 / spacing) * spacing * dx
        bins = np.floor(positions / edge + 0.381966).astype(np.int64)  # see _check_distinct
        numbers = np.ravel_multi_index(tuple(bins.T), tuple(bins.max(axis=0) + 1))
        parts, of_part = np.unique(numbers * count + scene.body_index, return_inverse=True)
        full = parts[np.bincount(of_part, volumes) >= FILLED * edge**scene.grid.dim]
        shared = np.flatnonzero(np.diff(full // count) == 0)
        if len(shared):
            one, other = (int(part % count) for part in full[shared[0] : shared[0] + 2])
            place = positions[np.argmax(numbers == full[shared[0]] // count)]
            raise ValueError(
                f"bodies {one} and {other} overlap: both fill the space around {_tuple(place)} m, whose mass would count twice; "
                "bodies must not overlap. Move one, or keep only the particles of one that lie outside the other."
            )


def _suspects(bins: np.ndarray) -> np.ndarray:
    """Rows that may equal another one: numbers made of the rows do. To sort these is far quicker than to sort the rows."""
    mixed = (bins.astype(np.uint64) * np.array(MIXERS[: bins.shape[1]], dtype=np.uint64)).sum(axis=1)
    ordered = np.sort(mixed)
    return np.flatnonzero(np.isin(mixed, ordered[1:][ordered[1:] == ordered[:-1]]))


def _check_muscles(scene: Scene) -> None:
    for m, muscle in enumerate(scene.muscles):
        _check_indices(title(muscle, m), muscle.particles, scene)
        direction = getattr(muscle, "direction", None)
        if direction is not None:
            _check_axes(f"{title(muscle, m)} direction", direction, scene.grid)


def _check_indices(name: str, particles: np.ndarray, scene: Scene) -> None:
    count = scene.particle_count
    low, high = particles.min(initial=0), particles.max(initial=0)
    need(
        low >= 0 and high < count,
        f"{name} names particle {low if low < 0 else high}, but the scene's {count} particles are "
        f"0 to {count - 1}, counted through the bodies in their order.",
    )


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
