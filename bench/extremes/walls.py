"""Extremes of moving walls: a floor that rises, tilts, or whose surface moves as a conveyor belt does."""

from collections.abc import Callable

import numpy as np

import softmpm

from . import bodies
from .bodies import DX, FLOOR, NODES, WAVE
from .cells import BODY, ENERGY, Case, Criterion, CriterionError, How, Run, not_crushed, play, short, whole
from .loads import PRESSURE_WAVE
from .rows import Row

DEPTH = 1.5
"""Largest depth of a particle below the surface of a wall [cells]; all nodes near a deeper one are inside the wall."""
ARM = 10
"""Distance of the axis of a tilting floor from the middle of the block [cells]."""
LARGEST_ANGLE = np.pi / 3
Pose = Callable[[float], tuple[np.ndarray, float]]
"""Normal and offset [m] of a wall as a function of the number of substeps."""


def boosted(velocity: np.ndarray) -> Criterion:
    """Energy in the frame that moves with the wall, where it does no work, at most that of the start.

    Five per cent are allowed, of that energy or of the energy at rest and the work of the wall, whichever is less.
    """

    def criterion(run: Run) -> None:
        start, now = (run.matter.energy(state).mechanical for state in (run.start, run.now))
        momentum = run.matter.momentum(run.start)
        work = velocity @ (run.matter.momentum(run.now) - momentum)
        moving = start - velocity @ momentum + run.matter.mass.sum() * velocity @ velocity / 2
        most = start + work + (ENERGY - 1) * min(moving, start + abs(work))
        if not now <= most:
            raise CriterionError(f"E ×{short(now / most)}" if most > 0 else "E > 0")

    return criterion


def rubs(run: Run) -> None:
    """The tangential impulse is at most the normal one, for a coefficient of friction of 1."""
    impulse = run.matter.momentum(run.now) - run.matter.momentum(run.start)
    normal, tangential = impulse[1], np.linalg.norm(np.delete(impulse, 1))
    if not tangential <= 1.001 * normal:
        raise CriterionError(f"drag ×{short(tangential / normal)}" if normal > 0 else "drag > 0")


def tilted(pivot: np.ndarray, rate: float) -> Criterion:
    """Energy of a body pushed by a frictionless floor that turns about ``pivot`` at ``rate`` [rad/s].

    Its force f n does the work ∫ f u dt ≤ u ∫ f dt with the largest speed u of the surface at the body, and the momentum along the
    mean normal is ∫ f n·n̄ dt ≥ cos(angle / 2) ∫ f dt.
    """
    half = LARGEST_ANGLE / 2
    mean = np.array([-np.sin(half), np.cos(half)])
    fastest = [0.0]

    def criterion(run: Run) -> None:
        reach = max(np.linalg.norm(state.x[:, :2] - pivot, axis=1).max() for state in (run.start, run.now))
        fastest[0] = max(fastest[0], rate * (reach + 2 * DX))
        push = (run.matter.momentum(run.now) - run.matter.momentum(run.start))[:2] @ mean
        now, start = run.matter.energy(run.now).mechanical, run.matter.energy(run.start).mechanical
        most = start + fastest[0] * push / np.cos(half)
        most += (ENERGY - 1) * (start + run.matter.mass.sum() * fastest[0] ** 2 / 2)
        if not now <= most:
            raise CriterionError(f"E ×{short(now / most)}")

    return criterion


def outside(pose: Pose) -> Criterion:
    """No particle deeper below the wall than 1.5 cells and the way of the wall in a substep."""

    def criterion(run: Run) -> None:
        (normal, offset), (before, last) = pose(run.substeps), pose(run.substeps - 1)
        depth = (offset - run.now.x @ normal).max() / DX
        way = np.abs(run.now.x @ (before - normal) + offset - last).max() / DX
        if not depth <= DEPTH + way:
            raise CriterionError(f"deep {short(depth)}")

    return criterion


def poses(pose: Pose) -> Callable[[int, int], dict[str, np.ndarray]]:
    """Inputs of a call: the pose at its beginning and at its end."""

    def inputs(begin: int, end: int) -> dict[str, np.ndarray]:
        normals, offsets = zip(*(pose(substep) for substep in (begin, end)), strict=True)
        return {
            "wall_normal": np.array(normals)[:, None, None],
            "wall_offset": np.array(offsets)[:, None, None],
        }

    return inputs


