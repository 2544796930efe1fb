"""Extremes of the load: impact, muscles, throws, spins, and calls whose inputs differ from those of the scene."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

import softmpm

from . import bodies
from .bodies import BAR, DX, SIDE, WAVE, YOUNG
from .cells import BODY, FREE, Case, CriterionError, How, Run, play, short, turns_on
from .judges import DENSITIES
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


def sudden(sign: float):
    """Cells of a free block whose muscle is switched on at once and stays on."""

    def cell(law: type, dim: int, value: float, how: How) -> str:
        scene = bodies.scene(bodies.block(law, dim), muscle=value * YOUNG)
        return play(Case(scene=scene, substeps=300, activation=sign, criteria=FREE), how)

    return cell


def balance(law: type, dim: int, active_stress: float) -> np.ndarray:
    """F of a free body in which the law balances an active stress along x: the minimum of the energy over the stretches."""
    mu, lam = YOUNG / 2.6, 0.3 * YOUNG / (1.3 * 0.4)

    def energy(log: np.ndarray) -> float:
        s = np.exp(np.array([[log[0]] + (dim - 1) * [log[1]]]))
        own = DENSITIES[law.__name__](s, s.prod(-1), np.array([mu]), np.array([lam]))[0]
        return (own + active_stress / 2 * s[0, 0] ** 2) / YOUNG

    log = minimize(energy, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14}).x
    return np.diag(np.exp([log[0]] + (dim - 1) * [log[1]]))


def stays(F: np.ndarray) -> Callable[[Run], None]:
    """Criterion: F is within 1 % of the exact homogeneous deformation."""

    def criterion(run: Run) -> None:
        off = np.abs(run.now.F @ np.linalg.inv(F) - np.eye(len(F))).max()
        if not off <= 0.01:
            raise CriterionError(f"F {short(off)}")

    return criterion


def held(law: type, dim: int, value: float, how: How) -> str:
    F = balance(law, dim, value * YOUNG)
    case = Case(
        scene=bodies.scene(bodies.block(law, dim), muscle=value * YOUNG),
        substeps=300,
        start=lambda state: bodies.deformed(state, F),
        activation=1.0,
        criteria=(*FREE, stays(F)),
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


def overdriven(law: type, dim: int, value: float, how: How) -> str:
    scene: softmpm.Scene = bodies.scene(bodies.block(law, dim), muscle=0.1 * YOUNG)
    return play(Case(scene=scene, substeps=300, activation=value, criteria=FREE), how)


JUDGED = "det F ≥ 0.05, gaps ≤ 1.4 cells, energy ≤ 1.05 (start + work)"
FLYING = f"{JUDGED}, free fall"
PULLS = (0.01, 0.1, 0.2, 0.3, 0.6, 1, 3, 10)
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
        name="pull",
        title="Muscle switched on at once: pull over E",
        right=FLYING,
        values=PULLS,
        few=(0.1, 1, 10),
        cell=sudden(1.0),
    ),
    Row(
        name="push",
        title="Muscle switched on at once: push over E",
        right=FLYING,
        values=PULLS,
        few=(0.1, 1, 10),
        cell=sudden(-1.0),
    ),
    Row(
        name="held",
        title="Pull over E that the body is already contracted by",
        right=f"{FLYING}; F within 1 % of the exact balance",
        values=PULLS,
        few=(0.3, 10),
        cell=held,
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
    Row(
        name="overdriven",
        title="Activation of the call, muscle of 0.1 E",
        right=FLYING,
        values=(1, 2, 3, 5, 10, 30, 100),
        few=(2, 100),
        cell=overdriven,
    ),
]
