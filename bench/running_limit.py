"""Measured over reported step limit: `python bench/running_limit.py [--device cuda] [--json FILE]`

``softmpm.stable_dt(scene, stretch=F)`` against a measurement by bisection to 3 %, for 20 lone particles and for a strip whose ends
are in stick walls, four particles a cell and axis, all in one homogeneous deformation: diag(s, 1, ..) for the
particles, with the contraction of free sides for the strip. Reported are the ratio of the measured to the reported limit, and of the
reported limit to that at rest.

A body in that deformation moves, except at s = 1, so "stable" needs a definition. Velocities are chosen so that the substep brings them
to rest, as at the turning point of a vibration: the substep then leaves x and F unchanged, and its Jacobian J in (x, v, C, F) is
that of a vibration about them. If the step is too large, J has an eigenvalue below -1: the amplitude of that mode grows each time.
Eigenvalues above 1 belong to a material that is unstable at any step, such as a compressed one, and do not count. Then J - 2 has an
eigenvalue below -3, which the power iteration finds as long as those above 1 are below 5; J times a vector is a central difference in
float64.
"""

import dataclasses
import math

import numpy as np
import torch
from common import Table, arguments
from extremes import bodies
from extremes.bodies import DX, FLOOR, YOUNG
from extremes.cells import How, make
from extremes.judges import DENSITIES
from extremes.laws import LAWS
from scipy.optimize import minimize_scalar
from torch import Tensor

import softmpm

STRETCHES = (0.3, 0.6, 1.0, 2.0, 3.0, 4.0)
ITERATIONS, AVERAGED = 80, 60
"""Iterations of the power method, and number of the last ones that are averaged: the norm oscillates as an eigenvalue nears -1."""
EPS = 1e-6
PRECISION = 0.03
SHIFT = 2.0
"""The power iteration is that of J - SHIFT. With 1, an eigenvalue of 3.3 (stable neo-Hookean in 3D at a stretch of 0.3) counted."""
LAME = YOUNG / 2.6, 0.3 * YOUNG / (1.3 * 0.4)
"""μ and λ [Pa] of the bodies."""


def main():
    args = arguments(__doc__)
    table = Table("Measured over reported step limit", torch.device(args.device), args.json)
    how = How(args.device, dtype=torch.float64, alarms=False)
    for law in LAWS:
        for dim in (2, 3):
            for stretch in STRETCHES:
                row = {"law": law.__name__, "dim": dim, "stretch": stretch}
                alone, held = np.diag([stretch] + [1.0] * (dim - 1)), free_sides(law, dim, stretch)
                for name, F, scene in (
                    ("lone", alone, cloud(law, dim)),
                    ("strip", held, strip(law, dim, stretch)),
                ):
                    limit = float(softmpm.stable_dt(scene, stretch=F))
                    row[name] = measured(scene, F, how, limit) / limit
                    row[f"{name} reported / rest"] = limit / float(softmpm.stable_dt(scene))
                table.add(row)


def free_sides(law: type, dim: int, stretch: float) -> np.ndarray:
    """Deformation of a strip of a given stretch along x whose sides are free: the least energy over the other stretch."""

    def energy(across: float) -> float:
        s = np.array([[stretch] + (dim - 1) * [across]])
        return DENSITIES[law.__name__](s, s.prod(-1), *(np.array([term]) for term in LAME))[0]

    across = minimize_scalar(energy, bounds=(0.1, 3.0), method="bounded", options={"xatol": 1e-9}).x
    return np.diag([stretch] + (dim - 1) * [across])


def cloud(law: type, dim: int) -> softmpm.Scene:
    """Twenty particles that share no node; stretched about their centre they are further apart, or share none still."""
    return bodies.scene(bodies.cloud(law, dim), gravity=False)


