"""Contact at surface points: the adjoint of docs/math/contact.md, laws of mechanics, and blocks that rest, stick and slide."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from oracle_scenes import DIMS, DX, difference, f64, full, masses, randn, rest, tiny

from softmpm.inputs import Inputs
from softmpm.oracle import contact as oracle_contact
from softmpm.oracle import lagrangian, moving, stress, transfer
from softmpm.oracle import walls as oracle_walls
from softmpm.oracle.contact import Surface
from softmpm.scene.materials import NeoHookean
from softmpm.scene.scene import Body, Grid, Particles, Scene, Wall


def surface_at(scene: Scene, positions, area, stiffness) -> Surface:
    """Points with the B-spline weights of the grid."""
    X = torch.as_tensor(positions)
    nodes = transfer.stencil(scene, X[None])
    node, w = (torch.stack([part[k][0] for part in nodes], 1) for k in range(2))
    area, stiffness = (torch.as_tensor(value).double().expand(len(X)) for value in (area, stiffness))
    return Surface(X, node, w, area, stiffness)


def nodal_mass(scene: Scene) -> torch.Tensor:
    points = lagrangian.quadrature(scene)
    return lagrangian.node_mass(scene, points, masses(scene, rest(scene)[1])[None])


def touching(dim: int) -> tuple[Scene, Surface]:
    """A point at each particle, and two separating walls about them, with a sticking one between them in the scene."""
    walls = [
        Wall(normal=(0.0, 1.0, 0.0)[:dim], offset=0.47, friction=0.3),
        Wall(normal=(0.0, 0.0, 1.0)[-dim:], offset=-9.0, contact="stick"),
        Wall(normal=(-0.8, 0.5, 0.3)[:dim], offset=0.14 * dim - 0.41, friction=0.6),
    ]
    scene = tiny(dim, walls=walls)
    X = lagrangian.quadrature(scene).X
    area = DX ** (dim - 1) * (0.2 + randn(len(X), seed=1).abs())
    return scene, surface_at(scene, X, area, 4e5 * (0.5 + randn(len(X), seed=2).abs()))


def pushed(scene: Scene, surface: Surface, worlds: int = 1) -> tuple[torch.Tensor, ...]:
    """Random u, v and anchors, and the mass of the nodes."""
    mass = nodal_mass(scene).expand(worlds, -1)
    present = (mass > 0)[..., None]
    u, v = (present * randn(*mass.shape, scene.grid.dim, seed=3 + k) for k in range(2))
    noise = 2e-2 * randn(worlds, *surface.X.shape, seed=5)
    anchor = oracle_contact.start_anchor(scene, surface._replace(X=surface.X + noise), 4e-3 * u)
    return 4e-3 * u, 2.0 * v, anchor, mass


@DIMS
def test_linear_fields_reach_the_points(dim):
    """Weights of B-splines reproduce u = A X + b, and the start of an anchor has no part along its normal: ≤ 1e-14."""
    scene, surface = touching(dim)
    A, b = randn(dim, dim, seed=1), randn(dim, seed=2)
    u = (oracle_walls.nodes(scene) @ A.T + b)[None]
    got = oracle_contact.gather(surface, u)[0]
    torch.testing.assert_close(got, surface.X @ A.T + b, rtol=0, atol=1e-14)
    anchor = oracle_contact.start_anchor(scene, surface, u)
    assert anchor.shape == (1, 2, len(surface.X), dim)
    for k, wall in enumerate(scene.walls[::2]):
        assert (anchor[:, k] @ f64(wall.normal)).abs().max() <= 1e-14


def operator(scene: Scene, surface: Surface, mass: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """W, M⁻¹ and A as matrices over the nodes with mass."""
    W = torch.zeros(len(surface.X), mass.shape[-1]).double()
    W = W.scatter_add(1, surface.node, surface.w)[:, mass[0] > 0]
    return W, torch.diag(1 / mass[0, mass[0] > 0]), torch.diag(surface.area)


@DIMS
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_one_pass_does_not_overshoot(dim, noise):
    """D⁻¹ W M⁻¹ Wᵀ A has eigenvalues in [0, 1], the greatest of them 1 for weights ≥ 0; with negative weights as well."""
    scene, surface = touching(dim)
    surface = surface._replace(w=surface.w + noise * randn(*surface.w.shape, seed=1) * (surface.w > 0.02))
    assert (surface.w < 0).any() == (noise > 0)
    mass = nodal_mass(scene)
    D = oracle_contact.delassus(scene, surface, mass)[0]
    W, inverse, A = operator(scene, surface, mass)
    values = torch.linalg.eigvals((W @ inverse @ W.T @ A) / D[:, None])
    assert values.imag.abs().max() <= 1e-6 and values.real.min() >= -1e-6
    greatest = values.real.max().item()
    assert greatest == pytest.approx(1.0, abs=1e-12) if noise == 0 else 0.2 < greatest <= 1.0


@DIMS
def test_step_limit_of_the_bound_points(dim):
    """u'' = (1 − Θ)((2 − Δt² K) u' − u) has no growing mode up to Δt ω = 2, whatever the projection Θ and the stiffness K."""
    scene, surface = touching(dim)
    mass = nodal_mass(scene)
    W, inverse, A = operator(scene, surface, mass)
    D = oracle_contact.delassus(scene, surface, mass)[0]
    root = inverse.sqrt()
    bound = root @ W.T @ (A / D[:, None]) @ W @ root
    count = len(bound)
    for seed in range(3):
        Q = torch.linalg.qr(randn(count, count, seed=seed))[0]
        K = Q @ torch.diag(torch.linspace(0.0, 4.0, count).double()) @ Q.T
        keep, zero = torch.eye(count).double() - bound, torch.zeros(count, count).double()
        step = torch.cat(
            (torch.cat((keep @ (2 * torch.eye(count) - K), -keep), 1), torch.eye(2 * count)[:count])
        )
        assert torch.linalg.eigvals(step).abs().max() <= 1 + 1e-6
        free = torch.cat(
            (torch.cat((2 * torch.eye(count) - 1.05 * K, zero - torch.eye(count)), 1), step[count:])
        )
        assert torch.linalg.eigvals(free).abs().max() > 1.1, "the test has no power"


@DIMS
def test_impulses_change_the_momentum(dim):
    """Σ m (v' − v*) = Σ A J, and a node without mass keeps the velocity zero."""
    scene, surface = touching(dim)
    u, v, anchor, mass = pushed(scene, surface, worlds=2)
    after, _, J = oracle_contact.contact(scene, surface, u, v, anchor, mass)
    gained, given = (mass[..., None] * (after - v)).sum(1), (surface.area[:, None] * J).sum((1, 2))
    assert given.abs().max() > 1e-3
    torch.testing.assert_close(gained, given, rtol=0, atol=1e-13)
    assert (after[mass == 0] == 0).all()


def test_one_point_is_stopped_exactly():
    """A point alone ends on the wall: y + Δt v_n = 0, within the smoothing width s of it for H of width s."""
    for smoothing, depth in ((0.0, 0.0), (1e-3, 1e-3)):
        scene, surface = touching(2)
        surface = Surface(*(part[:1] for part in surface[:5]))
        _, _, anchor, mass = pushed(scene, surface)
        v = torch.zeros(*mass.shape, 2).double() + f64([0.3, -90.0])
        u = torch.zeros_like(v)
        for w in range(2):  # the walls alone
            one = dataclasses.replace(scene, walls=[scene.walls[2 * w]])
            after, _, J = oracle_contact.contact(
                one, surface, u, v, anchor[:, w : w + 1], mass, Inputs(), smoothing
            )
            n, at = f64(one.walls[0].normal), surface.X + one.dt * oracle_contact.gather(surface, after)
            assert (J @ n > 0).all()
            assert (at[0, 0] @ n).item() == pytest.approx(one.walls[0].offset - depth, abs=1e-13)


@DIMS
def test_a_uniform_pressure_is_found_in_one_pass(dim):
    """Points on the wall with nodes that a uniform impulse per area brings to rest get that impulse: ≤ 1e-12."""
    scene = tiny(dim, walls=[Wall(normal=(0.0, 1.0, 0.0)[:dim], offset=0.4)])
    X, mass, n = (
        lagrangian.quadrature(scene).X.clone(),
        nodal_mass(scene),
        f64(scene.walls[0].normal),
    )
    X[:, 1] = 0.4
    surface = surface_at(scene, X, 0.01 + 0.01 * randn(len(X), seed=1).abs(), 1.0)
    surface = surface._replace(w=surface.w * (mass[0] > 0)[surface.node])
    load = torch.zeros_like(mass[0]).index_add(
        0, surface.node.flatten(), (0.02 * surface.area[:, None] * surface.w).flatten()
    )
    v = -(load / torch.where(mass > 0, mass, 1.0))[..., None] * n
    anchor = oracle_contact.start_anchor(scene, surface, 0 * v)
    after, _, J = oracle_contact.contact(scene, surface, 0 * v, v, anchor, mass)
    torch.testing.assert_close(J, (0.02 * n).expand_as(J), rtol=1e-12, atol=0)
    assert v.abs().max() > 0.1 and after.abs().max() <= 1e-12


@DIMS
@pytest.mark.parametrize("smoothing", [0.0, 1e-3, 0.05])
def test_contact_takes_energy(dim, smoothing):
    """Two walls that no point has penetrated never raise the kinetic energy, with friction and anchors where the points are."""
    scene, surface = touching(dim)
    walls = [
        dataclasses.replace(w, offset=(surface.X @ f64(w.normal)).min().item()) for w in scene.walls[::2]
    ]
    scene = dataclasses.replace(scene, walls=walls)
    u, _, _, mass = pushed(scene, surface)
    anchor = oracle_contact.start_anchor(scene, surface, 0 * u)
    n = f64(walls[0].normal) + f64(walls[1].normal)
    for seed in range(4):
        v = (mass > 0)[..., None] * 30.0 * (randn(*u.shape, seed=seed) - n)
        after, _, J = oracle_contact.contact(scene, surface, 0 * u, v, anchor, mass, smoothing=smoothing)
        taken = (mass[..., None] * (v**2 - after**2)).sum() / 2
        assert (J != 0).any(-1).any(-1).all() and taken > 0


TIME, DURATION = 4e-4, 2e-3
"""Of a substep since the beginning of a control step, and its length [s]."""


def unit_poses(inputs, w, dt) -> list[tuple[torch.Tensor, ...]]:
    """(C4) at the beginning and the end of a substep: n, o, |a| and the share of the second pose."""
    size = torch.linalg.vector_norm(inputs.wall_normal[:, :, w], dim=-1, keepdim=True)
    n, o = inputs.wall_normal[:, :, w] / size, inputs.wall_offset[:, :, w, None] / size
    found = []
    for share in (TIME / DURATION, (TIME + dt) / DURATION):
        a, offset = (1 - share) * n[0] + share * n[-1], (1 - share) * o[0] + share * o[-1]
        length = torch.linalg.vector_norm(a, dim=-1, keepdim=True)
        found.append((a / length, offset / length, length, share))
    return found


def poses_adj(inputs, w, dt, bars) -> tuple[torch.Tensor, torch.Tensor]:
    """(C4.adj): from the adjoints of n and o at the beginning and the end of a substep, those of what was given."""
    given_n, given_o = inputs.wall_normal[:, :, w], inputs.wall_offset[:, :, w, None]
    size = torch.linalg.vector_norm(given_n, dim=-1, keepdim=True)
    n, o = given_n / size, given_o / size
    bar_n, bar_o = torch.zeros_like(n), torch.zeros_like(o)
    for (unit, offset, length, share), (at_n, at_o) in zip(unit_poses(inputs, w, dt), bars, strict=True):
        along = (unit * at_n).sum(-1, keepdim=True) + offset * at_o
        at_a, at_o = (at_n - along * unit) / length, at_o / length
        for pose, part in ((0, 1 - share), (-1, share)):
            bar_n[pose] += part * at_a
            bar_o[pose] += part * at_o
    across = bar_n - ((n * bar_n).sum(-1, keepdim=True) + o * bar_o) * n
    return across / size, (bar_o / size)[..., 0]


def adjoint(
    scene, surface, u, v, anchor, mass, inputs, smoothing, bar_v, bar_a, bar_J_out
) -> tuple[dict, set]:
    """docs/math/contact.md line by line, from the cotangents of v', a' and J, and the branches that were taken."""
    dt, k, A = scene.dt, surface.stiffness[:, None], surface.area[:, None]
    D, present = oracle_contact.delassus(scene, surface, mass)[..., None], mass > 0
    one, branches = torch.where(present, mass, 1.0), set()
    about = (inputs, smoothing, TIME, DURATION)
    after, _, J = oracle_contact.contact(scene, surface, u, v, anchor, mass, *about)
    x = surface.X + oracle_contact.gather(surface, u)
    walls = oracle_contact.separating(scene)
    before = [oracle_contact.gather(surface, v)]
    for number in range(len(walls)):
        before.append(before[-1] + D * J[:, number])

    bar_m = -(bar_v * (after - v)).sum(-1) / one * present  # (K5.adj)
    bar_J_nodes = A * oracle_contact.gather(surface, present[..., None] * bar_v / one[..., None])
    bar_x, bar_vs, bar_D = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(D)
    given = ("friction", "wall_offset", "wall_normal", "wall_velocity")
    got = {name: torch.zeros_like(getattr(inputs, name)) for name in given}
    got["anchor"] = torch.zeros_like(anchor)
    for number in reversed(range(len(walls))):
        w = walls[number]
        (n_old, o_old, _, _), (n, offset, _, _) = unit_poses(inputs, w, dt)
        n_old, o_old, n, offset = (part[:, None] for part in (n_old, o_old, n, offset))
        mu, a_old, v_s = inputs.friction[:, w][:, None, None], anchor[:, number], before[number]
        slide = inputs.wall_velocity[:, w][:, None]
        dot = lambda p, q: (p * q).sum(-1, keepdim=True)  # noqa: E731
        cos, level = dot(n, n_old), (o_old + offset) / (1 + dot(n, n_old))
        lean = dot(n, a_old) / (1 + cos)  # (K6)
        a = a_old + level * (n_old - cos * n) - lean * (n_old + n) + dt * (slide - dot(n, slide) * n)
        v_n, v_t, x_t = dot(n, v_s), v_s - dot(n, v_s) * n, x - dot(n, x) * n
        d = -(dot(n, x) - offset + dt * (v_n - dot(n, slide)))
        slope = (d > 0).double() if smoothing == 0 else (d / (2 * smoothing)).clamp(0.0, 1.0)
        P = oracle_contact.hinge(d, smoothing) / (dt * D)
        e, c = x_t + dt * v_t - a, k * dt / (1 + D * k * dt**2)
        size = torch.linalg.vector_norm(-c * e, dim=-1, keepdim=True)
        free, slip = P <= 0, ((size > mu * P) | (mu == 0)) & (P > 0)
        stick = ~free & ~slip
        branches |= {
            name for name, where in (("free", free), ("slip", slip), ("stick", stick)) if where.any()
        }
        tau, T = -c * e / size, J[:, number] - dot(n, J[:, number]) * n

        bar_J = bar_J_nodes + bar_J_out[:, number] + D * bar_vs  # (K5.adj), (K7.adj)
        bar_D = bar_D + dot(J[:, number], bar_vs)
        bar_a_w = bar_a[:, number]
        bar_T = bar_J + slip * (dt * D + 1 / (k * dt)) * bar_a_w  # (K4.adj)
        bar_x_t = (slip | free) * bar_a_w
        bar_v_t = (slip | free) * (dt * bar_a_w)
        bar_D = bar_D + slip * (dt * dot(T, bar_a_w))
        along = dot(tau, bar_T)
        got["friction"][:, w] += (slip * P * along).sum((1, 2))
        bar_P = dot(n, bar_J) + slip * mu * along
        bar_T0 = torch.where(slip, mu * P / size * (bar_T - tau * along), torch.where(stick, bar_T, 0.0))
        bar_e, bar_c = -c * bar_T0, -dot(e, bar_T0)
        bar_D = bar_D - stick * c**2 * dt * bar_c
        bar_x_t, bar_v_t = bar_x_t + bar_e, bar_v_t + dt * bar_e
        bar_anchor = stick * bar_a_w - bar_e
        bar_d = bar_P * slope / (dt * D)  # (K3.adj)
        bar_D = bar_D - bar_P * P / D
        bar_y, bar_v_n = -bar_d, -dt * bar_d
        bar_n = bar_y * x + (bar_v_n - dot(n, bar_v_t)) * v_s - v_n * bar_v_t + P * bar_J
        bar_n = bar_n - dot(n, x) * bar_x_t - dot(n, bar_x_t) * x - dt * bar_y * slide
        q, r = (
            dot(n_old + n, bar_anchor) / (1 + cos),
            dot(n_old - cos * n, bar_anchor) / (1 + cos),
        )  # (K6.adj)
        got["anchor"][:, number] = bar_anchor - q * n
        bar_cos = lean * q - level * r - level * dot(n, bar_anchor)
        bar_old = (level - lean) * bar_anchor + bar_cos * n
        bar_n = bar_n - (cos * level + lean) * bar_anchor - q * a_old + bar_cos * n_old
        bar_n = bar_n - dt * (dot(n, bar_anchor) * slide + dot(n, slide) * bar_anchor)
        slid = dt * (bar_anchor - dot(n, bar_anchor) * n - bar_y * n)
        got["wall_velocity"][:, w] = slid.sum(1)
        bars = (bar_old.sum(1), r.sum(1)), (bar_n.sum(1), (r - bar_y).sum(1))
        got["wall_normal"][:, :, w], got["wall_offset"][:, :, w] = poses_adj(inputs, w, dt, bars)
        bar_x = bar_x + bar_y * n + bar_x_t - dot(n, bar_x_t) * n
        bar_vs = bar_vs + bar_v_n * n + bar_v_t - dot(n, bar_v_t) * n

    def spread(values):  # (K2.adj)
        share = surface.w[..., None] * values[:, :, None]
        return torch.zeros_like(u).index_add(1, surface.node.flatten(), share.flatten(1, 2))

    load = torch.zeros_like(mass[0]).index_add(0, surface.node.flatten(), (surface.w.abs() * A).flatten())
    share = (surface.w.abs() * bar_D).flatten(1)  # (K1.adj)
    sums = torch.zeros_like(mass).index_add(1, surface.node.flatten(), share)
    got |= {"u": spread(bar_x), "v": bar_v + spread(bar_vs), "mass": bar_m - present * sums * load / one**2}
    return got, branches


@DIMS
@pytest.mark.parametrize("smoothing", [0.0, 4e-3])
@pytest.mark.parametrize("friction", [0.0, 0.3, 1e-6, 1e3])
@pytest.mark.parametrize("poses", [1, 2])
def test_adjoint_of_contact(dim, smoothing, friction, poses):
    """(K7.adj) to (K1.adj), from arbitrary cotangents, equal autograd, with two walls at once, which rest or turn: ≤ 1e-12."""
    scene, surface = touching(dim)
    sign = (surface.w > 0.02) * 0.1 * randn(*surface.w.shape, seed=6)
    surface = surface._replace(w=surface.w + sign)  # some are negative
    u, v, anchor, mass = pushed(scene, surface, worlds=2)
    mass = (mass > 0) * 0.01 * (1 + 0.1 * randn(*mass.shape, seed=7))  # none so small that 1/m rounds
    given = {
        "friction": f64([[friction, 0.0, friction], [2 * friction, 0.0, 0.5 * friction]]),
        "wall_offset": 1.7 * f64([[[wall.offset for wall in scene.walls]] * 2] * poses),
        "wall_normal": 1.7 * f64([[[wall.normal for wall in scene.walls]] * 2] * poses),
        "wall_velocity": randn(2, 3, dim, seed=10),
    }
    if poses == 2:
        for k, (name, noise) in enumerate((("wall_offset", 2e-3), ("wall_normal", 1e-2))):
            given[name] = given[name] + noise * randn(*given[name].shape, seed=11 + k)
    values = {"u": u, "v": v, "anchor": anchor, "mass": mass, **given}
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    inputs = Inputs(**{name: leaves[name] for name in given})
    end = oracle_contact.contact(
        scene,
        surface,
        *(leaves[k] for k in ("u", "v", "anchor", "mass")),
        inputs,
        smoothing,
        TIME,
        DURATION,
    )
    assert (end[2] != 0).any(-1).all(1).any(), "no point touches two walls"
    bars = randn(*v.shape, seed=8), randn(*anchor.shape, seed=9), randn(*anchor.shape, seed=13)
    want = torch.autograd.grad(end, list(leaves.values()), bars)
    got, branches = adjoint(scene, surface, u, v, anchor, mass, Inputs(**given), smoothing, *bars)
    expected = {0.3: {"free", "slip", "stick"}, 1e-6: {"free", "slip"}, 1e3: {"free", "stick"}}
    assert branches == expected.get(friction, {"free", "slip"})
    unused = {0.0: ("anchor",), 1e3: ("friction",)}.get(friction, ())
    for name, theirs in zip(leaves, want, strict=True):
        assert theirs.isfinite().all() and (theirs.norm() == 0) == (name in unused), name
        limit = (
            1e-12 * theirs.abs().max() + 1e-15
        )  # that of an anchor that slides in 2D is zero but for rounding
        assert (got[name] - theirs).abs().max() <= limit, name


@DIMS
def test_friction_and_onset_are_continuous(dim):
    """v' and a' do not jump where a point begins to slide, where it is touched, nor from no friction to little."""
    scene, surface = touching(dim)
    scene = dataclasses.replace(scene, walls=scene.walls[:1])
    surface = Surface(*(part[:1] for part in surface[:5]))
    u, v, _, mass = pushed(scene, surface)
    anchor = oracle_contact.start_anchor(scene, surface, u) + 1e-3
    anchor[..., 1] = 0.0

    def go(friction, offset):
        inputs = Inputs(friction=f64([[friction]]), wall_offset=f64([[[offset]]]))
        return oracle_contact.contact(scene, surface, u, v, anchor, mass, inputs)

    J = go(1e6, 0.47)[2]
    edge = (J[0, 0, 0].norm() ** 2 - J[0, 0, 0, 1] ** 2).sqrt().item() / J[0, 0, 0, 1].item()
    below, above = go(edge * (1 - 1e-9), 0.47), go(edge * (1 + 1e-9), 0.47)
    for p, q in zip(below, above, strict=True):
        assert not torch.equal(p, q) and (p - q).abs().max() <= 1e-8
    x = surface.X + oracle_contact.gather(surface, u + scene.dt * v)
    touch = x[0, 0, 1].item()
    apart, onset, smooth, rough = (
        go(0.3, touch - 1e-12),
        go(0.3, touch + 1e-12),
        go(0.0, 0.47),
        go(1e-12, 0.47),
    )
    assert (apart[2] == 0).all() and (onset[2] != 0).any() and not torch.equal(smooth[2], rough[2])
    for pair in ((apart, onset), (smooth, rough)):
        for p, q in zip(*pair, strict=True):
            assert (p - q).abs().max() <= 1e-8


@pytest.mark.parametrize("contact", ["separate", "slip", "stick"])
def test_walls_of_other_kinds_act_on_nodes(contact):
    """With a surface, sticking and slipping walls hold the nodes inside as before, and a separating wall acts on none."""
    scene = tiny(2, walls=[Wall(normal=(0.0, 1.0), offset=0.45, contact=contact)])
    surface = Surface(*(part[:0] for part in touching(2)[1][:5]))
    v = (nodal_mass(scene) > 0)[..., None] * f64([0.0, -1.0])
    go = functools.partial(lagrangian.simulate, scene, 0 * v, v, None, rest(scene)[1], substeps=1)
    end, nodes = go(surface=surface), go()
    assert end[2].shape == end[3].shape == (1, contact == "separate", 0, 2) and not torch.equal(nodes[1], v)
    torch.testing.assert_close(end[1], v if contact == "separate" else nodes[1], rtol=0, atol=1e-9)


@DIMS
def test_gradient_of_a_rollout(dim):
    """Along a random direction of u, v, the anchors and inputs equals a central difference, with walls that turn: ≤ 1e-8."""
    scene = full(dim)
    params, surface = rest(scene)[1], touching(dim)[1]
    u, v, _, mass = pushed(scene, surface)
    anchor = oracle_contact.start_anchor(scene, surface, 0.2 * u)
    given = {
        "u": 0.2 * u,
        "v": 0.2 * v - (mass > 0)[..., None] * f64((2.0, 0.5, 0.0)[:dim]),
        "anchor": anchor,
        "density": params.density,
        "friction": f64([[0.3, 0.0, 0.0]]),
        "wall_offset": f64([[[wall.offset for wall in scene.walls]]]) + 5e-4 * randn(2, 1, 3, seed=14),
        "wall_normal": f64([[[wall.normal for wall in scene.walls]]]) + 1e-2 * randn(2, 1, 3, dim, seed=15),
        "wall_velocity": randn(1, 1, 3, dim, seed=16),
    }

    def loss(values):
        names = ("friction", "wall_offset", "wall_normal", "wall_velocity")
        inputs = Inputs(**{name: values[name] for name in names})
        end = lagrangian.simulate(
            scene,
            values["u"],
            values["v"],
            None,
            params._replace(density=values["density"]),
            substeps=3,
            inputs=inputs,
            surface=surface,
            anchor=values["anchor"],
            smoothing=0.02,
        )
        weights = (1.0, 1.0, 1.0, 1e-4)
        return sum((weights[k] * randn(*t.shape, seed=90 + k) * t).sum() for k, t in enumerate(end))

    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    gradient = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values())), strict=True))
    for k, (name, value) in enumerate(given.items()):
        d = {"friction": 1e-3, "wall_velocity": 1e-2}.get(name, 1e-4) * randn(*value.shape, seed=100 + k)
        want = difference(lambda at: loss(given | {name: at}), value, d, 1e-2)  # noqa: B023
        parts = gradient[name] * d
        assert parts.norm() > 0 and abs(parts.sum() - want) <= 1e-8 * parts.norm(), name


