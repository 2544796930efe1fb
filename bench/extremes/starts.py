"""Extremes of the start: stretched, compressed, mirrored and turned bodies, released at rest."""

import numpy as np
import torch

import softmpm

from . import bodies
from .cells import FREE, Case, How, play
from .rows import Row

SIDE = {2: 6, 3: 3}
"""Cells along an edge; ten times this length fits into the grid."""


def released(law: type, dim: int, F: np.ndarray, how: How) -> str:
    case = Case(
        scene=bodies.scene(bodies.block(law, dim, side=SIDE[dim])),
        substeps=300,
        start=lambda state: bodies.deformed(state, F),
        criteria=FREE,
    )
    return play(case, how)


def stretch(law: type, dim: int, value: float, how: How) -> str:
    return released(law, dim, np.diag([value] + [1.0] * (dim - 1)), how)


def stretch_all(law: type, dim: int, value: float, how: How) -> str:
    return released(law, dim, value * np.eye(dim), how)


def compress(law: type, dim: int, value: float, how: How) -> str:
    return released(law, dim, value ** (1 / dim) * np.eye(dim), how)


def flatten(law: type, dim: int, value: float, how: How) -> str:
    return released(law, dim, np.diag([value] + [1.0] * (dim - 1)), how)


def half_turn(dim: int) -> np.ndarray:
    F = np.eye(dim)
    F[:2, :2] *= -1.0
    return F


def shear(dim: int) -> np.ndarray:
    F = np.eye(dim)
    F[0, 1] = 1.0
    return F


WHOLE = {
    "turned": half_turn,
    "shear 1": shear,
    "mirrored": lambda dim: np.diag([-1.0] + [1.0] * (dim - 1)),
    "flat": lambda dim: np.diag([1e-3] + [1.0] * (dim - 1)),
}
"""Deformation of the whole body; the first two are legal."""
SINGLE = {"one at -1": -1.0, "one at -.01": -0.01, "one at 0": 0.0, "one at .01": 0.01}
"""det F of one particle in the middle of a body at rest."""


def odd(law: type, dim: int, value: str, how: How) -> str:
    if value in WHOLE:
        return released(law, dim, WHOLE[value](dim), how)

    def start(state: softmpm.State) -> softmpm.State:
        middle = state.x.shape[1] // 2
        state.F[:, middle] = torch.diag(torch.tensor([SINGLE[value]] + [1.0] * (dim - 1))).to(state.F)
        return state

    scene = bodies.scene(bodies.block(law, dim, side=SIDE[dim]))
    return play(Case(scene=scene, substeps=300, start=start, criteria=FREE), how)


JUDGED = "det F ≥ 0.05, gaps ≤ 1.4 cells, energy ≤ 1.05 of the start, free fall"
STRETCHES = (1.1, 1.3, 1.5, 2, 2.5, 3, 4, 6, 10)
DETS = (0.8, 0.5, 0.3, 0.2, 0.1, 0.07, 0.055, 0.04)
ROWS = [
    Row(
        name="stretch",
        title="Body released from a stretch along x",
        right=JUDGED,
        values=STRETCHES,
        few=(1.5, 3, 10),
        cell=stretch,
    ),
    Row(
        name="stretch_all",
        title="Body released from a stretch along every axis",
        right=JUDGED,
        values=STRETCHES,
        few=(1.3, 3),
        cell=stretch_all,
    ),
    Row(
        name="compress",
        title="Body released from a compression along every axis, det F",
        right=JUDGED,
        values=DETS,
        few=(0.5, 0.055),
        cell=compress,
    ),
    Row(
        name="flatten",
        title="Body released from a compression along x, det F",
        right=JUDGED,
        values=DETS,
        few=(0.5, 0.055),
        cell=flatten,
    ),
    Row(
        name="odd",
        title="Odd starts: turned by 180°, sheared, mirrored, flat; one particle of a given det F",
        right=JUDGED,
        values=(*WHOLE, *SINGLE),
        few=("turned", "mirrored", "one at -1"),
        cell=odd,
    ),
]
