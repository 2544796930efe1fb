"""The largest stable step is the largest: just below it a particle rests, just above it flies apart."""

import copy
import dataclasses
import math
import pickle
import warnings

import numpy as np
import pytest
import torch

import softmpm
from softmpm.building import StabilityWarning
from softmpm.oracle import stress as oracle_stress
from softmpm.scene.actuators import Muscle, Pressure
from softmpm.scene.materials import FixedCorotated, NeoHookean, StableNeoHookean
from softmpm.scene.scene import Body, Grid, Particles, Scene
from softmpm.stability import need_stable, running_limit, stable_dt

DX, RHO = 0.1, 2.0


def scene(material, dim=2, muscles=(), count=4, dt=1e-3, seed=0) -> Scene:
    positions = np.random.default_rng(seed).uniform(0.25, 0.45, (count, dim))
    grid = Grid(shape=(9,) * dim, spacing=DX)
    return Scene(grid=grid, bodies=[Body(Particles(positions, 1e-4), material)], muscles=muscles, dt=dt)


def muscle(direction, strength, particles=(0,)) -> Muscle:
    return Muscle(particles=list(particles), direction=direction, strength=strength)


def stencil(x):
    """Weights, places and numbers of the 3ᵈ nodes around x, by the definition of the quadratic B-spline."""
    nodes = np.stack(
        np.meshgrid(*[np.floor(x[a] / DX - 0.5) + np.arange(3) for a in range(len(x))], indexing="ij"), -1
    )
    nodes = nodes.reshape(-1, len(x))
    s = np.abs(x / DX - nodes)
    return (
        np.where(s < 0.5, 0.75 - s**2, 0.5 * (1.5 - s) ** 2).prod(axis=1),
        nodes * DX - x,
        nodes.astype(int),
    )


def tau(F, material, muscles):
    """Kirchhoff stress of a nearly resting F, written out once more, in NumPy."""
    E, nu, eye = material.young, material.poisson, np.eye(len(F))
    mu, lam, J = E / (2 + 2 * nu), E * nu / ((1 + nu) * (1 - 2 * nu)), np.linalg.det(F)
    if isinstance(material, NeoHookean):
        stress = mu * (F @ F.T - eye) + lam * math.log(J) * eye
    else:
        U, _, Vt = np.linalg.svd(F)
        stress = 2 * mu * (F - U @ Vt) @ F.T + lam * (J - 1) * J * eye
    return stress + sum(abs(m.strength) * np.outer(F @ m.direction, F @ m.direction) for m in muscles)


def growth(material, muscles, dim, dt, steps, rng):
    """Growth of the strain of one particle, alone on the grid, from 1e-9: the whole step in NumPy."""
    x, v, C, F = rng.uniform(0.3, 0.4, dim), np.zeros(dim), np.zeros((dim, dim)), np.eye(dim)
    noise = rng.normal(size=(dim, dim))
    F, held, largest = F + 1e-9 * (noise + noise.T), tau(F, material, muscles), 0.0
    eta = material.viscosity
    for _ in range(steps):
        w, r, _ = stencil(x)
        force = (
            (tau(F, material, muscles) - held + eta * F @ F.T @ (C + C.T) @ F @ F.T)
            * 4
            / (material.density * DX**2)
        )  # about the activated state
        node_v = v + r @ (C - dt * force).T  # the node's mass is w m: both weights cancel
        v, C = w @ node_v, 4 / DX**2 * np.einsum("n,ni,nj->ij", w, node_v, r)
        x, F = x + dt * v, (np.eye(dim) + dt * C) @ F
        largest = max(largest, np.abs(F - np.eye(dim)).max() / 1e-9)
        if largest > 1e4:
            break
    return largest