def slope(degrees: float, friction: float = 0.5) -> tuple[Scene, Surface, torch.Tensor]:
    """A stiff block of 4 x 2 cells with a viscosity of 2.6 ms on an incline, with gravity turned instead; and its nodal mass."""
    h, young, poisson, angle = 0.02, 2e5, 0.3, math.radians(degrees)
    axes = [(np.arange(2 * cells) + 0.5) / 2 for cells in (4, 2)]
    X = h * (np.array([3.5, 2.5]) + np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2))
    material = NeoHookean(density=1000.0, young=young, poisson=poisson, viscosity=200.0)
    scene = Scene(
        grid=Grid(shape=(11, 8), spacing=h),
        bodies=[Body(Particles(X, h * h / 4), material)],
        walls=[Wall(normal=(0.0, 1.0), offset=2.5 * h, friction=friction)],
        gravity=(9.8 * math.sin(angle), -9.8 * math.cos(angle)),
        dt=2.5e-4,
    )
    stiffness = 4 * young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson)) / h
    sole = np.stack((X[::4, 0], np.full(8, 2.5 * h)), -1)
    return scene, surface_at(scene, sole, h / 2, stiffness), nodal_mass(scene)


def advance(scene, surface, substeps, u=None, v=None, anchor=None):
    params = rest(scene)[1]
    zero = torch.zeros(1, math.prod(scene.grid.shape), scene.grid.dim).double()
    u, v = zero if u is None else u, zero if v is None else v
    return lagrangian.simulate(scene, u, v, None, params, substeps=substeps, surface=surface, anchor=anchor)


