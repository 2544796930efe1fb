"""Extremes of the viscosity, of the scene and of a call."""

from collections.abc import Callable

import numpy as np
import torch

import softmpm

from . import bodies
from .bodies import DENSITY, DX, WAVE, YOUNG
from .cells import BODY, FREE, Case, CriterionError, How, Run, falls_freely, play, short, turns_on
from .numerics import JUDGED, tumbling
from .rows import Row

UNIT = DX * np.sqrt(YOUNG * DENSITY)
"""Viscosity η [Pa s] whose relaxation time η/E is the time in which a wave at √(E/ρ) crosses a cell."""
MU, LAM = YOUNG / 2.6, 0.3 * YOUNG / (1.3 * 0.4)


def bounce(law: type, dim: int, value: float, how: How) -> str:
    """The run is long enough for the bounce, up to a viscosity of 10 units, whose step is a thirtieth of that of none."""
    scene = bodies.scene(bodies.block(law, dim, height=0.5, viscosity=value * UNIT))
    case = Case(
        scene=scene,
        substeps=int(np.clip(30 * DX / (WAVE * scene.dt), 200, 5_000)),
        start=lambda state: bodies.moving(state, -0.2 * WAVE),
        criteria=BODY,
    )
    return play(case, how)


def vibrates(viscosity: float) -> Callable[[Run], None]:
    """Strain of lone particles within 2 % of the first one of the linear recursion Ċ = −4τ/(ρ dx²), Ḣ = C in float64."""

    def criterion(run: Run) -> None:
        dt, eye = run.matter.scene.dt, np.eye(run.matter.dim)
        first = run.start.F - eye
        H, C = first, run.start.C
        for _ in range(run.substeps):
            strain, rate = H + H.swapaxes(1, 2), C + C.swapaxes(1, 2)
            stress = MU * strain + LAM / 2 * np.trace(strain, axis1=1, axis2=2)[:, None, None] * eye
            C = C - dt * 4 / (DENSITY * DX**2) * (stress + viscosity * rate)
            H = H + dt * C
        off = np.abs(run.now.F - eye - H).max() / np.abs(first).max()
        if not off <= 0.02:
            raise CriterionError(f"H off {short(off)}")

    return criterion


def lone(law: type, dim: int, value: float, how: How) -> str:
    def start(state: softmpm.State) -> softmpm.State:
        random = np.random.default_rng(0).uniform(-1e-4, 1e-4, state.F.shape)
        return state._replace(F=state.F + torch.as_tensor(random + random.swapaxes(-1, -2)).to(state.F))

    viscosity = value * UNIT
    case = Case(
        scene=bodies.scene(bodies.cloud(law, dim, viscosity=viscosity), fraction=0.95),
        substeps=200,
        start=start,
        criteria=(falls_freely, vibrates(viscosity)),
    )
    return play(case, how)


def given(law: type, dim: int, value: float, how: How) -> str:
    """The scene has no viscosity; at rest the largest one of its dt is that of K dt² + 4η dt = ρ dx²."""
    scene = bodies.scene(bodies.block(law, dim), gravity=False)
    largest = (DENSITY * DX**2 - (2 * MU + dim * LAM) * scene.dt**2) / (4 * scene.dt)
    case = Case(
        scene=scene,
        substeps=300,
        start=tumbling(dim),
        inputs=lambda begin, end: {"viscosity": np.full((1, 1), value * largest)},
        criteria=(*FREE, turns_on),
    )
    return play(case, how)


VALUES = (0, 0.01, 0.1, 1, 10, 100, 1e4, 1e6)
ROWS = [
    Row(
        name="viscosity",
        title="Viscosity over dx √(Eρ), block that hits the floor at 0.2 √(E/ρ)",
        right=JUDGED,
        values=VALUES,
        few=(1, 1e6),
        cell=bounce,
    ),
    Row(
        name="viscosity_lone",
        title="The same for 20 lone particles that vibrate and fall, at 0.95 of the largest stable step",
        right="strain within 2 % of the linear recursion, free fall",
        values=VALUES,
        few=(1, 1e6),
        cell=lone,
    ),
    Row(
        name="viscosity_call",
        title="Viscosity of the call over the largest at rest, block that vibrates and turns",
        right=f"{JUDGED}, free flight, angular momentum within 1e-3",
        values=(0, 0.01, 0.1, 0.5, 0.9, 1.1, 1.5, 3, 10, 100),
        few=(0.5, 3, 100),
        cell=given,
    ),
]