@pytest.mark.parametrize("law", [NeoHookean, FixedCorotated])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("poisson", [-0.5, 0.0, 0.3, 0.49])
@pytest.mark.parametrize("actuation", [(), (40.0,), (150.0, -60.0)])
def test_limit_of_a_particle_alone(law, dim, poisson, actuation):
    """At 0.99 of the limit a small strain stays small for 300 steps, at 1.01 it grows 1000-fold within 60."""
    material = law(density=RHO, young=100.0, poisson=poisson)
    directions = [(0.6, 0.8, 0.0)[:dim], (0.2, 1.0, -0.7)[:dim]]
    muscles = [muscle(d, s) for d, s in zip(directions, actuation, strict=False)]
    limit = stable_dt(scene(material, dim, muscles))
    rng = np.random.default_rng(1)
    assert growth(material, muscles, dim, 0.99 * limit, 300, rng) < 100
    assert growth(material, muscles, dim, 1.01 * limit, 60, rng) > 1000


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("actuation", [(), (150.0, -60.0)])
@pytest.mark.parametrize("viscosity", [0.05, 0.5, 20.0])
def test_limit_of_a_viscous_particle(dim, actuation, viscosity):
    """The same with a viscosity that takes little, half or nearly all of the step: the limit is neither too large nor too small."""
    material = StableNeoHookean(density=RHO, young=100.0, viscosity=viscosity)
    plain = NeoHookean(density=RHO, young=100.0, viscosity=viscosity)  # the same at rest
    muscles = [
        muscle(d[:dim], s) for d, s in zip(((0.6, 0.8, 0.0), (0.2, 1.0, -0.7)), actuation, strict=False)
    ]
    limit = stable_dt(scene(material, dim, muscles))
    assert f"viscosity {viscosity:g} Pa s): stiffness and damping" in limit.limit or actuation
    assert limit == pytest.approx(stable_dt(scene(plain, dim, muscles)), rel=1e-12)
    rng = np.random.default_rng(1)
    assert growth(plain, muscles, dim, 0.99 * limit, 300, rng) < 100
    assert (
        growth(plain, muscles, dim, 1.01 * limit, 1200, rng) > 1000
    )  # each substep multiplies by 1.02 at least


@pytest.mark.parametrize("dim", [2, 3])
def test_closed_form_of_a_viscous_particle(dim):
    """At rest K dt² + 4η dt = ρ dx², with the elastic stiffness K; running_limit agrees, and falls as a stretch grows."""
    mu, lam = 50.0 / 1.3, 30.0 / (1.3 * 0.4)
    for viscosity in (0.0, 1e-3, 1.0, 1e3):
        made = scene(NeoHookean(density=RHO, young=100.0, viscosity=viscosity), dim)
        dt = stable_dt(made)
        assert (dim * lam + 2 * mu) * dt**2 + 4 * viscosity * dt == pytest.approx(RHO * DX**2, rel=1e-12)
        limits = [
            running_limit(made, 0, mu, lam, RHO, s * torch.eye(dim, dtype=torch.float64), [], viscosity)
            for s in (1.0, 1.5, 2.0)
        ]
        assert limits[0] == pytest.approx(dt, rel=1e-12) and limits[0] > limits[1] > limits[2]
        deformed = stable_dt(made, stretch=2.0 * torch.eye(dim))
        assert limits[2] == pytest.approx(deformed, rel=1e-12)


@pytest.mark.parametrize(
    ("stretch", "said"),
    [
        (torch.eye(3), r"shape \(2, 2\) or \(4, 2, 2\), got \(3, 3\)"),
        (torch.ones(3, 2, 2), r"shape \(2, 2\) or \(4, 2, 2\), got \(3, 2, 2\)"),
        (torch.tensor([[1.0, math.nan], [0.0, 1.0]]), r"stretch must be finite, got \[nan\]"),
        (torch.diag(torch.tensor([-1.0, 1.0])), "positive determinant for NeoHookean, .* got -1"),
        (torch.zeros(4, 2, 2), "positive determinant for NeoHookean, .* got 0"),
    ],
)
def test_deformations_without_a_limit_are_refused(stretch, said):
    """A law that survives inversion has a limit there."""
    with pytest.raises(ValueError, match=said):
        stable_dt(scene(NeoHookean(density=RHO, young=100.0)), stretch=stretch)
    if "determinant" in said and stretch.any():
        assert stable_dt(scene(StableNeoHookean(density=RHO, young=100.0)), stretch=stretch) > 0


@pytest.mark.parametrize("dim", [2, 3])
def test_limit_under_pressure(dim):
    """Suction adds d p J to the stiffness, pressure of either sign counts as suction in stable_dt and has its sign in running_limit."""
    material, mu, lam = NeoHookean(density=RHO, young=100.0), 50.0 / 1.3, 30.0 / (1.3 * 0.4)
    chamber, fibres = Pressure(particles=[0, 2], strength=20.0), muscle((1.0, 0.5, 0.2)[:dim], 15.0, (1,))
    made = scene(material, dim, [fibres, chamber])
    dt, at_rest = stable_dt(made), torch.eye(dim, dtype=torch.float64)
    assert dt == pytest.approx(DX * math.sqrt(RHO / (2 * mu + dim * (lam + 20.0))), rel=1e-12)
    assert "under pressure 1 (20 Pa) at full activation" in dt.limit
    for pressure in (20.0, -20.0):
        got = running_limit(made, 2, mu, lam, RHO, at_rest, [15.0, pressure])
        K = max(2 * mu + dim * (lam - pressure), 2 * mu)
        assert got == pytest.approx(DX * math.sqrt(RHO / K), rel=1e-12)
    F = 1.2 * at_rest
    stretched = 2 * mu * 1.44 + dim * (lam + 20.0 * 1.2**dim)
    assert stable_dt(made, stretch=F) == pytest.approx(DX * math.sqrt(RHO / stretched), rel=1e-12)
    assert stable_dt(made, stretch=1.2) < dt


