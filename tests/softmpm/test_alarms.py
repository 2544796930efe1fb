"""Alarms name what goes wrong, at the substep at which it does, and nothing else."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers import LAWS, bar

import softmpm
from softmpm.oracle import stress as oracle_stress
from softmpm.stability import running_limit


def run(model, start=None, activation=None, substeps=100, **options):
    start = model.rest() if start is None else start
    return softmpm.simulate(model, start, activation, model.params(), substeps=substeps, **options)


def thrown_apart(model, speed: float) -> softmpm.State:
    """Its two ends fly apart at this speed [m/s]."""
    start = model.rest()
    start.v[..., 0] = speed * torch.sign(start.x[..., 0] - 0.5)
    return start


def largest_gap(model, state) -> float:
    """Largest distance of neighbours at rest [cells], from all pairs within 1.2 spacings, in NumPy."""
    rest, x = model.positions.cpu().double().numpy(), state.x[0].cpu().double().numpy()
    apart = np.linalg.norm(rest[:, None] - rest[None], axis=-1)
    pairs = np.argwhere(np.triu(apart < 1.2 * np.sort(apart, axis=1)[:, 1].mean(), k=1))
    return np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1).max() / model.scene.grid.spacing


@pytest.mark.parametrize("law", ["neo_hookean", "fixed_corotated"])
def test_a_torn_body_is_named_at_its_substep(law, scheme, device):
    """Neighbours are within 1.4 cells before the substep of the error and beyond after it."""
    model = softmpm.build(bar(law), device=device, scheme=scheme)
    with pytest.raises(softmpm.UnstableError) as caught:
        run(model, thrown_apart(model, 8.0), substeps=600)
    error = caught.value
    assert error.kind == "torn" and "its neighbour at rest" in str(error), error
    quiet = softmpm.build(
        model.scene, device=device, scheme=scheme, alarms=softmpm.Alarms(gap=None, step=None)
    )
    before = run(quiet, thrown_apart(quiet, 8.0), substeps=error.substep)
    after = run(quiet, thrown_apart(quiet, 8.0), substeps=error.substep + 1)
    assert largest_gap(quiet, before) <= 1.4 * (1 + 1e-4) and largest_gap(quiet, after) > 1.4 * (1 - 1e-4)


def test_a_whole_body_raises_nothing(scheme, device):
    """The same bar at a tenth of the speed, and under its muscles, comes back in one piece."""
    model = softmpm.build(bar(), device=device, scheme=scheme)
    end = run(model, thrown_apart(model, 0.8), substeps=600)
    assert largest_gap(model, end) < 1.0
    activation = torch.full((1, 1, 2), 0.5, device=model.device)
    assert largest_gap(model, run(model, None, activation, 600)) < 1.0


@pytest.mark.parametrize("law", list(LAWS))
def test_a_collapsing_body_is_named_in_every_law(law, scheme, device):
    """An active stress of six times Young's modulus raises before the bar is a point; fixed corotated bodies collapse silently."""
    model = softmpm.build(bar(law), device=device, scheme=scheme, alarms=softmpm.Alarms(step=None))
    activation = torch.full((1, 1, 2), 20.0, device=model.device)
    with pytest.raises(softmpm.UnstableError) as caught:
        run(model, None, activation, 3000)
    assert caught.value.kind in ("collapsed", "inverted", "torn", "left_grid", "not_finite")
    quiet = bar("fixed_corotated")
    loose = softmpm.build(
        quiet, device=device, scheme=scheme, alarms=softmpm.Alarms(collapse=None, gap=None, step=None)
    )
    if law == "fixed_corotated":
        assert caught.value.kind in ("collapsed", "inverted")
        assert torch.linalg.det(run(loose, None, activation, 3000).F).min() < 0.05


@pytest.mark.parametrize("what", ["material", "activation", "start"])
def test_the_step_limit_knows_what_a_call_is_given(what, scheme, device):
    """Young's modulus times 16, an activation of 40 and a start stretched to 6 each take a smaller step than the scene alone."""
    model = softmpm.build(bar(), device=device, scheme=scheme)
    start, params, activation = model.rest(), model.params(), torch.zeros(1, 1, 2, device=model.device)
    if what == "material":
        params = params._replace(young=16 * params.young)
    elif what == "activation":
        activation += 40.0
    else:
        start.F[..., 0, 0] = 6.0
    with pytest.raises(softmpm.UnstableError) as caught:
        softmpm.simulate(model, start, activation, params, substeps=10)
    assert caught.value.kind == "step" and "in the start state" in str(caught.value)
    assert "running stable step" in str(caught.value) and caught.value.substep == 0


