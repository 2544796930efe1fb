"""The step limit of the reference formulation: the bound (Q8), and the alarm that compares dt with it."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from helpers import LAWS, busy_scene

import softmpm
from softmpm.oracle import lagrangian, step_limit, stress

DIMS = pytest.mark.parametrize("dim", [2, 3])
MU = 3.0


def deformations(dim: int, count: int, low=0.3, high=2.0, seed=0) -> torch.Tensor:
    """The identity, then random deformation gradients whose stretches lie within these bounds."""
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.normal(size=(2, count, dim, dim)))[0]
    stretches = np.exp(rng.uniform(math.log(low), math.log(high), (count, dim)))
    F = turns[0] @ (stretches[..., None] * turns[1])
    F[np.linalg.det(F) < 0, 0] *= -1
    F[0] = np.eye(dim)
    return torch.from_numpy(F)


def largest(law: str, F, lam: float, pull=0.0, pressure=0.0, damping=0.0) -> torch.Tensor:
    """Largest eigenvalue of the tangent ∂P/∂F [Pa] at each of these deformation gradients, by PyTorch."""
    count, dim = F.shape[:2]
    fibre = torch.nn.functional.normalize(torch.arange(1.0, dim + 1).double(), dim=0).expand(count, dim)
    mu, one = torch.full((count,), MU, dtype=torch.float64), torch.ones(count, dtype=torch.float64)
    F = F.clone().requires_grad_()
    tau = stress.LAWS[LAWS[law]](F, mu, lam * one)
    tau = tau + pull * stress.muscle_stress(F, fibre, one)
    tau = tau + stress.pressure_stress(F, None, pressure * one)
    piola = (tau @ torch.linalg.inv(F).mT).flatten(1)
    rows = [torch.autograd.grad(row.sum(), F, retain_graph=True)[0] for row in piola.T]
    with torch.no_grad():
        basis, at = torch.eye(dim**2).double().view(-1, dim, dim), F[:, None]
        damped = damping * at @ (at.mT @ basis + basis.mT @ at) / 2
        A = torch.stack(rows, 1).flatten(2) + damped.flatten(2)
        torch.testing.assert_close(A, A.mT, rtol=1e-9, atol=1e-9)
        return torch.linalg.eigvalsh(A)[:, -1]


LOADS = {
    "law": {},
    "muscle": {"pull": 1.5},
    "pushing muscle": {"pull": -1.5},
    "pressure": {"pressure": 1.0},
    "suction": {"pressure": -1.0},
    "viscosity": {"damping": 4.0},
}


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("law", LAWS)
@DIMS
def test_no_unstable_step_is_missed(dim, law, load):
    """K of (Q8) is nowhere below the largest eigenvalue. Alone, a law has it exactly at rest; without muscles it is exact in 2D."""
    given = LOADS[load]
    for lam in (-0.5, 0.0, 5.0):
        F = deformations(dim, 40)
        one = torch.ones(len(F)).double()
        acting = given | ({"pull": max(given["pull"], 0.0)} if "pull" in given else {})
        K = step_limit.stiffness(LAWS[law](density=1.0, young=1.0), F, MU * one, lam * one, **acting)
        true = largest(law, F, lam, **given)
        assert (true * (1 - 1e-9) <= K).all()
        if load in ("law", "viscosity"):
            assert K[0] == pytest.approx(true[0].item(), rel=1e-9)
        if lam >= 0 and dim == 2 and "muscle" not in load:
            near = (
                torch.linalg.det(F) < math.e if law == "neo_hookean" else one > 0
            )  # beyond, f'' < 0 counts as 0
            torch.testing.assert_close(K[near], true[near], rtol=1e-9, atol=0)
        if lam > 0:
            ratio = (K / true).sqrt()
            assert ratio.median() <= 1.09 and ratio.max() <= 1.35


@pytest.mark.parametrize("law", LAWS)
@DIMS
def test_the_alarm_is_that_of_the_reference(dim, law, device):
    """A step that is 1e-9 below the limit passes in all worlds, one above it is named in each, whatever the load."""
    count, dt = 12, 1e-4
    F = deformations(dim, count, 0.4, seed=3)
    low = np.full(dim, 0.3)
    shape = softmpm.box(low, low + 0.2, spacing=0.1)
    everyone = range(len(shape))
    made = softmpm.Scene(
        grid=softmpm.Grid(shape=(10,) * dim, spacing=0.1),
        bodies=[softmpm.Body(shape, LAWS[law](density=2.0, young=100.0, poisson=0.3, viscosity=0.01))],
        muscles=[
            softmpm.Muscle(particles=everyone, direction=(0.6, 0.8, 0.1)[:dim], strength=30.0),
            softmpm.Muscle(particles=everyone, direction=(1.0, 0.0, 0.0)[:dim], strength=-12.0),
            softmpm.Pressure(particles=everyone, strength=10.0),
        ],
        dt=dt,
    )
    model = softmpm.build(
        made,
        device=device,
        dtype=torch.float64,
        worlds=count,
        formulation="reference",
        alarms=softmpm.Alarms(collapse=None),
        inputs=("viscosity",),
    )
    start = model.rest()
    x = torch.einsum("wij,wpj->wpi", F.to(start.x), start.x - 0.4) + 0.4
    start = start._replace(x=x, F=F.to(start.F)[:, None].expand_as(start.F).clone())
    mu, lam = 100 / 2.6, 100 * 0.3 / (1.3 * 0.4)
    for activation, viscosity in ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (1.0, 0.01)):
        stresses = [activation * one.strength for one in made.muscles]
        density = []
        for one in F:  # (Q8) is a condition on the density for a given step
            damping = torch.tensor(4 * viscosity / dt, dtype=torch.float64)
            acting = (max(stresses[0], 0) + max(stresses[1], 0), stresses[2], damping)
            moduli = torch.tensor([mu, lam], dtype=torch.float64)
            K = step_limit.stiffness(made.bodies[0].material, one, *moduli, *acting)
            density.append(K.item() * dt**2 / 0.1**2)
            limit = step_limit.running_limit(made, 0, mu, lam, density[-1], one, stresses, viscosity)
            assert limit == pytest.approx(dt, rel=1e-9)
        rows = torch.full((1, count, 3), activation, device=model.device, dtype=torch.float64)
        inputs = softmpm.Inputs(viscosity=rows.new_full((1, 1), viscosity))
        for factor, named in ((1 + 1e-9, 0), (1 - 1e-9, count)):
            failures = softmpm.Failures("freeze")
            values = factor * rows.new_tensor(density)[:, None]
            params = model.params()._replace(density=values.expand(count, len(shape)))
            softmpm.simulate(model, start, rows, params, substeps=1, inputs=inputs, failures=failures)
            at_start = [error for error in failures.errors if "start state" in str(error)]
            assert [error.kind for error in at_start] == named * ["step"]


def squeezed(**changes) -> softmpm.Scene:
    """A free block with a muscle and viscosity, to be thrown against itself."""
    made = busy_scene(2, walls=[], damping=0.0, gravity=None, per_law=30)
    bodies = [
        dataclasses.replace(body, material=dataclasses.replace(body.material, viscosity=0.01))
        for body in made.bodies
    ]
    return dataclasses.replace(made, **({"bodies": bodies} | changes))


def inward(model: softmpm.Model, rate: float) -> softmpm.State:
    """At rest, and about to shrink along x."""
    state = model.rest()
    state.C[..., 0, 0] = -rate
    state.v[..., 0] = -rate * (state.x[..., 0] - 0.46)
    return state


def above(made, F, activation, dt: float) -> torch.Tensor:
    """True for particles with K above ρ₀ dx²/Δt²; F of shape (particle, dim, dim)."""
    found, first = [], 0
    stresses = [a * one.strength for a, one in zip(activation, made.muscles, strict=True)]
    for body in made.bodies:
        own, material = range(first, first + len(body.particles)), body.material
        first = own.stop
        ones = torch.ones(len(own), dtype=torch.float64)
        mu, lam = stress.lame(material.young * ones, material.poisson * ones)
        pull = torch.tensor(
            [
                sum(max(p, 0.0) for p, one in zip(stresses, made.muscles, strict=True) if k in one.particles)
                for k in own
            ]
        )
        damping = 4 * material.viscosity / dt * ones
        K = step_limit.stiffness(material, F[own.start : own.stop], mu, lam, pull, 0.0, damping)
        found.append(material.density * made.grid.spacing**2 / dt**2 < K)
    return torch.cat(found)


def test_it_fires_at_the_substep_and_particle_of_the_reference(device):
    """In a body that shrinks under its muscles: named is the first particle above its limit, in the substep that begins so."""
    made = squeezed()
    made = dataclasses.replace(made, dt=0.95 * softmpm.stable_dt(made))
    model = softmpm.build(made, device=device, dtype=torch.float64, formulation="reference")
    start, params = inward(model, 20.0), model.params()
    rows = torch.tensor([[[0.1, 0.2]], [[0.3, -0.2]]], dtype=torch.float64, device=model.device)
    with pytest.raises(softmpm.UnstableError, match="times its running stable step") as caught:
        softmpm.simulate(model, start, rows, params, substeps=4)
    error = caught.value
    assert error.kind == "step" and 1 <= error.substep < 8, error
    own, given = (softmpm.Params(*(t.cpu() for t in params)), softmpm.State(*(t.cpu() for t in start[:4])))
    u, v = lagrangian.project(made, given, own)
    for s in range(error.substep + 1):
        row = rows[s // 4].cpu()
        named = above(made, lagrangian.evaluate(made, u, v).F[0], row[0].tolist(), made.dt)
        assert bool(named.any()) == (s == error.substep)
        u, v = lagrangian.simulate(made, u, v, row[None], own, substeps=1)
    assert error.particle == int(named.nonzero()[0])
    ratio = float(re.search(r"(\S+) times its running", str(error))[1])
    assert 1.0 <= ratio < 1.3


def test_legal_runs_are_not_stopped(device):
    """A body that shrinks to half its length, pulled by muscles and viscous: at 0.95 of the least limit of the run nothing fires."""
    made = squeezed()
    made = dataclasses.replace(made, dt=0.2 * softmpm.stable_dt(made))
    rows = torch.tensor([[[0.3, 0.8]], [[0.9, -0.2]]], dtype=torch.float64)
    quiet = softmpm.build(
        made, device=device, dtype=torch.float64, formulation="reference", alarms=softmpm.Alarms(step=None)
    )
    state, states = inward(quiet, 25.0), []
    for s in range(40):
        states.append(state.F[0].cpu())
        row = rows[s // 20][None].to(quiet.device)
        state = softmpm.simulate(quiet, state, row, quiet.params(), substeps=1)
    assert torch.linalg.svdvals(torch.stack(states)).min() < 0.6
    low, high = made.dt / 5, 10 * made.dt
    while high / low > 1.001:
        dt = math.sqrt(low * high)
        fires = any(bool(above(made, F, rows[s // 20][0].tolist(), dt).any()) for s, F in enumerate(states))
        low, high = (low, dt) if fires else (dt, high)
    substeps = math.ceil(20 * made.dt / (0.95 * low))
    made = dataclasses.replace(made, dt=0.95 * low)
    model = softmpm.build(made, device=device, dtype=torch.float64, formulation="reference")
    start, rows = inward(model, 25.0), rows.to(model.device)
    end = softmpm.simulate(model, start, rows, model.params(), substeps=substeps)
    assert torch.linalg.svdvals(end.F).min() > 0.3


def test_an_impact_that_crushed_a_body_is_stopped_by_name(device):
    """At 0.9 of the limit at rest a block that hits a floor is stopped before it collapses; a shorter step passes."""
    box = softmpm.box((0.5, 0.25), (0.75, 0.5), spacing=1 / 32)
    made = softmpm.Scene(
        grid=softmpm.Grid(shape=(24, 24), spacing=1 / 16),
        bodies=[softmpm.Body(box, softmpm.BarrierCorotated(density=1.0, young=100.0, poisson=0.3))],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.25)],
        dt=1.0,
    )

    def falls(dt: float, **settings) -> softmpm.State:
        model = softmpm.build(
            dataclasses.replace(made, dt=dt),
            device=device,
            dtype=torch.float64,
            formulation="reference",
            **settings,
        )
        state = model.rest()
        state.v[..., 1] = -8.0
        return softmpm.simulate(model, state, None, model.params(), substeps=math.ceil(0.1 / dt))

    dt = 0.9 * float(softmpm.stable_dt(made))
    with pytest.raises(softmpm.UnstableError, match="has collapsed|is inverted"):
        falls(dt, alarms=softmpm.Alarms(step=None))
    with pytest.raises(softmpm.UnstableError, match="times its running stable step") as caught:
        falls(dt)
    assert caught.value.kind == "step"
    assert torch.linalg.det(falls(0.15 * dt).F).min() > 0.1