def strip(law: type, dim: int, stretch: float) -> softmpm.Scene:
    """A strip along x whose outermost cells are in stick walls when it is stretched."""
    cells = [12, 2] if dim == 2 else [6, 1, 1]
    length = 1.5 * cells[0] * max(1.0, stretch)
    low = [math.ceil(length / 2), FLOOR + 2] + [FLOOR + 2] * (dim - 2)
    body = bodies.box(low, cells, law, per_axis=4)
    middle = (low[0] + cells[0] / 2) * DX
    reach = stretch * cells[0] / 2 * DX - (1.0 if stretch >= 1 else stretch) * DX
    along = np.eye(dim)[0]
    walls = [
        softmpm.Wall(normal=along, offset=middle - reach, contact="stick"),
        softmpm.Wall(normal=-along, offset=-middle - reach, contact="stick"),
    ]
    nodes = (math.ceil(2 * middle / DX) + 2, *(FLOOR + 10,) * (dim - 1))
    scene = softmpm.Scene(grid=softmpm.Grid(shape=nodes, spacing=DX), bodies=[body], walls=walls, dt=1.0)
    return dataclasses.replace(scene, dt=float(softmpm.stable_dt(scene)))


def measured(scene: softmpm.Scene, F: np.ndarray, how: How, guess: float) -> float:
    """Largest stable step [s]."""

    def holds(dt: float) -> bool:
        return is_stable(dataclasses.replace(scene, dt=dt), F, how)

    low, high = 0.85 * guess, 1.7 * guess
    while not holds(low):
        low /= 2
    while holds(high):
        high *= 2
    while high / low > 1 + PRECISION:
        dt = math.sqrt(low * high)
        if holds(dt):
            low = dt
        else:
            high = dt
    return math.sqrt(low * high)


def is_stable(scene: softmpm.Scene, F: np.ndarray, how: How) -> bool:
    """True if no eigenvalue of the Jacobian of the substep is below -1."""
    model = make(scene, how, worlds=2)
    base = bodies.deformed(model.rest(), F) if len(scene.walls) > 1 else model.rest()
    base = base._replace(F=torch.as_tensor(F).to(base.F).expand_as(base.F).clone())
    params = model.params()

    def substep(state: softmpm.State) -> softmpm.State:
        return softmpm.simulate(model, state, None, params, substeps=1)

    kick = resting(scene, base, how)
    base = base._replace(v=-scene.dt * kick.v, C=-scene.dt * kick.C)
    scales = (DX, DX / scene.dt, 1 / scene.dt, 1.0)
    generator = torch.Generator().manual_seed(0)
    vector = [
        torch.randn(part[:1].shape, generator=generator, dtype=part.dtype).to(part) for part in base[:4]
    ]
    logs = []
    for _ in range(ITERATIONS):
        sign = torch.tensor([EPS, -EPS]).to(base.x)
        moved = [
            b + s * u * sign.view(2, *(1,) * (b.ndim - 1))
            for b, u, s in zip(base[:4], vector, scales, strict=True)
        ]
        after = substep(softmpm.State(*moved))
        image: list[Tensor] = [
            (a[:1] - a[1:]) / (2 * EPS * s) - SHIFT * u
            for a, u, s in zip(after[:4], vector, scales, strict=True)
        ]
        size = math.sqrt(sum(float((part**2).sum()) for part in image))
        logs.append(math.log(size))
        vector = [part / size for part in image]
    return math.exp(np.mean(logs[-AVERAGED:])) <= 1 + SHIFT


def resting(scene: softmpm.Scene, base: softmpm.State, how: How) -> softmpm.State:
    """Rates of change of v and C by the forces, from a substep so short that displacements are negligible."""
    dt = 1e-3 * scene.dt
    model = make(dataclasses.replace(scene, dt=dt), how, worlds=2)
    end = softmpm.simulate(model, base, None, model.params(), substeps=1)
    return end._replace(v=end.v / dt, C=end.C / dt)


if __name__ == "__main__":
    main()