def test_a_block_rests_on_the_floor():
    """Impulses balance its weight to 1e-6, along the floor to 1e-9, and no point is further than 1e-4 dx from the surface."""
    scene, surface, mass = slope(0.0)
    u, v, anchor, _ = advance(scene, surface, 400)
    params, points = rest(scene)[1], lagrangian.quadrature(scene)
    mu, lam = (value[None] for value in stress.lame(params.young, params.poisson))
    impulse = scene.dt * lagrangian.node_force(scene, points, u, v, None, mu, lam)
    star = moving.grid_velocity(scene, mass, mass[..., None] * v + impulse, contacts=())
    _, _, J = oracle_contact.contact(scene, surface, u, star, anchor, mass)
    load, weight = (surface.area[:, None] * J).sum((0, 1, 2)) / scene.dt, 9.8 * mass.sum().item()
    assert load[1].item() == pytest.approx(weight, rel=1e-6) and abs(load[0].item()) <= 1e-9 * weight
    height = (surface.X + oracle_contact.gather(surface, u))[..., 1] - scene.walls[0].offset
    assert height.abs().max() <= 1e-4 * scene.grid.spacing


def test_a_block_sticks_below_the_friction_angle():
    """At 24° of 26.6° it does not creep: ≤ 2e-6 dx over 1,000 substeps. With an anchor that follows the points it does."""
    scene, surface, mass = slope(24.0)
    start = advance(scene, surface, 400)[:3]
    u, v, *_ = advance(scene, surface, 1000, *start)
    assert (u - start[0]).abs().max() <= 2e-6 * scene.grid.spacing and v.abs().max() <= 1e-9
    at = start[:2]
    for _ in range(100):
        at = advance(scene, surface, 1, *at)[:2]
    assert (at[0] - start[0])[mass > 0][:, 0].mean() > 1e-4 * scene.grid.spacing, "the test has no power"


def test_a_block_slides_above_the_friction_angle():
    """At 30° it accelerates with g (sin − μ cos), within 0.1 %."""
    scene, surface, mass = slope(30.0)
    speeds, at = [], ()
    for _ in range(2):
        at = advance(scene, surface, 200, *at)[:3]
        speeds.append(((mass[..., None] * at[1]).sum(1) / mass.sum())[0, 0].item())
    want = 9.8 * (math.sin(math.radians(30.0)) - 0.5 * math.cos(math.radians(30.0)))
    assert (speeds[1] - speeds[0]) / (200 * scene.dt) == pytest.approx(want, rel=1e-3)
