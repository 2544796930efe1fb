"""The total Lagrangian oracle against laws of physics, energies and the adjoint of docs/math/lagrangian.md."""

import dataclasses
import math

import helpers
import numpy as np
import pytest
import torch
from oracle_scenes import DIMS, DX, difference, f64, full, masses, randn, rest, shaken, tiny

from softmpm.inputs import Inputs
from softmpm.oracle import lagrangian, moving, stress, transfer, walls
from softmpm.scene.actuators import Muscle, Pressure
from softmpm.scene.materials import FixedCorotated, NeoHookean, StableNeoHookean
from softmpm.scene.scene import Body, Particles, Scene, Wall
from softmpm.state import State

LAWS = tuple(helpers.LAWS.values())


def nodal(scene: Scene, params) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Mass of the nodes, (1, node), and the material (μ, λ) of the particles, (1, particle)."""
    points = lagrangian.quadrature(scene)
    count = len(points.X)
    mu, lam = (value.expand(1, count) for value in stress.lame(params.young, params.poisson))
    mass = masses(scene, params).expand(1, count)
    return lagrangian.node_mass(scene, points, mass), mu, lam


def moved(scene: Scene, params, seed=1) -> tuple[torch.Tensor, torch.Tensor]:
    """Random u and v of the nodes with mass: strains of about 0.05."""
    present = (nodal(scene, params)[0] > 0)[..., None]
    u = 4e-3 * randn(1, present.shape[1], scene.grid.dim, seed=seed)
    return present * u, present * 0.2 * randn(*u.shape, seed=seed + 1)


def turned(dim: int) -> torch.Tensor:
    """A rotation by more than a quarter turn."""
    W = torch.zeros(3, 3, dtype=torch.float64)
    W[0, 1], W[0, 2], W[1, 2] = -1.8, 0.7 * (dim - 2), 0.4 * (dim - 2)
    return torch.matrix_exp((W - W.T)[:dim, :dim])


def with_material(scene: Scene, law, **constants) -> Scene:
    material = law(**(dict(density=1.2, young=80.0, poisson=0.3) | constants))
    return dataclasses.replace(
        scene, bodies=[dataclasses.replace(b, material=material) for b in scene.bodies]
    )


@DIMS
def test_weights_and_their_gradient(dim):
    """Σ N = 1, Σ N r = 0, Σ g = 0, Σ X_i ⊗ g = I, and N is that of the moving formulation: ≤ 1e-13."""
    scene = tiny(dim)
    points = lagrangian.quadrature(scene)
    for k, (node, N, _) in enumerate(transfer.stencil(scene, points.X[None])):
        assert torch.equal(node[0], points.node[:, k]) and torch.equal(N[0], points.N[:, k])
    places = walls.nodes(scene)[points.node]

    def close(got, want):
        torch.testing.assert_close(got, torch.as_tensor(want).double().expand_as(got), rtol=0, atol=1e-13)

    close(points.N.sum(-1), 1.0)
    close(torch.einsum("pk,pkj->pj", points.N, points.r), 0.0)
    close(points.slope.sum(1), 0.0)
    close(torch.einsum("pki,pkj->pij", places, points.slope), torch.eye(dim))


@DIMS
def test_affine_fields_are_projected_and_evaluated_exactly(dim):
    """x = a + A X and v = b + B x come back from the nodes, which themselves lie on them: ≤ 1e-12."""
    scene = tiny(dim)
    start, params = shaken(scene)  # a density of its own for each particle
    X, F = rest(scene)[0].x, torch.eye(dim).double() + 0.2 * randn(dim, dim, seed=50)
    a, b, B = randn(dim, seed=51), randn(dim, seed=52), 3.0 * randn(dim, dim, seed=53)
    x = a + X @ F.T
    state = State(x, b + x @ B.T, B.expand_as(start.F), F.expand_as(start.F))
    u, v = lagrangian.project(scene, state, params)
    for got, want in zip(lagrangian.evaluate(scene, u, v)[:4], state[:4], strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-12)
    present, places = (nodal(scene, params)[0] > 0)[..., None], walls.nodes(scene)
    there = a + places @ F.T
    torch.testing.assert_close(u, torch.where(present, there - places, 0.0), rtol=0, atol=1e-12)
    torch.testing.assert_close(v, torch.where(present, b + there @ B.T, 0.0), rtol=0, atol=1e-12)


@DIMS
def test_projection_keeps_momentum(dim):
    """Σ m_i v_i = Σ m_p v_p and Σ m_i u_i = Σ m_p (x_p − X_p), whatever the state."""
    scene = tiny(dim)
    state, params = shaken(scene)
    u, v = lagrangian.project(scene, state, params)
    of_nodes, mass = nodal(scene, params)[0][..., None], masses(scene, params)[..., None]
    torch.testing.assert_close((of_nodes * v).sum(1), (mass * state.v).sum(1), rtol=0, atol=1e-14)
    way = state.x - rest(scene)[0].x
    torch.testing.assert_close((of_nodes * u).sum(1), (mass * way).sum(1), rtol=0, atol=1e-14)


@DIMS
@pytest.mark.parametrize("law", LAWS)
def test_a_rigid_motion_gives_no_force(dim, law):
    """u = (R − I) X + a with a spin about any point: F = R, and neither the law nor viscosity gives a force ≤ 1e-13 N."""
    scene = with_material(tiny(dim), law, viscosity=0.5)
    params, points = rest(scene)[1], lagrangian.quadrature(scene)
    R, places = turned(dim), walls.nodes(scene)
    u = (places @ (R - torch.eye(dim)).T + randn(dim, seed=1))[None]
    W = randn(dim, dim, seed=2)
    v = (places + u) @ (W - W.T) + randn(dim, seed=3)
    _, mu, lam = nodal(scene, params)
    force = lagrangian.node_force(scene, points, u, v, None, mu, lam)
    F = lagrangian.evaluate(scene, u, v).F
    torch.testing.assert_close(F, R.expand_as(F), rtol=0, atol=1e-13)
    assert force.abs().max() <= 1e-13
    stretched = lagrangian.node_force(scene, points, 1.1 * u, v, None, mu, lam)
    assert stretched.abs().max() > 1e-3, "the test has no power"


@DIMS
def test_a_scene_at_rest_stays_at_rest(dim):
    """Without gravity or activation no node moves: to the last bit in neo-Hookean, to the rounding of the other stresses at F = I."""
    for law in LAWS:
        scene = with_material(full(dim), law)
        scene = dataclasses.replace(scene, gravity=None)
        start, params = rest(scene)
        u, v = lagrangian.project(scene, start, params)
        assert (u == 0).all() and (v == 0).all()
        u, v = lagrangian.simulate(scene, u, v, None, params, substeps=5)
        assert v.abs().max() <= (0.0 if law is NeoHookean else 1e-13)


def energy(scene: Scene, F: torch.Tensor, mu: torch.Tensor, lam: torch.Tensor, activation: torch.Tensor):
    """Energy of the particles [J] in closed form: that of the law, and the work of the actuators."""
    law, volume = type(scene.bodies[0].material), masses(scene, rest(scene)[1]) / 1.2
    squared, J = (F**2).sum((-2, -1)), torch.linalg.det(F)
    corotated = mu * ((F - stress.polar(F)) ** 2).sum((-2, -1))
    if law is NeoHookean:
        density = mu / 2 * (squared - 2 * J.log()) + lam / 2 * J.log() ** 2
    elif law is StableNeoHookean:
        m, l = 4 / 3 * mu, lam + 5 / 6 * mu
        I = squared + (3 - F.shape[-1])
        density = m / 2 * I + l / 2 * (J - 1 - 3 / 4 * m / l) ** 2 - m / 2 * (I + 1).log()
    elif law is FixedCorotated:
        density = corotated + lam / 2 * (J - 1) ** 2
    else:
        density = corotated + lam / 8 * (J - 1 / J) ** 2
    total = (volume * density).sum()
    for k, actuator in enumerate(scene.muscles):
        here, p = torch.tensor(actuator.particles), activation[:, k] * actuator.strength
        if isinstance(actuator, Muscle):
            each = ((F[:, here] @ f64(actuator.direction)) ** 2).sum(-1) / 2
        else:
            each = -(J[:, here] - 1)
        total = total + (p[:, None] * volume[here] * each).sum()
    return total


@DIMS
@pytest.mark.parametrize("law", LAWS)
def test_force_is_minus_the_gradient_of_the_energy(dim, law):
    """f = −∂E/∂u of every law, with muscles and a pressure, by autograd of an energy in closed form: ≤ 1e-12 of the largest."""
    chamber = Pressure(particles=np.arange(5), strength=4.0)
    scene = with_material(tiny(dim, muscles=[*full(dim).muscles, chamber]), law)
    params, points = rest(scene)[1], lagrangian.quadrature(scene)
    u, v = moved(scene, params)
    u = (u + 0.2 * walls.nodes(scene) @ randn(dim, dim, seed=5)).requires_grad_()
    _, mu, lam = nodal(scene, params)
    activation = f64([[0.5, -0.4, 0.7]])
    F = torch.eye(dim, dtype=torch.float64) + lagrangian.gather(points, u)[1]
    assert torch.linalg.det(F).min() > 0.2
    (want,) = torch.autograd.grad(-energy(scene, F, mu, lam, activation), u)
    got = lagrangian.node_force(scene, points, u, v, activation, mu, lam)
    assert (got - want).abs().max() <= 1e-12 * want.abs().max()


@DIMS
def test_viscosity_dissipates(dim):
    """Its power Σ f·v is −Σ V 2η |Ė|² with Ė = sym(FᵀḞ)."""
    scene = with_material(tiny(dim), NeoHookean, viscosity=0.5)
    params, points = rest(scene)[1], lagrangian.quadrature(scene)
    (u, v), (_, mu, lam) = moved(scene, params), nodal(scene, params)
    none = Inputs(viscosity=f64([0.0]))
    both, elastic = (
        lagrangian.node_force(scene, points, u, v, None, mu, lam, given) for given in (Inputs(), none)
    )
    F = torch.eye(dim) + lagrangian.gather(points, u)[1]
    rate = F.mT @ lagrangian.gather(points, v)[1]
    strain_rate = (rate + rate.mT) / 2
    want = -(masses(scene, params) / 1.2 * 2 * 0.5 * (strain_rate**2).sum((-2, -1))).sum()
    torch.testing.assert_close(((both - elastic) * v).sum(), want, rtol=1e-11, atol=0)


@DIMS
def test_free_motion_keeps_momentum_and_spin(dim):
    """Σ m v and Σ m (X + u) ∧ v are those of the start after 20 substeps with muscles and viscosity: ≤ 1e-13."""
    scene = with_material(tiny(dim, muscles=full(dim).muscles), FixedCorotated, viscosity=0.05)
    params = rest(scene)[1]
    (u, v), mass = moved(scene, params), nodal(scene, params)[0][..., None]
    places = walls.nodes(scene)
    end = lagrangian.simulate(scene, u, v, randn(2, 1, 2, seed=60), params, substeps=10)

    def spin(u, v):
        A = ((mass * (places + u))[..., :, None] * v[..., None, :]).sum(1)
        return A - A.mT

    scale = (mass * v.abs()).sum()
    assert (mass * (end[1] - v)).sum(1).abs().max() <= 1e-13 * scale
    assert (spin(*end) - spin(u, v)).abs().max() <= 1e-13 * scale
    of_particles = lagrangian.evaluate(scene, *end)
    momentum = (masses(scene, params)[..., None] * of_particles.v).sum(1)
    torch.testing.assert_close(momentum, (mass * v).sum(1), rtol=0, atol=1e-13 * scale.item())
    assert (mass * (end[1] - v).abs()).sum() > 0.1 * scale, "nothing happened"


@DIMS
def test_free_fall_with_damping(dim):
    """A body at rest follows v ← e^(−γΔt)(v + Δt g), u ← u + Δt v, without strain: ≤ 1e-13."""
    gravity = (0.4, -9.8, 0.2)[:dim]
    scene = tiny(dim, gravity=gravity, damping=3.0)
    start, params = rest(scene)
    u, v = lagrangian.project(scene, start, params)
    end = lagrangian.evaluate(scene, *lagrangian.simulate(scene, u, v, None, params, substeps=20))
    v, fallen, g = torch.zeros(dim).double(), torch.zeros(dim).double(), f64(gravity)
    for _ in range(20):
        v = math.exp(-3.0 * scene.dt) * (v + scene.dt * g)
        fallen = fallen + scene.dt * v
    torch.testing.assert_close(end.v, v.expand_as(end.v), rtol=0, atol=1e-13)
    torch.testing.assert_close(end.x - start.x, fallen.expand_as(end.x), rtol=0, atol=1e-13)
    torch.testing.assert_close(end.F, start.F, rtol=0, atol=1e-12)


@DIMS
def test_forces_give_their_impulse(dim):
    """A free body gains Σ f t, whatever its material, over two control steps."""
    scene = tiny(dim)
    params = rest(scene)[1]
    (u, v), mass = moved(scene, params), nodal(scene, params)[0][..., None]
    force = 1e-3 * randn(2, *rest(scene)[0].x.shape, seed=1)
    end = lagrangian.simulate(scene, u, v, None, params, substeps=7, inputs=Inputs(force=force))
    gained = (mass * (end[1] - v)).sum(1)
    torch.testing.assert_close(gained, 7 * scene.dt * force.sum((0, 2)), rtol=1e-11, atol=1e-16)


def test_walls_meet_the_nodes_where_they_are():
    """A falling node is stopped in the substep that begins with it inside the wall, not by the place where it was at rest."""
    floor = Wall(normal=(0.0, 1.0), offset=0.15, contact="stick")
    scene = tiny(2, walls=[floor])
    start, params = rest(scene)
    u, v = lagrangian.project(scene, start._replace(v=start.v - f64([0.0, 1.0])), params)
    assert u.abs().max() == 0 and v[..., 1].min() < -0.999
    present, y = nodal(scene, params)[0] > 0, walls.nodes(scene)[:, 1]
    for below in (0.0, 0.5, 1.0):
        shifted = u - f64([0.0, y[present[0]].min() - 0.15 + (below - 0.5) * DX])
        _, after = lagrangian.simulate(scene, shifted, v, None, params, substeps=1)
        held = (y + shifted[..., 1] <= 0.15) & present
        assert (after[held] == 0).all() and (after[present & ~held][:, 1] < -0.9).all()
        assert held.any() == (below >= 0.5) and (present & ~held).any()


@DIMS
def test_worlds_and_control_steps(dim):
    """Worlds with inputs of their own are calls of their own, and control steps follow each other: ≤ 1e-13."""
    scene = full(dim)
    params, n = shaken(scene, worlds=2)[1], len(rest(scene)[0].x[0])
    u, v = (
        torch.cat(parts)
        for parts in zip(*(moved(scene, rest(scene)[1], seed) for seed in (1, 5)), strict=True)
    )
    activation = 0.5 * randn(2, 2, 2, seed=61)
    given = {
        "gravity": randn(2, dim, seed=70),
        "damping": f64([0.0, 2.5]),
        "friction": f64([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]]),
        "direction": randn(2, 2, dim, seed=62),
        "strength": f64([[3.0, 9.0], [12.0, -4.0]]),
        "viscosity": 0.05 * randn(2, n, seed=75).abs(),
        "force": 0.01 * randn(2, 2, n, dim, seed=80),
    }
    both = lagrangian.simulate(scene, u, v, activation, params, substeps=3, inputs=Inputs(**given))
    for w in range(2):
        part, at = slice(w, w + 1), (u[w : w + 1], v[w : w + 1])
        for c in range(2):
            own = {k: value[part] for k, value in given.items() if k != "force"}
            inputs = Inputs(**own, force=given["force"][c : c + 1, part])
            at = lagrangian.simulate(
                scene,
                *at,
                activation[c : c + 1, part],
                type(params)(*(p[part] for p in params)),
                substeps=3,
                inputs=inputs,
            )
        for got, want in zip(both, at, strict=True):
            torch.testing.assert_close(got[part], want, rtol=0, atol=1e-13 * want.abs().max().item())


@DIMS
def test_driven_particles_have_their_velocities(dim):
    """Exactly where these are affine in X, whatever forces act; the gradient of a loss on the others is a central difference."""
    scene = dataclasses.replace(full(dim), walls=[], driven=[4, 1, 0, 2, 3, 5, *range(6, 6 * (dim - 1))])
    start, params = rest(scene)
    u, v = lagrangian.project(scene, start, params)
    places = start.x[0, list(scene.driven)]
    V = f64([0.3, -0.2, 0.1][:dim]) + places @ randn(dim, dim, seed=3)

    def end(velocity):
        given = Inputs(velocity=velocity)
        return lagrangian.simulate(scene, u, v, None, params, substeps=6, inputs=given)

    shown = lagrangian.evaluate(scene, *end(V))
    torch.testing.assert_close(shown.v[0, list(scene.driven)], V, rtol=0, atol=1e-12)
    torch.testing.assert_close(shown.x[0, list(scene.driven)], places + 6 * scene.dt * V, rtol=0, atol=1e-13)
    weights = [randn(*u.shape, seed=k) for k in (4, 5)]

    def loss(velocity):
        return sum((w * t).sum() for w, t in zip(weights, end(velocity), strict=True))

    leaf, d = V.clone().requires_grad_(), randn(*V.shape, seed=6)
    parts = torch.autograd.grad(loss(leaf), leaf)[0] * d
    want = difference(loss, V, d, 1e-3)
    assert parts.norm() > 0 and abs(parts.sum() - want) <= 1e-9 * parts.norm()


@DIMS
def test_gradient_of_a_rollout(dim):
    """Along a random direction of each differentiable argument equals a central difference: ≤ 5e-9."""
    chamber = Pressure(particles=np.arange(5), strength=4.0)
    scene = dataclasses.replace(full(dim), muscles=[*full(dim).muscles, chamber])
    _, params = rest(scene)
    (u, v), n = moved(scene, params), len(rest(scene)[0].x[0])
    v = v + (nodal(scene, params)[0] > 0)[..., None] * f64((2.0, -0.5, 0.3)[:dim])
    given = {
        "u": u,
        "v": v,
        "activation": 0.5 * randn(2, 1, 3, seed=70),
        **{name: value.clone() for name, value in params._asdict().items()},
        "gravity": randn(1, dim, seed=71),
        "damping": f64([1.2]),
        "friction": f64([[0.3, 0.0, 0.0]]),
        "direction": randn(1, 3, dim, seed=73),
        "strength": 8.0 + randn(1, 3, seed=74),
        "viscosity": 0.05 + 0.01 * randn(1, n, seed=75).abs(),
        "force": 0.03 * randn(2, 1, n, dim, seed=80),
    }
    weights = [randn(*t.shape, seed=90 + k) for k, t in enumerate(rest(scene)[0][:4])]

    def loss(values):
        own = {name: values[name] for name in list(given)[6:]}
        material = type(params)(*(values[name] for name in params._fields))
        end = lagrangian.simulate(
            scene, values["u"], values["v"], values["activation"], material, substeps=3, inputs=Inputs(**own)
        )
        state = lagrangian.evaluate(scene, *end)
        return sum((w * t).sum() for w, t in zip(weights, state[:4], strict=True))

    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    gradient = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values())), strict=True))
    scale = dict(u=1e-3, poisson=0.05)
    for k, (name, value) in enumerate(given.items()):
        d = scale.get(name, 0.2 * value.abs().mean()) * randn(*value.shape, seed=100 + k)
        want = difference(lambda at: loss(given | {name: at}), value, d, 1e-4)  # noqa: B023
        parts = gradient[name] * d
        assert parts.isfinite().all() and parts.norm() > 0, name
        assert abs(parts.sum() - want) <= 5e-9 * max(abs(want), parts.norm()) + 4e-9, name


@DIMS
def test_adjoint_of_a_substep(dim):
    """(Q4.adj) to (Q1.adj) as docs/math/lagrangian.md has them, from arbitrary cotangents, against autograd: ≤ 1e-12."""
    scene = with_material(tiny(dim, gravity=(0.3, -9.8, 0.2)[:dim], damping=2.0), NeoHookean)
    params, points = rest(scene)[1], lagrangian.quadrature(scene)
    of_nodes, mu, lam = nodal(scene, params)
    u, v = moved(scene, params)
    eta, force = f64([[0.7]]).expand_as(mu), 0.1 * randn(*points.X[None].shape, seed=7)
    g, gamma, m = f64(scene.gravity)[None], f64([2.0]), of_nodes[..., None]
    names = ("u", "v", "mu", "lam", "m", "eta", "force", "g", "gamma")
    leaves = [t.clone().requires_grad_() for t in (u, v, mu, lam, of_nodes, eta, force, g, gamma)]

    def go(u, v, mu, lam, m, eta, force, g, gamma):
        inputs = Inputs(viscosity=eta, force=force, gravity=g, damping=gamma)
        return lagrangian.step(scene, points, u, v, None, mu, lam, m, inputs)

    bar_u, bar_v = randn(*u.shape, seed=8), randn(*u.shape, seed=9)
    want = dict(zip(names, torch.autograd.grad(go(*leaves), leaves, (bar_u, bar_v)), strict=True))

    dt, V, present = scene.dt, moving.rest_volume(scene, u.dtype)[:, None, None], m > 0
    decay, one = math.exp(-2.0 * dt), torch.where(present, m, 1.0)
    F = torch.eye(dim) + lagrangian.gather(points, u)[1]
    inverse = torch.linalg.inv(F)
    L = lagrangian.gather(points, v)[1] @ inverse
    tau = stress.neo_hookean(F, mu, lam) + stress.viscous_stress(F, L, eta)
    P = tau @ inverse.mT
    f = lagrangian.node_force(scene, points, u, v, None, mu, lam, Inputs(viscosity=eta, force=force))
    v_star = torch.where(present, decay * (v + dt * (f / one + g[:, None])), 0.0)

    got = {}
    bar_star = present * (bar_v + dt * bar_u)  # (Q4.adj), no wall
    bar_f = dt * decay * bar_star / one  # (Q3.adj)
    got["m"] = -((bar_f * f).sum(-1) / one[..., 0])
    got["g"] = dt * decay * bar_star.sum(1)
    got["gamma"] = -dt * (bar_star * v_star).sum((1, 2))
    at_particles, slope = lagrangian.gather(points, bar_f)
    got["force"] = at_particles  # (Q2.adj)
    bar_P = -V * slope
    bar_tau = bar_P @ inverse
    eye, J = torch.eye(dim).double(), torch.linalg.det(F)
    T, D, B = (bar_tau + bar_tau.mT) / 2, (L + L.mT) / 2, F @ F.mT
    trace = torch.einsum("wpii->wp", bar_tau)
    got["mu"] = (bar_tau * (B - eye)).sum((-2, -1))  # (E1), (E6.adj)
    got["lam"] = trace * J.log()
    got["eta"] = 2 * (T * (B @ D @ B)).sum((-2, -1))
    bar_L = 2 * eta[..., None, None] * B @ T @ B
    bar_F = 2 * mu[..., None, None] * T @ F + (lam * trace)[..., None, None] * inverse.mT
    bar_F = bar_F + 4 * eta[..., None, None] * (T @ B @ D + D @ B @ T) @ F
    bar_F = bar_F - inverse.mT @ bar_P.mT @ P - L.mT @ bar_L @ inverse.mT  # (Q2.adj), (Q1.adj)
    bar_rate = bar_L @ inverse.mT

    def spread(M):
        return lagrangian.scatter(scene, points, torch.einsum("wpij,pkj->wpki", M, points.slope))

    got["u"] = bar_u + spread(bar_F)
    got["v"] = decay * bar_star + spread(bar_rate)
    for name in names:
        terms = dt * (bar_star * v_star).abs().sum() if name == "gamma" else want[name].abs().max()
        assert (got[name] - want[name]).abs().max() <= 1e-12 * terms, name


@DIMS
def test_adjoint_of_the_projection(dim):
    """(Q6.adj) and (Q5.adj) as docs/math/lagrangian.md has them against autograd: ≤ 1e-12."""
    scene = tiny(dim)
    state, params = shaken(scene)
    points, mass = lagrangian.quadrature(scene), masses(scene, params)
    leaves = [t.clone().requires_grad_() for t in (*state[:4], params.density)]
    u, v = lagrangian.project(scene, State(*leaves[:4]), params._replace(density=leaves[4]))
    bar_u, bar_v = randn(*u.shape, seed=8), randn(*u.shape, seed=9)
    want = torch.autograd.grad((u, v), leaves, (bar_u, bar_v))
    m = nodal(scene, params)[0][..., None]
    hat = torch.where(m > 0, torch.cat((bar_u, bar_v), -1) / torch.where(m > 0, m, 1.0), 0.0)
    near = hat[:, points.node]
    weighted = mass[..., None, None] * points.N[..., None] * near
    sums, turns = weighted.sum(2), torch.einsum("wpki,pkj->wpij", weighted, points.r)
    bar_A = turns[..., dim:, :]
    x, v_p, C, F = state[:4]
    slopes = torch.cat((F - torch.eye(dim), C @ F), -2)
    fields = torch.cat((x - points.X, v_p), -1)[:, :, None] + torch.einsum("wpij,pkj->wpki", slopes, points.r)
    gap = fields - torch.cat((u, v), -1)[:, points.node]
    bar_mass = torch.einsum("pk,wpki,wpki->wp", points.N, near, gap)
    got = (
        sums[..., :dim],
        sums[..., dim:],
        bar_A @ F.mT,
        turns[..., :dim, :] + C.mT @ bar_A,
        bar_mass * moving.rest_volume(scene, x.dtype),
    )
    for a, b in zip(got, want, strict=True):
        assert (a - b).abs().max() <= 1e-12 * b.abs().max()

    u, v = (t.clone().requires_grad_() for t in moved(scene, params))
    end = lagrangian.evaluate(scene, u, v)
    bars = [randn(*t.shape, seed=10 + k) for k, t in enumerate(end[:4])]
    want = torch.autograd.grad(end[:4], (u, v), bars)
    inverse = torch.linalg.inv(end.F.detach())
    bar_rate = bars[2] @ inverse.mT
    bar_F = bars[3] - end.C.mT @ bars[2] @ inverse.mT
    for bar, M, expected in ((bars[0], bar_F, want[0]), (bars[1], bar_rate, want[1])):
        share = points.N[..., None] * bar[:, :, None] + torch.einsum("wpij,pkj->wpki", M, points.slope)
        got = lagrangian.scatter(scene, points, share)
        assert (got - expected).abs().max() <= 1e-12 * expected.abs().max()


@DIMS
def test_fastest_oscillation(dim):
    """ω² of a particle alone at rest is that of (Q7), to rounding, and of a body no more than that of its worst particle."""

    def fastest(scene):
        params = rest(scene)[1]
        points, (of_nodes, mu, lam) = lagrangian.quadrature(scene), nodal(scene, params)
        present = of_nodes[0] > 0
        zero = torch.zeros(1, *of_nodes.shape[1:], dim).double()
        stiffness = (
            -torch.autograd.functional.jacobian(
                lambda u: lagrangian.node_force(scene, points, u, zero, None, mu, lam)[0, present],
                zero,
            )[:, :, 0, present]
            .flatten(0, 1)
            .flatten(1, 2)
        )
        root = of_nodes[0, present].rsqrt().repeat_interleave(dim)
        tangent = torch.autograd.functional.jacobian(
            lambda F: stress.neo_hookean(F, mu[0, 0], lam[0, 0]) @ torch.linalg.inv(F).mT,
            torch.eye(dim).double(),
        ).view(dim, dim, dim, dim)
        bound = torch.linalg.eigvalsh(tangent.reshape(dim * dim, dim * dim))[-1] * 4 / DX**2 / 1.2
        return torch.linalg.eigvalsh(root[:, None] * stiffness * root)[-1], bound

    material = NeoHookean(density=1.2, young=80.0, poisson=0.3)
    for place in (0.47, 0.45, 0.5, 0.4501):
        alone, bound = fastest(tiny(dim, bodies=[Body(Particles(np.full((1, dim), place), 1e-3), material)]))
        torch.testing.assert_close(alone, bound, rtol=1e-9, atol=0)
    many, bound = fastest(with_material(tiny(dim), NeoHookean))
    assert 0.3 * bound < many <= bound