def test_the_step_limit_knows_the_viscosity_of_a_call(scheme, device):
    """K dt² + 4η dt ≤ ρ dx²: 0.98 of the largest viscosity runs, and 1.02 of it is named at the start, with its value."""
    scene = bar(muscles=())
    model = softmpm.build(scene, device=device, scheme=scheme, inputs=("viscosity",))
    inertia, K = scene.grid.spacing**2, 100.0 / 1.3 + 2 * 30.0 / (1.3 * 0.4)
    largest = (inertia - K * scene.dt**2) / (4 * scene.dt)
    for factor in (0.98, 1.02):
        inputs = softmpm.Inputs(viscosity=torch.full((1, 1), factor * largest, device=model.device))
        if factor < 1:
            run(model, substeps=3, inputs=inputs)
        else:
            with pytest.raises(
                softmpm.UnstableError, match=f"viscosity {factor * largest:.4g} Pa s"
            ) as caught:
                run(model, substeps=3, inputs=inputs)
            assert caught.value.kind == "step" and "in the start state" in str(caught.value)


def test_the_step_limit_is_stated_with_the_direction_of_a_call(scheme, device):
    """A fibre direction of the call gives the message of a scene that has this direction."""
    particles = range(len(bar().bodies[0].particles))
    messages = []
    for own, given in (((1.0, 0.0), None), ((0.0, 1.0), (2.0, 0.0))):
        scene = bar(muscles=[softmpm.Muscle(particles=particles, direction=own, strength=30.0)])
        model = softmpm.build(scene, device=device, scheme=scheme, inputs=("direction",))
        start = model.rest()
        start.F[..., 0, 0] = 2.0
        inputs = None if given is None else softmpm.Inputs(direction=torch.tensor([[given]]).to(start.F))
        with pytest.raises(softmpm.UnstableError, match="running stable step") as caught:
            run(model, start, torch.full((1, 1, 1), 10.0, device=model.device), 1, inputs=inputs)
        messages.append(str(caught.value))
    assert messages[0] == messages[1]


@pytest.mark.parametrize("kind", [softmpm.Muscle, softmpm.Pressure])
def test_the_step_limit_knows_every_control_step(kind, scheme, device):
    """An active stress of one control step that stiffens beyond the limit is found at the start; of the other sign it is none."""
    fibres = {"direction": (1.0, 0.0)} if kind is softmpm.Muscle else {}
    count = len(bar().bodies[0].particles)
    actuator = kind(particles=range(count), strength=30.0, **fibres)
    model = softmpm.build(bar(muscles=[actuator]), device=device, scheme=scheme)
    stiffer = 1.0 if kind is softmpm.Muscle else -1.0
    activation = torch.zeros(3, 1, 1, device=model.device)
    activation[1] = 40.0 * stiffer
    with pytest.raises(softmpm.UnstableError) as caught:
        run(model, None, activation, substeps=1)
    assert caught.value.kind == "step" and "in the start state" in str(caught.value)
    activation[1] = -0.1 * stiffer
    run(model, None, activation, substeps=1)


def test_the_step_limit_follows_the_run(scheme, device):
    """A clamped bar stretches under a heavy load until dt is above its running limit; the substep is the first at which it is."""
    wall = softmpm.Wall(normal=(1.0, 0.0), offset=0.3, contact="stick")
    scene = bar(spacing=1 / 128, muscles=(), walls=[wall], gravity=(200.0, 0.0))
    scene = dataclasses.replace(scene, dt=0.9 * softmpm.stable_dt(scene))
    model = softmpm.build(scene, device=device, scheme=scheme)
    with pytest.raises(softmpm.UnstableError) as caught:
        run(model, substeps=300)
    error = caught.value
    assert error.kind == "step" and error.substep > 0, error
    quiet = softmpm.build(scene, device=device, scheme=scheme, alarms=softmpm.Alarms(step=None))
    for substeps, above in ((error.substep, False), (error.substep + 1, True)):
        end = run(quiet, substeps=substeps)
        assert (scene.dt > softmpm.stable_dt(scene, stretch=end.F[0])) == above


