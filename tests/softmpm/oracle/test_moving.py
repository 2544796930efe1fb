"""The float64 oracle against laws of physics and central differences: it leans on no kernel."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from oracle_scenes import DIMS, DX, f64, full, masses, randn, rest, shaken, slopes, tiny

from softmpm.inputs import Inputs
from softmpm.oracle import moving, stress, transfer
from softmpm.oracle import walls as oracle_walls
from softmpm.scene.actuators import Muscle, Pressure
from softmpm.scene.materials import NeoHookean
from softmpm.scene.scene import Body, Grid, Particles, Wall
from softmpm.state import Params, State


@DIMS
def test_weights_are_quadratic_b_splines(dim):
    """Σ w = 1, Σ w r = 0, Σ w r rᵀ = dx²/4 I, and Σ ∇w r'ᵀ = I with r' = x_i: also on a cell edge."""
    scene = tiny(dim)
    edge = f64([[0.45, 0.5, 0.55][:dim], [0.4, 0.35, 0.6][:dim]])
    x = torch.cat([edge, shaken(scene)[0].x[0]])[None].requires_grad_()
    nodes = transfer.stencil(scene, x)
    w, r = torch.stack([n[1] for n in nodes], -1), torch.stack([n[2] for n in nodes], -2)
    eye = torch.eye(dim, dtype=torch.float64)

    def close(got, want):
        torch.testing.assert_close(got, torch.as_tensor(want).double().expand_as(got), rtol=0, atol=1e-14)

    assert (w >= 0).all()
    assert len(nodes) == 3**dim
    close(w.sum(-1), 1.0)
    close((w[..., None] * r).sum(-2), 0.0)
    close(torch.einsum("wpn,wpni,wpnj->wpij", w, r, r), DX**2 / 4 * eye)
    for axis in range(dim):
        (slope,) = torch.autograd.grad(
            (w * (r + x[..., None, :]).detach()[..., axis]).sum(), x, retain_graph=True
        )
        close(slope, eye[axis])


@DIMS
def test_transfer_keeps_mass_momentum_and_spin(dim):
    """P2G then G2P keeps Σ m, Σ m v and Σ (x ∧ m v + m D C − its transpose), without forces, to rounding."""
    scene = tiny(dim)
    state, params = shaken(scene)
    mass = masses(scene, params)[..., None]
    node_mass, momentum = transfer.p2g(
        scene, state.x, mass[..., 0], mass * state.v, mass[..., None] * state.C
    )
    v, C = transfer.g2p(scene, state.x, moving.grid_velocity(scene, node_mass, momentum))

    def spin(v, C):
        A = (mass[..., None] * (state.x[..., :, None] * v[..., None, :] + DX**2 / 4 * C.mT)).sum(1)
        return A - A.mT

    torch.testing.assert_close(node_mass.sum(), mass.sum(), rtol=1e-14, atol=0)
    torch.testing.assert_close((mass * v).sum(1), (mass * state.v).sum(1), rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(spin(v, C), spin(state.v, state.C), rtol=1e-12, atol=1e-15)


@DIMS
def test_an_affine_flow_is_seen_and_kept_exactly(dim):
    """v(x) = a + Bx of the particles is a + B x_i on every node with mass, and comes back from G2P."""
    scene, a, B = tiny(dim), randn(dim, seed=50), randn(dim, dim, seed=51)
    state, params = rest(scene)
    state = state._replace(v=a + state.x @ B.T, C=B.expand_as(state.F))
    field = moving.rasterize(scene, state, params.density)
    nodes = torch.stack(
        torch.meshgrid(*(DX * torch.arange(n).double() for n in scene.grid.shape), indexing="ij"), -1
    )
    want = torch.where(field.mass[..., None] > 0, a + nodes @ B.T, 0.0)
    assert field.velocity.shape == (1, *scene.grid.shape, dim)
    assert (field.mass == 0).any()
    torch.testing.assert_close(field.velocity, want, rtol=0, atol=1e-12)
    torch.testing.assert_close(field.mass.sum(), masses(scene, params).sum(), rtol=1e-14, atol=0)
    v, C = transfer.g2p(scene, state.x, field.velocity.view(1, -1, dim))
    torch.testing.assert_close(v, state.v, rtol=0, atol=1e-12)
    torch.testing.assert_close(C, state.C, rtol=0, atol=1e-12)


@DIMS
def test_free_fall_with_damping(dim):
    """A body at rest follows v ← e^(−γΔt)(v + Δt g), x ← x + Δt v, whatever its material: ≤ 1e-13."""
    gravity = (0.4, -9.8, 0.2)[:dim]
    scene = tiny(dim, gravity=gravity, damping=3.0)
    start, params = rest(scene)
    end = moving.simulate(scene, start, None, params, substeps=20)
    v, fallen, g = torch.zeros(dim).double(), torch.zeros(dim).double(), f64(gravity)
    for _ in range(20):
        v = math.exp(-3.0 * scene.dt) * (v + scene.dt * g)
        fallen = fallen + scene.dt * v
    torch.testing.assert_close(end.v, v.expand_as(end.v), rtol=0, atol=1e-13)
    torch.testing.assert_close(end.x - start.x, fallen.expand_as(end.x), rtol=0, atol=1e-13)
    torch.testing.assert_close(end.F, start.F, rtol=0, atol=1e-13)


@DIMS
def test_free_motion_keeps_momentum_and_spin(dim):
    """Elastic forces and muscles change neither Σ m v nor the spin: ≤ 1e-13 in 20 substeps."""
    scene = tiny(dim, muscles=full(dim).muscles)
    start, params = shaken(scene)
    mass = masses(scene, params)[..., None]
    end = moving.simulate(scene, start, randn(2, 1, 2, seed=60), params, substeps=10)

    def spin(s):
        A = (mass[..., None] * (s.x[..., :, None] * s.v[..., None, :] + DX**2 / 4 * s.C.mT)).sum(1)
        return A - A.mT

    scale = (mass * start.v.abs()).sum()
    assert ((mass * (end.v - start.v)).sum(1)).abs().max() <= 1e-13 * scale
    assert (spin(end) - spin(start)).abs().max() <= 1e-13 * scale
    assert (end.v - start.v).abs().max() > 0.1, "nothing happened"


@DIMS
def test_viscosity_dissipates_and_keeps_spin(dim):
    """A viscous free body keeps Σ m v and its spin to rounding and loses energy; ``inputs.viscosity`` overrides the material's."""
    scene = tiny(dim)
    start, params = shaken(scene, noise=0.3)
    mass, count = masses(scene, params)[..., None], start.x.shape[1]

    def spin(s):
        A = (mass[..., None] * (s.x[..., :, None] * s.v[..., None, :] + DX**2 / 4 * s.C.mT)).sum(1)
        return A - A.mT

    bodies = [
        dataclasses.replace(body, material=dataclasses.replace(body.material, viscosity=0.5))
        for body in scene.bodies
    ]
    viscous = dataclasses.replace(scene, bodies=bodies)
    end = moving.simulate(viscous, start, None, params, substeps=30)
    scale = (mass * start.v.abs()).sum()
    assert (mass * (end.v - start.v)).sum(1).abs().max() <= 1e-13 * scale
    assert (spin(end) - spin(start)).abs().max() <= 1e-13 * scale
    eta = torch.full((1, count), 0.5).double()
    given = moving.simulate(scene, start, None, params, substeps=30, inputs=Inputs(viscosity=eta))
    assert all(torch.equal(a, b) for a, b in zip(given[:4], end[:4], strict=True))
    none = moving.simulate(viscous, start, None, params, substeps=30, inputs=Inputs(viscosity=0 * eta))
    elastic = moving.simulate(scene, start, None, params, substeps=30)
    assert all(torch.equal(a, b) for a, b in zip(none[:4], elastic[:4], strict=True))

    def relative_speed(s):
        mean = (mass * s.v).sum(1, keepdim=True) / mass.sum(1, keepdim=True)
        return (mass * ((s.v - mean) ** 2 + DX**2 / 4 * (s.C**2).sum(-1))).sum().item()

    assert relative_speed(end) < 0.7 * relative_speed(elastic)


