"""Extremes of the load: impact, throws, spins, and calls whose material differs from that of the scene."""

import numpy as np

from . import bodies
from .bodies import BAR, DX, SIDE, WAVE
from .cells import BODY, FREE, Case, How, play, turns_on
from .rows import Row

PRESSURE_WAVE = 1.16
"""Speed of the pressure wave over √(E/ρ) at a Poisson's ratio of 0.3."""


def impact(law: type, dim: int, value: float, how: How) -> str:
    """The run is long enough for the bounce and ends before the block leaves the grid."""
    case = Case(
        scene=bodies.scene(bodies.block(law, dim, height=0.5)),
        substeps=int(np.clip(60 / value, 60, 200)),
        start=lambda state: bodies.moving(state, -value * PRESSURE_WAVE * WAVE),
    )
    return play(case, how)


def thrown(law: type, dim: int, value: float, how: How) -> str:
    rate = np.zeros((dim, dim))
    rate[0, 0] = value * WAVE / (BAR[dim][0] / 2 * DX)
    scene = bodies.scene(bodies.bar(law, dim))
    return play(
        Case(scene=scene, substeps=300, start=lambda state: bodies.affine(state, rate), criteria=FREE), how
    )


def spin(law: type, dim: int, value: float, how: How) -> str:
    rate = bodies.spinning(dim, value * WAVE / (SIDE[dim] / 2 * DX))
    case = Case(
        scene=bodies.scene(bodies.block(law, dim)),
        substeps=300,
        start=lambda state: bodies.affine(state, rate),
        criteria=(*FREE, turns_on),
    )
    return play(case, how)


def stiffened(law: type, dim: int, value: float, how: How) -> str:
    scene = bodies.scene(bodies.block(law, dim, height=1))
    case = Case(
        scene=scene,
        substeps=200,
        start=lambda state: bodies.moving(state, -0.1 * WAVE),
        young_factor=value,
        criteria=BODY,
    )
    return play(case, how)


JUDGED = "det F ≥ 0.05, gaps ≤ 1.4 cells, energy ≤ 1.05 of the start"
FLYING = f"{JUDGED}, free fall"
SPEEDS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2)
ROWS = [
    Row(
        name="impact",
        title="Impact of a block on the floor, speed over that of the pressure wave",
        right=JUDGED,
        values=SPEEDS,
        few=(0.1, 1, 2),
        cell=impact,
    ),
    Row(
        name="thrown",
        title="Bar thrown apart, speed of its ends over √(E/ρ)",
        right=FLYING,
        values=SPEEDS,
        few=(0.2, 1, 2),
        cell=thrown,
    ),
    Row(
        name="spin",
        title="Spin of a block, speed of its faces over √(E/ρ)",
        right=f"{FLYING}, angular momentum within 1e-3",
        values=SPEEDS,
        few=(0.2, 1, 2),
        cell=spin,
    ),
    Row(
        name="stiffened",
        title="Young's modulus of the call over the scene's, at half the scene's limit",
        right=JUDGED,
        values=(1, 2, 3, 5, 9, 30, 100),
        few=(2, 9),
        cell=stiffened,
    ),
]
