"""Quantities of a state: closed forms, laws of conservation, and gradients."""

import math
from itertools import pairwise

import pytest
import torch
from helpers import bar, busy_inputs, busy_scene, full_scene

import softmpm
from softmpm import Params, State

FORMULATIONS = pytest.mark.parametrize("formulation", ["moving", "reference"])
BY_MATERIAL = (
    softmpm.center_of_mass,
    softmpm.mean_velocity,
    softmpm.momentum,
    softmpm.kinetic_energy,
    softmpm.elastic_energy,
    softmpm.gravitational_energy,
)


def two_blocks(**changes) -> softmpm.Scene:
    """A light and a heavy block with the same material apart from the density, free."""
    bodies = [
        softmpm.Body(softmpm.box(low, high, spacing=1 / 32), softmpm.NeoHookean(density=density, young=50.0))
        for low, high, density in (((0.2, 0.5), (0.4, 0.7), 1.0), ((0.6, 0.5), (0.75, 0.8), 3.0))
    ]
    grid = softmpm.Grid(shape=(17, 17), spacing=1 / 16)
    return softmpm.Scene(**(dict(grid=grid, bodies=bodies, dt=1e-3) | changes))


def state_of(inputs: dict[str, torch.Tensor]) -> State:
    return State(*(inputs[name] for name in "xvCF"))


def params_of(inputs: dict[str, torch.Tensor]) -> Params:
    return Params(*(inputs[name] for name in Params._fields))


@FORMULATIONS
def test_falling_bodies(formulation):
    """After n substeps each centre of mass has fallen by n (n + 1)/2 g dt², the momentum is m g n dt, and the loss of potential energy
    is m g times the fall: ≤ 1e-12, with masses of the call in place of the scene's."""
    model = softmpm.build(
        two_blocks(gravity=(0.0, -2.0)), device="cpu", dtype=torch.float64, formulation=formulation
    )
    params = model.params()
    heavier = torch.where(model.body == 1, 5.0, 0.5) * (1 + model.positions[:, 0])
    params = params._replace(density=heavier)
    start, n = model.rest(), 60
    end = softmpm.simulate(model, start, None, params, substeps=n)
    fall = torch.tensor([0.0, -n * (n + 1) / 2 * 2.0 * 1e-6], dtype=torch.float64)
    for per_body in (False, True):
        before, after = (softmpm.center_of_mass(model, s, params, per_body=per_body) for s in (start, end))
        torch.testing.assert_close(after - before, fall.expand_as(after), rtol=0, atol=1e-13)
    mass = torch.stack([(heavier * model.volume)[model.body == k].sum() for k in (0, 1)])
    want = mass[:, None] * torch.tensor([0.0, -2.0 * n * 1e-3], dtype=torch.float64)
    got = softmpm.momentum(model, end, params, per_body=True)[0]
    torch.testing.assert_close(got, want, rtol=0, atol=1e-13)
    torch.testing.assert_close(softmpm.momentum(model, end, params)[0], want.sum(0), rtol=0, atol=1e-13)
    velocity = softmpm.mean_velocity(model, end, params, per_body=True)[0]
    torch.testing.assert_close(velocity, want / mass[:, None], rtol=0, atol=1e-13)
    potential = [softmpm.gravitational_energy(model, s, params, per_body=True)[0] for s in (start, end)]
    torch.testing.assert_close(potential[1] - potential[0], mass * 2.0 * fall[1], rtol=0, atol=1e-13)