def test_a_quarter_turn_of_the_scene_turns_the_result():
    """Axes swapped as (x, y) → (L − y, x): catches mixed axes and nodes."""
    scene = tiny(2, grid=Grid(shape=(11, 11), spacing=DX))
    start, params = shaken(scene)
    Q, L = f64([[0.0, -1.0], [1.0, 0.0]]), f64([10 * DX, 0.0])

    def turn(s):
        return State(s.x @ Q.T + L, s.v @ Q.T, Q @ s.C @ Q.T, Q @ s.F)

    got = moving.simulate(scene, turn(start), None, params, substeps=10)
    want = turn(moving.simulate(scene, start, None, params, substeps=10))
    for a, b in zip(got[:4], want[:4], strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


def test_stress_of_each_particle():
    """Every body has its law, every muscle its activation, fibre and particles; overlapping muscles add."""
    scene, activation = full(2), f64([[0.5, -2.0]])
    start, params = shaken(scene)
    mu, lam = (term[0] for term in stress.lame(params.young, params.poisson))
    got = moving.stress(scene, start.F, mu[None], lam[None], activation)[0]
    for p, F in enumerate(start.F[0]):
        law = stress.neo_hookean if p < 6 else stress.fixed_corotated
        want = law(F, mu[p], lam[p])
        for muscle, a in zip(scene.muscles, activation[0], strict=True):
            if p in muscle.particles:
                f = F @ f64(muscle.direction)
                want = want + a * muscle.strength * torch.outer(f, f)
        torch.testing.assert_close(got[p], want, rtol=0, atol=1e-12)


def test_a_muscle_contracts_along_its_fibre():
    """Positive activation shortens the body along d and widens it across; negative does the opposite."""
    muscle = Muscle(particles=np.arange(12), direction=(0.0, 1.0), strength=8.0)
    scene = tiny(2, muscles=[muscle])
    start, params = rest(scene)
    for sign in (1.0, -1.0):
        end = moving.simulate(scene, start, torch.full((1, 1, 1), sign).double(), params, substeps=15)
        strain = end.F[0].diagonal(dim1=-2, dim2=-1).mean(0) - 1
        assert sign * strain[1] < -1e-3
        assert sign * strain[0] > 0


@pytest.mark.parametrize(
    ("wall", "v", "want"),
    [
        ({"contact": "stick"}, (3.0, 1.0), (0.0, 0.0)),
        ({"contact": "slip"}, (3.0, 1.0), (3.0, 0.0)),
        ({"contact": "slip"}, (3.0, -1.0), (3.0, 0.0)),
        ({"contact": "separate"}, (3.0, 1.0), (3.0, 1.0)),
        ({"contact": "separate"}, (3.0, -1.0), (3.0, 0.0)),
        ({"contact": "separate", "friction": 0.5}, (3.0, 1.0), (3.0, 1.0)),
        ({"contact": "separate", "friction": 0.5}, (3.0, -1.0), (2.5, 0.0)),
        ({"contact": "separate", "friction": 0.5}, (-3.0, -1.0), (-2.5, 0.0)),
        ({"contact": "separate", "friction": 0.5}, (0.4, -1.0), (0.0, 0.0)),
        ({"contact": "separate", "friction": 0.5}, (3.0, 0.0), (3.0, 0.0)),
    ],
)
def test_contact_of_a_node(wall, v, want):
    """Velocity after each kind of contact, above a floor and on the same floor turned."""
    v, want = f64(v), f64(want)
    for Q in (f64([[1.0, 0.0], [0.0, 1.0]]), f64([[0.8, 0.6], [-0.6, 0.8]])):
        normal = tuple(Q[:, 1].tolist())
        got = oracle_walls.respond(Wall(normal=normal, offset=0.0, **wall), Q @ v)
        torch.testing.assert_close(got, Q @ want, rtol=0, atol=1e-15)


@DIMS
def test_friction_never_gives_nan(dim):
    """Pressed straight into a rough wall a node is held, gradient 0; on a smooth one it is free to slide."""
    n = torch.eye(dim, dtype=torch.float64)[1]
    for friction, want in ((0.5, torch.zeros(dim, dim)), (0.0, torch.eye(dim) - torch.outer(n, n).float())):
        wall = Wall(normal=tuple(n.tolist()), offset=0.0, friction=friction)
        jacobian = torch.autograd.functional.jacobian(lambda v: oracle_walls.respond(wall, v), -n)  # noqa: B023
        torch.testing.assert_close(jacobian, want.double(), rtol=0, atol=0)
        still = torch.autograd.functional.jacobian(
            lambda v: oracle_walls.respond(wall, v),  # noqa: B023
            torch.zeros_like(n),
        )
        torch.testing.assert_close(still, torch.eye(dim).double(), rtol=0, atol=0)  # v·n < 0 does not hold


@DIMS
def test_contact_derivative(dim):
    """Each contact is differentiated within its branch: sliding, held and leaving."""
    normal = (0.3, 1.0, -0.2)[:dim]
    for contact, friction in (("slip", 0.0), ("separate", 0.0), ("separate", 0.3), ("separate", 5.0)):
        wall = Wall(normal=normal, offset=0.0, contact=contact, friction=friction)
        for up in (-1.0, 1.0):
            v = f64((0.7, up, 0.4)[:dim]).requires_grad_()
            assert torch.autograd.gradcheck(lambda v: oracle_walls.respond(wall, v), v)  # noqa: B023


def test_walls_act_on_their_nodes_in_order():
    """A node on the surface is inside; the last wall has the last word; empty nodes stay at zero."""
    floor = Wall(normal=(0.0, 1.0), offset=0.25, contact="slip")
    side = Wall(normal=(-1.0, 1.0), offset=0.0, contact="slip")
    grid = Grid(shape=(5, 4), spacing=0.125)
    velocity = f64([1.0, -2.0])
    mass = torch.full((1, 20), 2.0).double()
    mass[0, 7] = 0.0

    def go(*walls, gravity=None):
        scene = tiny(2, grid=grid, walls=walls, gravity=gravity)
        return moving.grid_velocity(scene, mass, mass[..., None] * velocity).view(5, 4, 2)

    assert (go(floor)[0, :3] == torch.tensor([1.0, 0.0])).all()  # 2 · 0.125 = 0.25 is inside
    assert (go(floor)[0, 3] == velocity).all()
    torch.testing.assert_close(go(floor, side)[2, 2], f64([0.5, 0.5]))
    torch.testing.assert_close(go(side, floor)[2, 2], f64([-0.5, 0.0]))
    assert (go(gravity=(1.0, -9.8))[1, 3] == 0).all()


@pytest.mark.parametrize("laws", [("neo_hookean",), ("fixed_corotated",), ("neo_hookean", "fixed_corotated")])
@DIMS
def test_gradient_of_a_rollout(dim, laws):
    """Along a random direction of each input equals a central difference: 2 control steps, 2 worlds, ≤ 5e-9.

    The body slides with 2 m/s, so that no node changes between held, sliding and leaving in between.
    """
    scene = full(dim, laws)
    start, params = shaken(scene, worlds=2, noise=0.3)
    start = start._replace(v=start.v + f64((2.0, -0.5, 0.3)[:dim]))
    inputs = {
        **dict(zip("xvCF", start[:4], strict=True)),
        **params._asdict(),
        "activation": 0.5 * randn(2, 2, 2, seed=70),
    }
    weights = [randn(*t.shape, seed=80 + k) for k, t in enumerate(start[:4])]

    def losses(values):
        s, p = State(*(values[k] for k in "xvCF")), Params(*(values[k] for k in Params._fields))
        end = moving.simulate(scene, s, values["activation"], p, substeps=4)
        return sum(
            (w * t.unflatten(0, (-1, 2))).flatten(1).sum(1) for w, t in zip(weights, end[:4], strict=True)
        )

    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    gradient = torch.autograd.grad(losses(leaves).sum(), list(leaves.values()))
    scale = dict(x=0.02, v=0.5, C=2.0, F=0.1, young=40.0, poisson=0.1, density=0.5, activation=0.5)
    along = {
        name: scale[name] * randn(*value.shape, seed=90 + k) for k, (name, value) in enumerate(inputs.items())
    }
    want = slopes(losses, inputs, along, 1e-4, {"activation": 1})
    for name, found in zip(inputs, gradient, strict=True):
        parts = found * along[name]
        assert parts.isfinite().all()
        assert parts.norm() > 0, f"the test does not exercise {name}"
        assert abs(parts.sum() - want[name]) <= 5e-9 * max(abs(want[name]), parts.norm()), name


def test_worlds_do_not_touch():
    """Two worlds in one call are two calls of one, and the start is left as it was."""
    scene = full(2)
    start, params = shaken(scene, worlds=2)
    activation, before = randn(2, 2, 2, seed=61), start.clone()
    both = moving.simulate(scene, start, activation, params, substeps=3)
    for w in range(2):
        part = slice(w, w + 1)
        alone = moving.simulate(
            scene,
            State(*(t[part] for t in start[:4])),
            activation[:, part],
            Params(*(p[part] for p in params)),
            substeps=3,
        )
        for a, b in zip(both[:4], alone[:4], strict=True):
            torch.testing.assert_close(a[part], b, rtol=0, atol=1e-14)
    assert all(torch.equal(a, b) for a, b in zip(start[:4], before[:4], strict=True))


def test_each_row_drives_its_substeps():
    """Rows of activation are control steps in order; no activation is one control step of zeros."""
    scene, (start, params) = full(2), shaken(full(2))
    rows = randn(2, 1, 2, seed=62)
    first = moving.simulate(scene, start, rows[:1], params, substeps=3)
    second = moving.simulate(scene, first, rows[1:], params, substeps=3)
    for a, b in zip(moving.simulate(scene, start, rows, params, substeps=3)[:4], second[:4], strict=True):
        assert torch.equal(a, b)
    idle = moving.simulate(scene, start, torch.zeros_like(rows[:1]), params, substeps=3)
    for a, b in zip(moving.simulate(scene, start, None, params, substeps=3)[:4], idle[:4], strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("where", [0.04, 0.96, math.nan])
def test_a_particle_outside_the_grid_is_an_error(where):
    """Not a value from the other side of the grid: the message names world and particle."""
    scene, (start, params) = tiny(2), rest(tiny(2), worlds=2)
    x = start.x.clone()
    x[1, 5, 1] = where
    with pytest.raises(ValueError, match="particle 5 of world 1 must stay half a cell inside the grid"):
        moving.simulate(scene, start._replace(x=x), None, params, substeps=1)


@DIMS
@pytest.mark.parametrize("strength", [15.0, -15.0])
def test_pressure_expands_a_free_body_alike_in_all_directions(dim, strength):
    """A particle alone comes to rest where its law balances the pressure, μ(s² − 1) + λ log J = p J for F = s I; negative contracts."""
    material = NeoHookean(density=1.0, young=100.0, poisson=0.3)
    body = Body(Particles(np.full((1, dim), 0.47), 1e-3), material)
    chamber = Pressure(particles=[0], strength=strength)
    scene = tiny(dim, bodies=[body], muscles=[chamber], damping=60.0)
    start, params = rest(scene)
    end = moving.simulate(scene, start, f64([[[1.0]]]), params, substeps=600)
    F = end.F[0, 0]
    stretch = F[0, 0]
    torch.testing.assert_close(F, stretch * torch.eye(dim).double(), rtol=0, atol=1e-10)
    mu, lam = stress.lame(params.young, params.poisson)
    J = stretch**dim
    assert abs(mu[0] * (stretch**2 - 1) + lam[0] * J.log() - strength * J) < 1e-6
    assert (stretch > 1.02) if strength > 0 else (stretch < 0.98)
