"""Rules of the walls that reflect: where a clamp or a plane of symmetry may lie, and where bodies begin.

Derivation of what they need: docs/math/mirror.md.
"""

import itertools
from typing import NamedTuple

import numpy as np

from softmpm.scene.scene import MIRRORS, Scene
from softmpm.validate import need

EXACT = 1e-6
"""Distance from a node or a plane below which a place counts as on it [cells]."""
FLUSH = 0.05
"""Distance of a face from the plane that holds it, at most [particle spacings]: 1.4 % of the deflection of a beam of 32 × 4 particles.
The chords of a curved outline, and the rounding of meshes, stay within it."""


class Mirror(NamedTuple):
    """Plane of a wall that reflects."""

    wall: int
    axis: int
    side: int
    """1 if bodies lie above the plane along the axis, -1 if below."""
    twice: int
    """Coordinate of the plane on the axis, in half cells."""
    held: tuple[bool, ...]
    """Components of the displacement that are zero in the plane."""


def mirrors_of(scene: Scene) -> list[Mirror]:
    """The walls of a scene that reflect.

    Raises:
        ValueError: The plane of one is oblique, or off the nodes and off the middle between them.
    """
    found, dx, dim = [], scene.grid.spacing, scene.grid.dim
    for k, wall in enumerate(scene.walls):
        if wall.contact not in MIRRORS:
            continue
        axis = int(np.argmax(np.abs(wall.normal)))
        across = np.delete(wall.normal, axis)
        need(
            bool((np.abs(across) < EXACT).all()),
            f"wall {k} is a {wall.contact}, which needs a normal along an axis of the grid, got {wall.normal}; turn the scene so that "
            "it is, or take contact='stick' or 'slip'.",
        )
        side = 1 if wall.normal[axis] > 0 else -1
        place = side * wall.offset / dx
        twice = round(2 * place)
        need(
            abs(2 * place - twice) < 2 * EXACT,
            f"wall {k} is a {wall.contact}, which must lie on nodes or midway between them, got x[{axis}] = {side * wall.offset:.6g} "
            f"m, {place:.6g} cells of {dx:.6g} m; move wall and bodies to {0.5 * twice * dx:.6g} m.",
        )
        held = [wall.contact == "clamp" or other == axis for other in range(dim)]
        found.append(Mirror(k, axis, side, twice, tuple(held)))
    return found


def check_mirrors(scene: Scene) -> None:
    """Raise ValueError unless bodies begin at the planes of all clamps and symmetries, and lie in front of them."""
    mirrors, dx = mirrors_of(scene), scene.grid.spacing
    for one in mirrors:
        kind, least, nearest = scene.walls[one.wall].contact, np.inf, np.inf
        plane = 0.5 * one.twice * dx
        for body in scene.bodies:
            heights = one.side * (body.particles.positions[:, one.axis] - plane)
            spacing = body.particles.spacing
            least, nearest = min(least, heights.min()), min(nearest, heights.min() / spacing)
        need(
            least > EXACT * dx,
            f"wall {one.wall} is a {kind}, at whose plane bodies begin, but a particle lies {-least:.4g} m behind the plane "
            f"x[{one.axis}] = {plane:.6g} m; cut the body off there, or take contact='stick', which holds what is inside.",
        )
        need(
            nearest < 1.0,
            f"wall {one.wall} is a {kind}, at whose plane a body begins, but the nearest particle is {least:.4g} m in front of the "
            f"plane x[{one.axis}] = {plane:.6g} m, {nearest:.3g} particle spacings; move wall or body so that they touch.",
        )
        _check_faces(scene, one)
        _check_gaps(scene, one)
    for a in mirrors:
        for b in mirrors:
            if a.wall < b.wall and a.axis == b.axis:
                need(
                    a.side != b.side,
                    f"walls {a.wall} and {b.wall} reflect and face the same way, but bodies begin at the plane of each; leave one out.",
                )
                need(
                    a.side * (b.twice - a.twice) >= 2,
                    f"walls {a.wall} and {b.wall} reflect and face each other at {0.5 * abs(b.twice - a.twice):g} cells, and need one "
                    "cell between them; use a finer grid.",
                )


def _check_faces(scene: Scene, mirror: Mirror) -> None:
    """Raise ValueError for a body that reaches the plane although its outline does not begin there."""
    plane, axis = 0.5 * mirror.twice * scene.grid.spacing, mirror.axis
    for b, body in enumerate(scene.bodies):
        outline = body.particles.outline
        spacing = body.particles.spacing
        nearest = (mirror.side * (body.particles.positions[:, axis] - plane)).min()
        if outline is None or nearest >= spacing:
            continue
        face = float((mirror.side * (outline.points[:, axis] - plane)).min())
        shift = [0.0] * scene.grid.dim
        shift[axis] = float(f"{-mirror.side * face:.6g}")
        kind, where = scene.walls[mirror.wall].contact, "in front of" if face > 0 else "behind"
        need(
            abs(face) <= FLUSH * spacing,
            f"wall {mirror.wall} is a {kind}, at whose plane a body begins, but the outline of body {b} begins {abs(face):.4g} m "
            f"{where} the plane x[{axis}] = {plane:.6g} m, {abs(face) / spacing:.3g} particle spacings; move the body there: "
            f"particles.moved({tuple(shift)}).",
        )


def _check_gaps(scene: Scene, mirror: Mirror) -> None:
    """Raise ValueError for a particle that shares nodes with the images behind the plane although nothing joins it to the plane."""
    dx, axis = scene.grid.spacing, mirror.axis
    # Distance from which on a particle reaches no node on the plane or with an image behind it [cells]:
    reach = 1.5 if mirror.twice % 2 == 0 else 1.0
    x = scene.positions / dx
    spacing = np.concatenate([np.full(len(b.particles), b.particles.spacing) for b in scene.bodies])
    heights = mirror.side * (x[:, axis] - 0.5 * mirror.twice)
    near = np.flatnonzero(heights < reach - EXACT)
    columns = np.floor(np.delete(x[near], axis, axis=1)).astype(int)  # of cells along the normal
    joined = np.zeros(len(near), bool)
    at_plane = _numbers(columns[heights[near] < (1.0 - EXACT) * spacing[near] / dx])
    for step in itertools.product((-1, 0, 1), repeat=columns.shape[1]):
        joined |= np.isin(_numbers(columns + step), at_plane)
    apart = near[~joined]
    if len(apart):
        p, wall = apart[np.argmin(heights[apart])], scene.walls[mirror.wall]
        need(
            False,
            f"wall {mirror.wall} is a {wall.contact}, which holds what lies less than {reach:g} cells in front of it, but particle {p} "
            f"lies {heights[p] * dx:.4g} m in front of the plane, with nothing between; let the body reach the plane there, or "
            f"leave at least {reach * dx:.4g} m.",
        )


def _numbers(columns: np.ndarray) -> np.ndarray:
    """A number for each column of cells, shape (column,)."""
    return columns @ (2 ** (20 * np.arange(columns.shape[1])))