def test_each_world_has_its_gravity_and_density():
    """Values that differ between worlds act on their own world; gravity of a call replaces that of the scene."""
    model = softmpm.build(two_blocks(), device="cpu", dtype=torch.float64, worlds=2)
    params, state = model.params(), model.rest()
    params = params._replace(density=params.density * torch.tensor([[1.0], [4.0]], dtype=torch.float64))
    g = torch.tensor([[0.0, -1.0], [-2.0, 0.0]], dtype=torch.float64)
    got = softmpm.gravitational_energy(model, state, params, g)
    x, mass = model.positions, model.mass
    torch.testing.assert_close(got, torch.stack([(mass * x[:, 1]).sum(), 8 * (mass * x[:, 0]).sum()]))
    assert (softmpm.gravitational_energy(model, state, params) == 0).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_kinetic_energy_is_that_of_the_nodes(dim):
    """Of a velocity field that is affine in each world: Σ m |v|²/2 of the nodes that particles give mass and momentum to."""
    model = softmpm.build(busy_scene(dim), device="cpu", dtype=torch.float64, worlds=2)
    generator = torch.Generator().manual_seed(3)
    A = torch.randn(2, 1, dim, dim, generator=generator, dtype=torch.float64)
    rest = model.rest()
    v = (A @ rest.x[..., None])[..., 0] + 0.3
    state = State(rest.x, v, A.expand_as(rest.C).clone(), rest.F)
    nodes = softmpm.rasterize(model, state)
    want = (nodes.mass * (nodes.velocity**2).sum(-1) / 2).flatten(1).sum(1)
    got = softmpm.kinetic_energy(model, state, model.params())
    torch.testing.assert_close(got, want, rtol=1e-12, atol=0)
    by_body = softmpm.kinetic_energy(model, state, model.params(), per_body=True)
    torch.testing.assert_close(by_body.sum(1), got)


def swinging(dt_share: float, law: type) -> tuple[softmpm.Model, State]:
    """A bar that begins its slowest stretching oscillation, with a strain of about 5 %."""
    scene = bar(muscles=[])
    body = softmpm.Body(scene.bodies[0].particles, law(density=1.0, young=100.0, poisson=0.3))
    scene = softmpm.Scene(grid=scene.grid, bodies=[body], dt=dt_share * 1e-3)
    model = softmpm.build(scene, device="cpu", dtype=torch.float64, formulation="reference")
    start = model.rest()
    phase = math.pi * (start.x[..., 0] - 0.5) / 0.5
    start.v[..., 0], start.C[..., 0, 0] = 0.5 * phase.sin(), 0.5 * math.pi / 0.5 * phase.cos()
    return model, start


@pytest.mark.parametrize("law", [softmpm.NeoHookean, softmpm.FixedCorotated])
def test_the_energy_of_a_free_oscillation(law):
    """Constant over a quarter of a period, in which elastic energy becomes most of it, to second order: half of dt, a quarter of the
    error, which is below 2.5e-3."""
    errors = []
    for share in (1.0, 0.5):
        model, state = swinging(share, law)
        params, kinetic, elastic = model.params(), [], []
        for _ in range(round(20 / share)):
            state = softmpm.simulate(model, state, None, params, substeps=1)
            kinetic.append(softmpm.kinetic_energy(model, state, params).item())
            elastic.append(softmpm.elastic_energy(model, state, params).item())
        mean = [(before + after) / 2 for before, after in pairwise(kinetic)]
        total = torch.tensor([sum(parts) for parts in zip(mean, elastic, strict=False)], dtype=torch.float64)
        assert max(elastic) > 0.5 * total[0]
        errors.append(((total - total[0]).abs().max() / total[0]).item())
    assert errors[0] < 2.5e-3 and 3.3 < errors[0] / errors[1] < 4.7


def test_the_moving_grid_conserves_nearly_as_much():
    """The same oscillation there loses less than 3 % in a quarter of a period."""
    model, start = swinging(1.0, softmpm.NeoHookean)
    model = softmpm.build(model.scene, device="cpu", dtype=torch.float64)
    params = model.params()
    end = softmpm.simulate(model, start, None, params, substeps=24)
    kinetic, elastic = (
        f(model, end, params).item() for f in (softmpm.kinetic_energy, softmpm.elastic_energy)
    )
    assert elastic > kinetic
    assert kinetic + elastic == pytest.approx(softmpm.kinetic_energy(model, start, params).item(), rel=0.03)


@pytest.mark.parametrize("dim", [2, 3])
def test_elastic_energy_of_mixed_laws(dim):
    """Bodies of every law, with two materials in turn, have the sums of their densities; a uniform stretch by hand."""
    model = softmpm.build(full_scene(dim), device="cpu", dtype=torch.float64, worlds=2)
    rest, params = model.rest(), model.params()
    F = rest.F * 1.1
    got = softmpm.elastic_energy(model, rest._replace(F=F), params, per_body=True)
    s, J = 1.1, 1.1**dim
    mu, lam = 80.0 / 2.6, 80.0 * 0.3 / (1.3 * 0.4)
    size = dim * (s**2 - 1)
    want = {
        softmpm.NeoHookean: mu * (size / 2 - math.log(J)) + lam / 2 * math.log(J) ** 2,
        softmpm.FixedCorotated: dim * mu * (s - 1) ** 2 + lam / 2 * (J - 1) ** 2,
        softmpm.BarrierCorotated: dim * mu * (s - 1) ** 2 + lam / 8 * (J - 1 / J) ** 2,
        softmpm.StableNeoHookean: 2 / 3 * mu * (size - math.log(1 + size / 4))
        + (lam + 5 / 6 * mu) / 2 * (J - 1) ** 2
        - mu * (J - 1),
    }
    for k, body in enumerate(model.scene.bodies):
        volume = model.volume[model.body == k].sum().item()
        assert got[1, k].item() == pytest.approx(volume * want[type(body.material)], rel=1e-12)
    torch.testing.assert_close(softmpm.elastic_energy(model, rest._replace(F=F), params), got.sum(1))


