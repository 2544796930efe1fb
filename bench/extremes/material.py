"""Extremes of the material: Young's modulus, Poisson's ratio, stiff on soft, heavy on light."""

import functools
import math

import numpy as np
import torch

from . import bodies
from .bodies import DENSITY, DX, WAVE, YOUNG
from .cells import BODY, Case, CriterionError, How, exact, judged, play, short, states
from .rows import Row

SAME = 0.01
"""Largest deviation of a scaled motion [cells]; rounding to float32 causes less than a tenth of it."""


def dropped(law: type, dim: int, mach: float, young: float = YOUNG, poisson: float = 0.3) -> Case:
    """A block that hits the floor at ``mach`` √(E/ρ) and bounces."""
    speed = mach * math.sqrt(young / DENSITY)
    body = bodies.block(law, dim, height=1, young=young, poisson=poisson)
    return Case(
        scene=bodies.scene(body, young=young),
        substeps=300,
        start=lambda state: bodies.moving(state, -speed),
    )


@functools.cache
def bounce(law: type, dim: int, device: str) -> np.ndarray:
    """Final positions of the bounce of a block of 1e5 Pa in float64 [m]."""
    *_, end = states(dropped(law, dim, 0.1), How(device, dtype=torch.float64))
    return exact(end).x


def young(law: type, dim: int, value: float, how: How) -> str:
    """All stresses and the square of the speed scale with E, so the motion is the same over √(E) times the time."""
    run = judged(dropped(law, dim, 0.1, young=value), how)
    off = np.abs(run.now.x - bounce(law, dim, how.device)).max() / DX
    if not off <= SAME:
        raise CriterionError(f"off {short(off)}")
    return short(run.least)


def poisson(law: type, dim: int, value: float, how: How) -> str:
    return play(dropped(law, dim, 0.05, poisson=value), how)


def ratio(quantity: str, loaded: float):
    """Cells of a standing bar whose lower half is softer or lighter.

    Args:
        quantity: ``young`` or ``density``.
        loaded: Impact speed over the smaller wave speed of the two halves, which both withstand; if negative, over the larger one.
    """

    def cell(law: type, dim: int, value: float, how: How) -> str:
        other = {quantity: (YOUNG if quantity == "young" else DENSITY) / value}
        body = bodies.halves(law, dim, 0.5, other, {})
        slow = WAVE / math.sqrt(value) if quantity == "young" else WAVE
        speed = loaded * slow if loaded > 0 else -loaded * slow * math.sqrt(value)
        case = Case(
            scene=bodies.scene(*body, young=YOUNG / value if quantity == "young" else YOUNG),
            substeps=int(min(200 * math.sqrt(value), 5_000)) if loaded > 0 else 300,
            start=lambda state: bodies.moving(state, -speed),
            criteria=BODY,
        )
        return play(case, how)

    return cell


JUDGED = "det F ≥ 0.05, gaps ≤ 1.4 cells, energy ≤ 1.05 of the start"
RATIOS = (1, 10, 1e2, 1e3, 1e4, 1e5, 1e6)
ROWS = [
    Row(
        name="young",
        title="Young's modulus [Pa] of a block that bounces, speed and gravity scaled with it",
        right=f"{JUDGED}; ends within 0.01 cells of the float64 run at 1e5 Pa",
        values=tuple(10.0**k for k in range(10)),
        few=(1e9,),
        cell=young,
    ),
    Row(
        name="poisson",
        title="Poisson's ratio of a block that hits the floor at 0.05 √(E/ρ)",
        right=JUDGED,
        values=(-0.9, -0.5, 0.0, 0.3, 0.45, 0.49, 0.499, 0.4999),
        few=(-0.9, 0.4999),
        cell=poisson,
    ),
    Row(
        name="soft_half",
        title="Bar, stiff half on a soft one, ratio of Young's moduli; impact at 0.1 of the soft wave speed",
        right=JUDGED,
        values=RATIOS,
        few=(10,),
        cell=ratio("young", 0.1),
    ),
    Row(
        name="soft_half_hit",
        title="The same at 0.1 of the stiff wave speed, which is up to 100 of the soft one",
        right=JUDGED,
        values=RATIOS,
        few=(1e2, 1e6),
        cell=ratio("young", -0.1),
    ),
    Row(
        name="light_half",
        title="Bar, heavy half on a light one, ratio of densities; impact at 0.1 of the heavy wave speed",
        right=JUDGED,
        values=(1, 10, 1e2, 1e3, 1e4),
        few=(10,),
        cell=ratio("density", 0.1),
    ),
    Row(
        name="light_half_hit",
        title="The same at 0.1 of the light wave speed, which is up to 10 of the heavy one",
        right=JUDGED,
        values=(1, 10, 1e2, 1e3, 1e4),
        few=(1e2, 1e4),
        cell=ratio("density", -0.1),
    ),
]