def rising(law: type, dim: int, value: float, how: How) -> str:
    """The grid is twice as large, so that the block that is thrown up stays on it."""
    up, speed = np.eye(dim)[1], value * PRESSURE_WAVE * WAVE
    scene = bodies.scene(bodies.block(law, dim, height=0.5), gravity=False, nodes=2 * NODES[dim])

    def pose(substep: float) -> tuple[np.ndarray, float]:
        return up, FLOOR * DX + speed * substep * scene.dt

    case = Case(
        scene=scene,
        substeps=int(np.clip(80 / value, 20, 200)),
        inputs=poses(pose),
        criteria=(not_crushed, whole, boosted(speed * up), outside(pose)),
    )
    return play(case, how)


def tilting(law: type, dim: int, value: float, how: How) -> str:
    """The floor turns by 60° at most, about an axis at the left of the block, and stops."""
    scene = bodies.scene(bodies.block(law, dim, height=0.5), gravity=False, nodes=2 * NODES[dim])
    middle = scene.bodies[0].particles.positions.mean(axis=0)
    pivot, rate = np.array([middle[0] - ARM * DX, FLOOR * DX]), value * PRESSURE_WAVE * WAVE / (ARM * DX)

    def pose(substep: float) -> tuple[np.ndarray, float]:
        angle = min(rate * substep * scene.dt, LARGEST_ANGLE)
        normal = np.array([-np.sin(angle), np.cos(angle), 0.0][:dim])
        return normal, normal[:2] @ pivot

    substeps = int(np.clip(40 / value, 60, 400))
    turn = rate * scene.dt * (substeps // 20)  # of a call: between two poses the normal is interpolated
    case = Case(
        scene=scene,
        substeps=substeps,
        inputs=poses(pose),
        criteria=(not_crushed, whole, tilted(pivot, rate * np.tan(turn / 2) / (turn / 2)), outside(pose)),
    )
    return play(case, how)


def belt(law: type, dim: int, value: float, how: How) -> str:
    scene: softmpm.Scene = bodies.scene(bodies.block(law, dim, height=0.5), gravity=False, friction=1.0)
    speed = value * PRESSURE_WAVE * WAVE * np.eye(dim)[0]
    case = Case(
        scene=scene,
        substeps=200,
        start=lambda state: bodies.moving(state, -0.1 * WAVE),
        inputs=lambda begin, end: {"wall_velocity": np.tile(speed, (1, 1, 1, 1))},
        criteria=(not_crushed, whole, boosted(speed), rubs),
    )
    return play(case, how)


def jump(law: type, dim: int, value: float, how: How) -> str:
    """The floor touches the block; it is at rest in every call, and higher from the sixth one on."""
    scene = bodies.scene(bodies.block(law, dim, height=0.5), gravity=False)

    def pose(substep: float) -> tuple[np.ndarray, float]:
        return np.eye(dim)[1], (FLOOR + 0.5 + value * (substep >= 50)) * DX

    case = Case(
        scene=scene,
        substeps=200,
        inputs=lambda begin, end: poses(pose)(begin, begin),
        criteria=(*BODY, outside(pose)),
    )
    return play(case, how)


JUDGED = "det F ≥ 0.05, gaps ≤ 1.4 cells, no particle inside the wall"
SPEEDS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 5, 20)
ROWS = [
    Row(
        name="rising",
        title="Floor that rises to a block, speed over that of the pressure wave (2 is 0.8 cells per substep)",
        right=f"{JUDGED}, energy ≤ 1.05 of the start in the frame of the wall",
        values=SPEEDS,
        few=(0.1, 1, 5),
        cell=rising,
    ),
    Row(
        name="tilting",
        title="Floor that tilts by 60° below a block, its speed there over that of the pressure wave",
        right=f"{JUDGED}, energy within the bound of the momentum",
        values=SPEEDS,
        few=(0.1, 1, 5),
        cell=tilting,
    ),
    Row(
        name="belt",
        title="Belt that a block falls on at 0.1 √(E/ρ), with a friction of 1, speed over that of the pressure wave",
        right="det F ≥ 0.05, gaps ≤ 1.4 cells, energy ≤ 1.05 of the start in the frame of the belt, drag ≤ push",
        values=(0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 100),
        few=(0.1, 10),
        cell=belt,
    ),
    Row(
        name="jump",
        title="Floor that jumps into a block between two calls [cells]; no error names it",
        right=f"{JUDGED}, energy ≤ 1.05 of the start",
        values=(0.1, 0.5, 1, 1.5, 2, 3, 5),
        few=(1,),
        cell=jump,
    ),
]