def test_strains():
    """Of simple shear and of a stretch; a rotation has none; and where the deviator vanishes the gradient is zero."""
    g, s, c = 0.3, math.sin(0.7), math.cos(0.7)
    turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    F = torch.stack(
        [turn @ torch.tensor([[1.0, g], [0.0, 1.0]]).double(), turn, torch.eye(2).double() * 1.2]
    )[None]
    F.requires_grad_()
    nothing = torch.zeros(1, 3, 2, dtype=torch.float64)
    state = State(nothing, nothing, torch.zeros_like(F), F)
    E = softmpm.green_strain(state)[0]
    want = torch.tensor(
        [[[0.0, g / 2], [g / 2, g**2 / 2]], [[0, 0], [0, 0]], [[0.22, 0], [0, 0.22]]]
    ).double()
    torch.testing.assert_close(E, want, rtol=0, atol=1e-7)
    equivalent = softmpm.von_mises_strain(state)[0]
    full = torch.zeros(3, 3, dtype=torch.float64)
    full[:2, :2] = E[0]
    deviator = full - full.trace() / 3 * torch.eye(3)
    assert equivalent[0].item() == pytest.approx(math.sqrt(2 / 3 * (deviator**2).sum().item()), rel=1e-12)
    assert equivalent[2].item() == pytest.approx(0.22 * 2 / 3, rel=1e-12)  # the third strain is zero
    eps = 1e-6  # uniaxial, incompressible, in 3D
    thin = torch.diag(torch.tensor([1 + eps, 1 - eps / 2, 1 - eps / 2], dtype=torch.float64))[None, None]
    assert softmpm.von_mises_strain(State(thin, thin, thin, thin)).item() == pytest.approx(eps, rel=1e-5)
    for size in (1.0, 1.2, 0.7):
        swollen = (size * torch.eye(3, dtype=torch.float64))[None, None].requires_grad_()
        softmpm.von_mises_strain(State(swollen, swollen, swollen, swollen)).sum().backward()
        assert (swollen.grad == 0).all()


def test_a_small_distortion_of_a_large_change_of_volume():
    """Cubes that swell by 1.2, along one axis by 1.2 + δ: 2/3 (1.2 δ + δ²/2), and its derivative, to the rounding of 1.2 + δ."""
    for delta in (1e-4, 1e-8, 1e-10):
        F = torch.tensor([1.2, 1.2, 1.2 + delta], dtype=torch.float64).diag()[None, None].requires_grad_()
        found = softmpm.von_mises_strain(State(F, F, F, F))
        found.sum().backward()
        assert F.grad is not None
        assert found.item() == pytest.approx(2 / 3 * (1.2 * delta + delta**2 / 2), rel=1e-15 / delta)
        assert F.grad[0, 0, 2, 2].item() == pytest.approx(2 / 3 * (1.2 + delta), rel=1e-12)


def test_small_motions_in_single_precision():
    """A strain of 1e-7 and a displacement of 1e-8, below the digits of F and x, come from the low-order parts: ≤ 1e-6."""
    model = softmpm.build(two_blocks(), device="cpu")
    rest, params = model.rest(), model.params()
    assert rest.low is not None
    strain, way = 1e-7, 1e-8
    low = rest.low._replace(F=rest.low.F + strain * torch.eye(2), x=rest.low.x + way)
    state = rest._replace(low=low)
    want = torch.full_like(rest.x, way)
    torch.testing.assert_close(softmpm.displacement(model, state), want, rtol=1e-6, atol=0)
    torch.testing.assert_close(
        softmpm.green_strain(state), strain * torch.eye(2).expand_as(rest.F), rtol=1e-6, atol=0
    )
    mu, lam = 50.0 / 2.6, 50.0 * 0.3 / (1.3 * 0.4)
    energy = softmpm.elastic_energy(model, state, params)
    assert energy.dtype == torch.float32
    want = model.volume.sum().item() * (2 * mu + 2 * lam) * strain**2
    assert energy.item() == pytest.approx(want, rel=1e-5)


