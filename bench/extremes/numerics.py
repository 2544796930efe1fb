"""Extremes of the method: the step, the number of particles, the number of substeps, and gradients through them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

import softmpm

from . import bodies
from .bodies import DX, WAVE
from .cells import BODY, FREE, Case, CriterionError, How, Run, call, make, play, short, turns_on
from .rows import Row


def step_of_block(law: type, dim: int, value: float, how: How) -> str:
    case = Case(
        scene=bodies.scene(bodies.block(law, dim, height=0.5), fraction=value),
        substeps=int(min(100 / value, 4_000)),
        start=lambda state: bodies.moving(state, -0.1 * WAVE),
        criteria=BODY,
    )
    return play(case, how)


def rings(fraction: float) -> Callable[[Run], None]:
    """Each particle vibrates within the bound of symplectic Euler, 1/√(1 − (dt/limit)²) of its initial strain.

    At the limit and above there is no finite bound; ten times the initial strain is used instead.
    """
    most = 1.05 / np.sqrt(max(1 - fraction**2, 0.01))

    def criterion(run: Run) -> None:
        first, now = (
            np.linalg.norm(state.F - np.eye(run.matter.dim), axis=(1, 2)) for state in (run.start, run.now)
        )
        growth = float((now / first).max())
        if not growth <= most:
            raise CriterionError(f"H ×{short(growth)}")

    return criterion


def step_of_cloud(law: type, dim: int, value: float, how: How) -> str:
    def start(state: softmpm.State) -> softmpm.State:
        random = np.random.default_rng(0).uniform(-1e-3, 1e-3, state.F.shape)
        H = torch.as_tensor(random + random.swapaxes(-1, -2)).to(state.F)
        return state._replace(F=state.F + H)

    case = Case(
        scene=bodies.scene(bodies.cloud(law, dim), fraction=value),
        substeps=200,
        start=start,
        criteria=(FREE[-1], rings(value)),
        calls=40,
    )
    return play(case, how)


def density_of_particles(law: type, dim: int, value: float, how: How) -> str:
    body = bodies.block(law, dim, height=1, side=4 if dim == 2 else 3, per_axis=int(value))
    case = Case(
        scene=bodies.scene(body),
        substeps=200,
        start=lambda state: bodies.moving(state, -0.1 * WAVE),
        criteria=BODY,
    )
    return play(case, how)


def tumbling(dim: int, rate: float = 0.02) -> Callable[[softmpm.State], softmpm.State]:
    """An initial state that is stretched by 5 % and spins."""
    F = np.diag([1.05] + [1.0] * (dim - 1))
    turn = bodies.spinning(dim, rate * WAVE / DX)
    return lambda state: bodies.affine(bodies.deformed(state, F), turn)


def long_flight(law: type, dim: int, value: float, how: How) -> str:
    scene = bodies.scene(bodies.block(law, dim), gravity=False)
    return play(Case(scene=scene, substeps=int(value), start=tumbling(dim), criteria=(*FREE, turns_on)), how)


def stands(run: Run) -> None:
    """A body that rests on the floor creeps by at most 0.01 cells sideways and one cell down."""
    moved = (run.matter.center(run.now) - run.matter.center(run.start)) / run.matter.dx
    down, aside = moved[1], np.linalg.norm(np.delete(moved, 1))
    if not (aside <= 0.01 and -1.0 <= down <= 0.01):
        raise CriterionError(f"off {short(max(abs(down), aside))}")


def long_rest(law: type, dim: int, value: float, how: How) -> str:
    scene = bodies.scene(bodies.block(law, dim, height=0.5))
    return play(Case(scene=scene, substeps=int(value), criteria=(*BODY, stands)), how)


ROUNDING = 0.01
"""Largest relative deviation of a float32 gradient; its trajectory drifts by about 1e-9 of a turn per substep."""


def gradient(law: type, dim: int, value: float, how: How) -> str:
    """Derivative of a random weighting of the final state with respect to factors on E and on the initial velocity."""
    body = bodies.box([7] * dim, [5 - dim] * dim, law)
    scene = bodies.scene(body, gravity=False, nodes=16)
    precise = replace(how, dtype=torch.float64)
    count = int(value)
    got = loss(scene, dim, count, how, torch.ones(2), True)[1]
    want = loss(scene, dim, count, precise, torch.ones(2), True)[1]
    eps = 1e-6
    for k, axis in enumerate(torch.eye(2, dtype=torch.float64)):
        up, down = (loss(scene, dim, count, precise, 1 + s * eps * axis, False)[0] for s in (1, -1))
        apart = abs((up - down) / (2 * eps) - want[k]) / np.abs(want).max()
        if not apart <= 1e-5:
            raise CriterionError(f"FD {short(apart)}")
    apart = float(np.abs(got - want).max() / np.abs(want).max())
    if not apart <= ROUNDING:
        raise CriterionError(f"f32 {short(apart)}")
    return short(apart)


def loss(
    scene: softmpm.Scene, dim: int, substeps: int, how: How, factors: torch.Tensor, backward: bool
) -> tuple[float, np.ndarray]:
    """Weighted mean of the final positions [cells], and its gradient with respect to the factors."""
    model = make(scene, how)
    factors = factors.to(model.device, model.dtype).requires_grad_(backward)
    start, params = tumbling(dim, 0.002)(model.rest()), model.params()
    start = softmpm.State(start.x, factors[1] * start.v, factors[1] * start.C, start.F)
    end = call(model, start, None, params._replace(young=factors[0] * params.young), substeps)
    weights = torch.as_tensor(np.random.default_rng(0).standard_normal(end.x.shape)).to(end.x)
    value = (weights * end.x).mean() / DX
    if backward:
        value.backward()
    gradient = np.zeros(2) if factors.grad is None else factors.grad.cpu().double().numpy()
    return value.item(), gradient


JUDGED = "det F ≥ 0.05, gaps ≤ 1.4 cells, energy ≤ 1.05 of the start"
STEPS = (0.01, 0.1, 0.3, 0.5, 0.8, 0.95, 1.05, 1.2, 1.5, 2)
LENGTHS = (1e2, 1e3, 1e4, 1e5, 1e6)
ROWS = [
    Row(
        name="dt",
        title="Step over the largest stable one, block that hits the floor at 0.1 √(E/ρ)",
        right=JUDGED,
        values=STEPS,
        few=(0.1, 0.95, 1.5),
        cell=step_of_block,
    ),
    Row(
        name="dt_lone",
        title="The same for 20 lone particles that vibrate and fall",
        right="strain within the bound of symplectic Euler, free fall",
        values=STEPS,
        few=(0.1, 0.95, 1.05),
        cell=step_of_cloud,
    ),
    Row(
        name="particles",
        title="Particles along the edge of a cell (8 are 64 in 2D, 4 are 64 in 3D), impact at 0.1 √(E/ρ)",
        right=JUDGED,
        values=(1, 2, 3, 4, 6, 8),
        few=(1, 4),
        cell=density_of_particles,
        dims=lambda value: (2, 3) if value <= 4 else (2,),
    ),
    Row(
        name="long_flight",
        title="Substeps of a flight, vibrating and turning",
        right=f"{JUDGED}, straight flight, angular momentum within 1e-3",
        values=LENGTHS,
        few=(1e3,),
        cell=long_flight,
        counts_substeps=True,
    ),
    Row(
        name="long_rest",
        title="Substeps of a rest on the floor",
        right=f"{JUDGED}, creep ≤ 0.01 cells",
        values=LENGTHS,
        few=(1e3,),
        cell=long_rest,
        counts_substeps=True,
    ),
    Row(
        name="gradient",
        title="Substeps that a gradient goes through (the note is float32 against float64)",
        right="float64 within 1e-5 of central differences, float32 within 1 % of float64",
        values=(1e2, 1e3, 1e4),
        few=(1e2,),
        cell=gradient,
        counts_substeps=True,
    ),
]
