"""Extremes of the actuators: muscles and pressures, switched on at once, in balance, or beyond full activation."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

import softmpm

from . import bodies
from .bodies import YOUNG
from .cells import FREE, Case, CriterionError, How, Run, play, short
from .judges import DENSITIES
from .rows import Row


def sudden(kind: str, sign: float):
    """Cells of a free block whose ``muscle`` or ``pressure`` is switched on at once and stays on."""

    def cell(law: type, dim: int, value: float, how: How) -> str:
        scene = bodies.scene(bodies.block(law, dim), **{kind: value * YOUNG})
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


def overdriven(law: type, dim: int, value: float, how: How) -> str:
    scene: softmpm.Scene = bodies.scene(bodies.block(law, dim), muscle=0.1 * YOUNG)
    return play(Case(scene=scene, substeps=300, activation=value, criteria=FREE), how)


FLYING = "det F ≥ 0.05, gaps ≤ 1.4 cells, energy ≤ 1.05 (start + work), free fall"
PULLS = (0.01, 0.1, 0.2, 0.3, 0.6, 1, 3, 10)
ROWS = [
    Row(
        name="pull",
        title="Muscle switched on at once: pull over E",
        right=FLYING,
        values=PULLS,
        few=(0.1, 1, 10),
        cell=sudden("muscle", 1.0),
    ),
    Row(
        name="push",
        title="Muscle switched on at once: push over E",
        right=FLYING,
        values=PULLS,
        few=(0.1, 1, 10),
        cell=sudden("muscle", -1.0),
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
        name="overdriven",
        title="Activation of the call, muscle of 0.1 E",
        right=FLYING,
        values=(1, 2, 3, 5, 10, 30, 100),
        few=(2, 100),
        cell=overdriven,
    ),
    Row(
        name="swell",
        title="Pressure switched on at once: pressure over E",
        right=FLYING,
        values=PULLS,
        few=(0.1, 1, 10),
        cell=sudden("pressure", 1.0),
    ),
    Row(
        name="suck",
        title="Suction switched on at once: suction over E",
        right=FLYING,
        values=PULLS,
        few=(0.1, 1, 10),
        cell=sudden("pressure", -1.0),
    ),
]