def test_means_over_bodies():
    """By volume, by mass, and of matrices; the mean of the positions by mass is the centre of mass."""
    model = softmpm.build(busy_scene(3), device="cpu", dtype=torch.float64, worlds=2)
    inputs = busy_inputs(model)
    state, params = state_of(inputs), params_of(inputs)
    mass = params.density * model.volume
    torch.testing.assert_close(
        softmpm.body_mean(model, state.x, mass), softmpm.center_of_mass(model, state, params, per_body=True)
    )
    got = softmpm.body_mean(model, state.F)
    for k in range(2):
        part = model.body == k
        want = (state.F[:, part] * model.volume[part][:, None, None]).sum(1) / model.volume[part].sum()
        torch.testing.assert_close(got[:, k], want)
    torch.testing.assert_close(softmpm.body_mean(model, state.F[..., 0, 0]), got[..., 0, 0])


@pytest.mark.parametrize("what", BY_MATERIAL, ids=lambda function: function.__name__)
def test_gradients(what):
    """Of the state and the material, against central differences."""
    model = softmpm.build(busy_scene(2, per_law=4), device="cpu", dtype=torch.float64)
    inputs = busy_inputs(model)
    names = ("x", "v", "C", "F", "young", "poisson", "density")

    def function(*values):
        given = dict(zip(names, values, strict=True))
        return what(model, state_of(given), params_of(given), per_body=True)

    assert torch.autograd.gradcheck(function, [inputs[name] for name in names], eps=1e-7, atol=1e-6)


def test_the_gradient_of_a_rollout():
    """Of the kinetic energy at the end by the density, through the nodes in the reference formulation: a central difference."""
    model = softmpm.build(
        two_blocks(gravity=(0.0, -2.0)), device="cpu", dtype=torch.float64, formulation="reference"
    )
    params = model.params()
    start = model.rest()
    start.v[..., 0] = start.x[..., 0] ** 2

    def energy(factor: torch.Tensor) -> torch.Tensor:
        changed = params._replace(young=params.young * factor, density=params.density * (1 + factor**2))
        end = softmpm.simulate(model, start, None, changed, substeps=20)
        return softmpm.kinetic_energy(model, end, changed)[0]

    one, h = torch.tensor(1.0, dtype=torch.float64, requires_grad=True), 1e-4
    (got,) = torch.autograd.grad(energy(one), one)
    with torch.no_grad():
        want = (energy(one + h) - energy(one - h)) / (2 * h)
    assert got.item() == pytest.approx(want.item(), rel=1e-6)


def test_what_is_no_state_is_refused():
    """A tensor of another shape, another type, and a field without the axes of particles."""
    model = softmpm.build(two_blocks(), device="cpu")
    rest, params = model.rest(), model.params()
    with pytest.raises(TypeError, match="center_of_mass needs a model"):
        softmpm.center_of_mass(model.scene, rest, params)
    with pytest.raises(ValueError, match=r"state\.x must have shape"):
        softmpm.kinetic_energy(model, rest._replace(x=rest.x[:, :3]), params)
    with pytest.raises(ValueError, match=r"params\.density must broadcast"):
        softmpm.momentum(model, rest, params._replace(density=params.density[:3]))
    with pytest.raises(ValueError, match=r"field must have shape \(world, particle, ...\)"):
        softmpm.body_mean(model, rest.x[0])
    with pytest.raises(
        ValueError, match=r"weight must broadcast to \(world, particle\) = .*, got shape \(3,\)"
    ):
        softmpm.body_mean(model, rest.x, torch.ones(3))
    with pytest.raises(
        ValueError, match=r"gravity must broadcast to \(world, dim\) = \(1, 2\), got shape \(3,\)"
    ):
        softmpm.gravitational_energy(model, rest, params, torch.ones(3))
    with pytest.raises(TypeError, match=r"state must be a softmpm\.State"):
        softmpm.green_strain(rest.F)
