"""Measured over reported step limit of the reference formulation: `python bench/reference_limit.py [--json FILE]`

A lone particle and a block of 4 x 2 (x 1) cells with two particles a cell and axis, homogeneously deformed: diag(s, 1, ..) and, as
``all``, s along every axis. A substep of nodes is v' = v + Δt a(u), u' = u + Δt v'. An oscillation about u grows as soon as Δt² λ > 4
for the largest eigenvalue λ of -∂a/∂u; negative ones belong to a material that is unstable at any step. λ is that of the compiled
substep: Lanczos' iteration, with central differences in float64. Reported are the limit (Q8) over that at rest, and the measured limit
over (Q8), which is at least 1 if no instability is missed.
"""

import dataclasses
import math

import numpy as np
import torch
from common import Table, arguments
from extremes.laws import LAWS
from scipy.sparse.linalg import LinearOperator, eigs

import softmpm
from softmpm.oracle.step_limit import running_limit
from softmpm.schemes.lagrangian.nodal import nodes_of, particles_of

STRETCHES = (0.3, 0.5, 0.7, 1.0, 1.4, 2.0)
DX, YOUNG, POISSON = 0.1, 100.0, 0.3
EPS = 1e-6


def main():
    args = arguments(__doc__)
    table = Table("Step limit of the reference formulation", torch.device(args.device), args.json)
    for law in LAWS:
        for dim in (2, 3):
            rest = limit(block(law, dim), np.eye(dim))
            for how in ("axis", "all"):
                for stretch in STRETCHES:
                    F = np.diag([stretch] + [1.0 if how == "axis" else stretch] * (dim - 1))
                    row = {"law": law.__name__, "dim": dim, "stretched": how, "stretch": stretch}
                    row["reported / rest"] = limit(block(law, dim), F) / rest
                    for name, made in (("lone", lone(law, dim)), ("block", block(law, dim))):
                        row[name] = measured(made, F, args.device) / limit(made, F)
                    table.add(row)


def lone(law: type, dim: int) -> softmpm.Scene:
    return scene(dim, softmpm.Particles(np.full((1, dim), 4.3 * DX), np.full(1, DX**dim)), law)


def block(law: type, dim: int) -> softmpm.Scene:
    low = np.full(dim, 3.0)
    return scene(dim, softmpm.box(low * DX, (low + [4, 2, 1][:dim]) * DX, spacing=DX / 2), law)


def scene(dim: int, particles: softmpm.Particles, law: type) -> softmpm.Scene:
    body = softmpm.Body(particles, law(density=1.0, young=YOUNG, poisson=POISSON))
    made = softmpm.Scene(grid=softmpm.Grid(shape=(10,) * dim, spacing=DX), bodies=[body], dt=1.0)
    return dataclasses.replace(made, dt=0.1 * float(softmpm.stable_dt(made)))


def limit(made: softmpm.Scene, F: np.ndarray) -> float:
    """Reported limit [s]."""
    mu, lam = YOUNG / (2 + 2 * POISSON), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    return running_limit(made, 0, mu, lam, 1.0, torch.from_numpy(F), [])


def measured(made: softmpm.Scene, F: np.ndarray, device: str) -> float:
    """Largest step [s] at which no oscillation about a homogeneous deformation grows."""
    model = softmpm.build(
        made,
        device=device,
        dtype=torch.float64,
        worlds=2,
        formulation="reference",
        alarms=softmpm.Alarms(collapse=None, step=None),
    )
    start = model.rest()
    strain = torch.as_tensor(F - np.eye(len(F))).to(start.x)
    state = start._replace(x=start.x + start.x @ strain.T, F=start.F + strain)
    nodes, params = nodes_of(model, state, model.mass.expand(2, -1)), model.params()
    middle = nodes.u[:1]

    def stiffness(way: np.ndarray) -> np.ndarray:
        """-∂a/∂u times a displacement."""
        change = torch.from_numpy(way).to(middle).reshape(middle.shape)
        change = EPS * DX / float(change.abs().max()) * change
        u = torch.cat([middle + change, middle - change])
        moved = nodes._replace(u=u, v=torch.zeros_like(u))
        shown = particles_of(model, moved)
        end = softmpm.simulate(model, shown, None, params, substeps=1).nodes
        assert end is not None
        a = (end.v[:1] - end.v[1:]) / (2 * made.dt)
        return -(a * (np.abs(way).max() / (EPS * DX))).flatten().cpu().numpy()

    size = middle.numel()
    operator = LinearOperator((size, size), stiffness, dtype=np.float64)
    first = np.random.default_rng(0).normal(size=size)
    found = eigs(operator, k=1, which="LR", v0=first, return_eigenvectors=False, tol=1e-6)
    return 2 / math.sqrt(found.real.max())


if __name__ == "__main__":
    main()