@pytest.mark.parametrize("law", list(LAWS))
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("poisson", [-0.5, 0.0, 0.3, 0.49])
def test_step_alarm_is_the_largest_eigenvalue(law, dim, poisson, device):
    """At random deformations 0.99 of the exact limit passes in all particles, and 1.02 of it is named in each: K is within 4 %."""
    rng, count, dt, spacing = np.random.default_rng(3), 16, 1e-4, 0.1
    particles = softmpm.Particles(rng.uniform(0.3, 0.6, (count, dim)), 1e-4)
    directions = [(0.6, 0.8, 0.0)[:dim], (0.2, 1.0, -0.7)[:dim]]
    muscles = [
        softmpm.Muscle(particles=range(count), direction=d, strength=s)
        for d, s in zip(directions, (30.0, -12.0), strict=True)
    ]
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(10,) * dim, spacing=spacing),
        bodies=[softmpm.Body(particles, LAWS[law](density=2.0, young=100.0, poisson=poisson))],
        muscles=muscles,
        dt=dt,
    )
    model = softmpm.build(scene, device=device, worlds=count, alarms=softmpm.Alarms(gap=None, collapse=1e-3))
    turns = np.linalg.qr(rng.normal(size=(2, count, dim, dim)))[0]
    F = turns[0] @ (np.exp(rng.uniform(math.log(0.3), math.log(4.0), (count, dim)))[..., None] * turns[1])
    F[np.linalg.det(F) < 0, 0] *= -1
    mu, lam = 50.0 / (1 + poisson), 100.0 * poisson / ((1 + poisson) * (1 - 2 * poisson))
    for activation in (0.0, 1.0):
        active_stress = [activation * muscle.strength for muscle in muscles]
        unit = [
            running_limit(scene, p, mu, lam, 1.0, torch.from_numpy(F[p]), active_stress) for p in range(count)
        ]
        limit = torch.tensor(unit).clamp(max=1.0).to(model.device)  # at a density of 1 kg/m³
        start, given = model.rest(), torch.full((1, count, 2), activation, device=model.device)
        start.F[:] = torch.from_numpy(F).to(start.F)
        ratio = torch.where(torch.eye(count, device=model.device) > 0, 1.02, 0.99).expand(count, count)
        for density, named in ((dt / (0.99 * limit), 0), (dt / (ratio * limit), int((limit < 1).sum()))):
            failures = softmpm.Failures("freeze")
            params = model.params()._replace(density=(density**2).expand(count, count))
            softmpm.simulate(model, start, given, params, substeps=1, failures=failures)
            at_start = [error for error in failures.errors if "start state" in str(error)]
            assert len(at_start) == named
            assert all(error.kind == "step" and error.particle == error.world for error in at_start)


@pytest.mark.parametrize("law", list(LAWS))
@pytest.mark.parametrize("dim", [2, 3])
def test_tangent_is_the_derivative_of_the_stress(law, dim):
    """A[G] = d/dε τ((I + εG) F) by central differences, also where principal stretches are equal."""
    rng = np.random.default_rng(1)
    material, basis = LAWS[law](density=1.0, young=1.0), oracle_stress.strains(dim)
    mu, lam, h = torch.tensor(3.0, dtype=torch.float64), torch.tensor(5.0, dtype=torch.float64), 1e-5
    F = torch.from_numpy(np.eye(dim) + 0.3 * rng.normal(size=(3, dim, dim)))
    F = torch.cat(
        [F, torch.eye(dim, dtype=torch.float64)[None], 1.7 * torch.eye(dim, dtype=torch.float64)[None]]
    )
    F = F[torch.linalg.det(F) > 0]
    stress, d = oracle_stress.LAWS[type(material)], torch.from_numpy(rng.normal(size=dim))
    A, M = (
        oracle_stress.tangent(material, F, mu.expand(len(F)), lam.expand(len(F))),
        oracle_stress.muscle_tangent(F, d),
    )
    eye = torch.eye(dim, dtype=torch.float64)
    for col, G in enumerate(basis):
        ends = [(eye + s * h * G) @ F for s in (1, -1)]
        for got, values in (
            (A, [stress(end, mu.expand(len(F)), lam.expand(len(F))) for end in ends]),
            (
                M,
                [
                    oracle_stress.muscle_stress(end, d, torch.ones(len(F), dtype=torch.float64))
                    for end in ends
                ],
            ),
        ):
            slope = (values[0] - values[1]) / (2 * h)
            want = torch.einsum("kij,nij->nk", basis, slope)
            torch.testing.assert_close(got[:, :, col], want, rtol=1e-7, atol=1e-7)