def test_viscous_limit_is_the_largest_step():
    """For random stretched particles, Δt² A + 2Δt V reaches ρ dx² at the limit to 1e-12, and at no smaller step, by a scan."""
    rng, rows = np.random.default_rng(3), 40
    F = torch.from_numpy(np.eye(3) + 0.4 * rng.normal(size=(rows, 3, 3)))
    made = scene(StableNeoHookean(density=RHO, young=100.0, viscosity=0.3), 3, count=rows)
    mu, lam = (torch.tensor(v, dtype=torch.float64) for v in (50.0 / 1.3, 30.0 / (1.3 * 0.4)))
    for p in range(rows):
        A = oracle_stress.tangent(made.bodies[0].material, F[p], mu, lam)
        V = 0.3 * oracle_stress.viscous_tangent(F[p])
        dt = running_limit(made, p, mu.item(), lam.item(), RHO, F[p], [], 0.3)
        scan = torch.tensor([*np.linspace(0.01, 0.999, 60), 1.0], dtype=torch.float64)[:, None, None] * dt
        reach = torch.linalg.eigvalsh(scan**2 * A + 2 * scan * V)[:, -1] / (RHO * DX**2)
        assert reach[-1] == pytest.approx(1.0, rel=1e-12)
        assert reach[:-1].max() < 1


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
def test_closed_form(dim, poisson):
    """Without muscles the limit is dx · √(ρ / (dim·λ + 2μ)); four times the stiffness halve it."""
    material = NeoHookean(density=RHO, young=100.0, poisson=poisson)
    mu, lam = 50.0 / (1 + poisson), 100.0 * poisson / ((1 + poisson) * (1 - 2 * poisson))
    limit = stable_dt(scene(material, dim))
    assert limit == pytest.approx(DX * math.sqrt(RHO / (dim * lam + 2 * mu)), rel=1e-13)
    stiff = stable_dt(scene(dataclasses.replace(material, young=400.0), dim))
    assert stiff == pytest.approx(limit / 2, rel=1e-13)


def test_shared_nodes_are_no_faster():
    """Unlike particles that share nodes: the grid's fastest oscillation keeps to ω ≤ 2 / dt."""
    rng = np.random.default_rng(2)
    fastest = 0.0
    for _ in range(20):
        materials = [
            NeoHookean(density=rng.uniform(0.1, 9), young=rng.uniform(1, 99), poisson=p) for p in (0.1, 0.4)
        ]
        parts = [rng.uniform(0.3, rng.uniform(0.32, 0.6), (6, 2)) for _ in materials]
        bodies = [
            Body(Particles(x, 1e-3 * rng.uniform(0.2, 1.0, 6)), m)
            for x, m in zip(parts, materials, strict=True)
        ]
        limit = stable_dt(Scene(grid=Grid(shape=(9, 9), spacing=DX), bodies=bodies, dt=1e-3))
        mass, stiffness = np.zeros(81), np.zeros((162, 162))
        for body in bodies:
            m = body.material
            mu, lam = (
                m.young / (2 + 2 * m.poisson),
                m.young * m.poisson / ((1 + m.poisson) * (1 - 2 * m.poisson)),
            )
            for x, volume in zip(body.particles.positions, body.particles.volume, strict=True):
                w, r, node = stencil(x)
                number = node[:, 0] * 9 + node[:, 1]
                mass[number] += w * m.density * volume
                strain = np.zeros((2, 2, 162))  # of the nodes' displacements
                for a in range(2):
                    for b in range(2):
                        np.add.at(strain[a, b], 2 * number + a, 2 / DX**2 * w * r[:, b])
                        np.add.at(strain[b, a], 2 * number + a, 2 / DX**2 * w * r[:, b])
                trace = strain[0, 0] + strain[1, 1]
                stiffness += volume * (
                    2 * mu * np.einsum("abi,abj->ij", strain, strain) + lam * np.outer(trace, trace)
                )
        used = np.repeat(mass > 0, 2)
        root = 1 / np.sqrt(np.repeat(mass, 2)[used])
        omega = math.sqrt(np.linalg.eigvalsh(root[:, None] * stiffness[np.ix_(used, used)] * root)[-1])
        fastest = max(fastest, omega * limit / 2)
        assert omega * limit <= 2 * (1 + 1e-9)
    assert fastest > 0.7  # near enough to see an error


def test_names_what_limits():
    """The text names the body, its material, the muscles at the limiting particle, and that particle."""
    soft, stiff = NeoHookean(density=1.0, young=10.0), FixedCorotated(density=1.0, young=25.0, poisson=0.2)
    points = np.random.default_rng(0).uniform(0.25, 0.45, (6, 2))
    bodies = [Body(Particles(points[:4], 1e-4), soft), Body(Particles(points[4:], 1e-4), stiff)]
    made = Scene(grid=Grid(shape=(9, 9), spacing=DX), bodies=bodies, dt=1e-3)
    plain = stable_dt(made)
    assert "body 1 (FixedCorotated, young 25 Pa, poisson 0.2, density 1 kg/m³)" in plain.limit
    assert "muscle" not in plain.limit
    muscles = [muscle((0, 1), 6.0, (0, 1, 2)), muscle((1, 0), 1.0, (4,)), muscle((0, 1), -7.0, (2, 3))]
    driven = stable_dt(dataclasses.replace(made, muscles=muscles))
    assert "body 0 (NeoHookean, young 10 Pa" in driven.limit and driven < plain
    assert "under muscle 0 (6 Pa) + muscle 2 (-7 Pa) at full activation, as at particle 2" in driven.limit


def test_each_particle_has_its_own_muscles():
    """The limit is the smallest over particles, each with the muscles that it is in: overlap counts."""
    material, at = (
        NeoHookean(density=RHO, young=100.0),
        lambda *muscles: stable_dt(scene(material, muscles=muscles)),
    )
    one, twice = at(muscle((1, 0), 50.0)), at(muscle((1, 0), 100.0))
    assert at(muscle((1, 0), 50.0, (0,)), muscle((1, 0), 50.0, (1, 3))) == one
    assert at(muscle((1, 0), 50.0, (0, 1)), muscle((1, 0), 50.0, (1, 3))) == pytest.approx(twice, rel=1e-13)
    assert twice < one < at()


@pytest.mark.parametrize("cells, holds", [(1.0, True), (4 / 3, True), (1.5, False), (2.4, False)])
@pytest.mark.parametrize("dim", [2, 3])
def test_warns_of_bodies_that_do_not_hold(dim, cells, holds):
    """A body that is driven apart comes back beyond its rest; where it does not, build says that its particles are too far apart."""
    block = softmpm.box((8 / 32,) * dim, (20 / 32,) * dim, spacing=cells / 32)
    made = Scene(
        grid=Grid(shape=(32,) * dim, spacing=1 / 32),
        bodies=[Body(block, NeoHookean(density=1.0, young=100.0))],
        dt=1.0,
    )
    made = dataclasses.replace(made, dt=0.3 * stable_dt(made))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = softmpm.build(made, device="cpu")
    assert (not holds) == any(
        f"body 0: the mean particle spacing is {cells:.3g} cells" in str(one.message) for one in caught
    )
    assert all(one.category is StabilityWarning and one.filename == __file__ for one in caught)

    def width(state):
        arm, rest = (x - x.mean() for x in (state.x[0, :, 0], model.positions[:, 0]))
        return float((arm * rest).sum() / (rest * rest).sum())

    state = model.rest()
    state.v[:] = state.x - state.x.mean(dim=1, keepdim=True)  # 1 /s: all of it is driven apart alike
    widths = []
    for _ in range(int(0.2 / (10 * made.dt))):
        state = softmpm.simulate(model, state, None, model.params(), substeps=10)
        widths.append(width(state))
    assert max(widths) > 1.005 and (min(widths) < 0.998) == holds


def test_refuses_only_above():
    """A scene at its limit builds; above it the error says what limits, which step to take, and how to run it all the same."""
    made = scene(NeoHookean(density=RHO, young=100.0))
    limit = stable_dt(made)
    need_stable(dataclasses.replace(made, dt=limit.dt), 1.0)
    above = dataclasses.replace(made, dt=1.0001 * limit.dt)
    with pytest.raises(
        ValueError,
        match=r"dt = .* is 1.0001 times the largest stable one, .* set by body 0 .*within 1\. Use a dt of about",
    ):
        softmpm.build(above, device="cpu")
    softmpm.build(above, device="cpu", alarms=softmpm.Alarms(step=None))
    softmpm.build(above, device="cpu", alarms=softmpm.Alarms(step=1.1))
    careful, below = softmpm.Alarms(step=0.4), dataclasses.replace(made, dt=0.5 * limit.dt)
    with pytest.raises(
        ValueError, match=r"is 0.5 times the largest .* within 0.4\. Use a dt of about"
    ) as refused:
        softmpm.build(below, device="cpu", alarms=careful)
    advised = float(str(refused.value).split("dt of about ")[1].split(" s")[0])
    softmpm.build(dataclasses.replace(made, dt=advised), device="cpu", alarms=careful)


def test_a_ratio_just_above_its_limit_is_told_from_it():
    """A message of a ratio of 1 that must stay within 1 would explain nothing."""
    made = scene(NeoHookean(density=RHO, young=100.0))
    made = dataclasses.replace(made, dt=stable_dt(made))
    model = softmpm.build(made, device="cpu", dtype=torch.float64)
    params = model.params()
    with pytest.raises(softmpm.UnstableError, match=r"1\.00005 times its running stable step .* within 1\."):
        softmpm.simulate(
            model, model.rest(), None, params._replace(density=params.density / 1.0001), substeps=1
        )


def test_is_a_number():
    """The limit computes like a float, becomes a scene's dt, and keeps its text through copies."""
    made = scene(NeoHookean(density=RHO, young=100.0))
    limit = stable_dt(made)
    assert type(limit.dt) is float and limit.dt == limit and 0.5 * limit == limit.dt / 2
    assert dataclasses.replace(made, dt=limit).dt == limit
    assert stable_dt(dataclasses.replace(made, dt=1.0)) == limit
    for other in (copy.deepcopy(limit), pickle.loads(pickle.dumps(limit))):
        assert other == limit and other.limit == limit.limit


@pytest.mark.parametrize(
    "particles, direction, said",
    [
        ([0, 99], (1, 0), "muscle 0 names particle 99, but the scene's"),
        ([-1], (1, 0), "muscle 0 names particle -1"),
        ([0], (1, 0, 0), "muscle 0 'leg' direction needs 2 numbers"),
    ],
)
def test_a_scene_that_cannot_be_built_has_no_limit(particles, direction, said):
    """It is asked for before build, and says what build would say."""
    name = "leg" if len(direction) == 3 else ""
    muscle = Muscle(particles=particles, direction=direction, strength=1.0, name=name)
    body = Body(Particles(np.array([[0.4, 0.4], [0.5, 0.5]]), 0.01), NeoHookean(density=1.0, young=10.0))
    scene = Scene(grid=Grid(shape=(9, 9), spacing=0.1), bodies=[body], muscles=[muscle], dt=1e-3)
    with pytest.raises(ValueError, match=said):
        stable_dt(scene)


def test_a_stiffness_beyond_all_numbers_is_named():
    """Instead of an error of the eigenvalue solver."""
    fibres = muscle((1, 0), 1e308)
    with pytest.raises(
        ValueError, match=r"stiffness of body 0, .* is beyond .* active stress of up to 1e\+308 Pa"
    ):
        stable_dt(scene(NeoHookean(density=1.0, young=10.0), muscles=[fibres, fibres]))


@pytest.mark.parametrize(
    ("name", "value"),
    [("young", -1.0), ("young", math.nan), ("poisson", 0.5), ("poisson", -1.0), ("density", 0.0)],
)
def test_a_material_outside_its_bounds_has_no_step(name, value):
    """It is refused by the name of the parameter, as by ``simulate``."""
    made = scene(NeoHookean(density=1.0, young=100.0))
    params = softmpm.Params(torch.tensor(100.0), torch.tensor(0.3), torch.tensor(1.0))
    stable_dt(made, params)
    with pytest.raises(
        ValueError, match=rf"params.{name} must be .*, but params.{name}\[0, 0\] is {value:g}"
    ):
        stable_dt(made, params._replace(**{name: torch.tensor(value)}))


@pytest.mark.parametrize(
    "young, density, viscosity",
    [(10.0, 1.0, 1e200), (10.0, 1e-308, 1.0), (1e308, 1.0, 1.0), (1e300, 1e-300, 0.0)],
)
def test_a_step_beyond_all_numbers_is_named(young, density, viscosity):
    """A rate or a stiffness that overflows, and a step that vanishes, by which build would divide."""
    made = scene(NeoHookean(density=density, young=young, viscosity=viscosity))
    with pytest.raises(ValueError, match="or that by its density, is beyond") as caught:
        stable_dt(made)
    assert f"got young {young:.4g} Pa, viscosity {viscosity:.4g} Pa s, an active stress" in str(caught.value)
    assert f"got young {young:.4g} Pa, viscosity {viscosity:.4g} Pa s, an active stress" in str(caught.value)
