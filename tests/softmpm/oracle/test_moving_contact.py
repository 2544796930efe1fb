"""The float64 oracle of contact at surface points on the moving grid: weights, momentum, energy, places and the adjoint."""

import dataclasses

import pytest
import torch
from oracle_scenes import DX, f64, masses, randn, rest, shaken

from softmpm.inputs import Inputs
from softmpm.oracle import moving, stress, transfer
from softmpm.oracle.contact import across_walls, meet_walls
from softmpm.oracle.moving_contact import Points, meet, places, surface_points, weights
from softmpm.oracle.walls import nodes
from softmpm.scene.materials import NeoHookean
from softmpm.scene.scene import Body, Grid, Scene, Wall
from softmpm.scene.shapes import box
from softmpm.state import State

DIMS = pytest.mark.parametrize("dim", [2, 3])


def floor(dim: int, friction=0.5, **changes) -> Scene:
    """A block over a rough floor and next to a rough side wall."""
    shape = box((0.33, 0.3, 0.34)[:dim], (0.62, 0.5, 0.63)[:dim], spacing=DX / 2)
    up, aside = (0.0, 1.0, 0.0)[:dim], (1.0, 0.2, 0.0)[:dim]
    walls = [Wall(normal=up, offset=0.3, friction=friction), Wall(normal=aside, offset=0.3945, friction=0.2)]
    body = Body(shape, NeoHookean(density=1.2, young=80.0, poisson=0.3))
    settings = dict(grid=Grid(shape=(11, 10, 11)[:dim], spacing=DX), bodies=[body], walls=walls, dt=1e-3)
    return Scene(**(settings | changes))


def on_grid(scene: Scene, state: State, mass: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Masses and velocities of the nodes after P2G without stress."""
    affine = mass[..., None, None] * state.C
    of_nodes, momentum = transfer.p2g(scene, state.x, mass, mass[..., None] * state.v, affine)
    return of_nodes, momentum / torch.where(of_nodes > 0, of_nodes, 1.0)[..., None]


def at_points(scene: Scene, points: Points, state: State, field: torch.Tensor) -> torch.Tensor:
    """Σ W a of a field a on the nodes, (world, node, ...)."""
    node, W = weights(scene, points, state)
    around = torch.stack([a[near] for a, near in zip(field, node, strict=True)])
    return torch.einsum("wpn,wpn...->wp...", W, around)


@DIMS
def test_weights_sum_to_one_and_give_the_places(dim):
    """Σ W = 1 and Σ W x_i = x_p + F_p (X_s − X_p), with any x and F: ≤ 1e-14."""
    scene = floor(dim)
    points, (state, _) = surface_points(scene), shaken(scene, worlds=2, noise=2.0)
    ones, grid = torch.ones(2, len(nodes(scene)), 1).double(), nodes(scene).expand(2, -1, -1)
    x, rest_x = places(points, state), rest(scene)[0].x[0]
    arms = torch.tensor(scene.bodies[0].particles.outline.points) - rest_x[points.particle]
    assert (arms.norm(dim=-1).max() <= 0.5 * DX) and (points.arm == arms).all()
    want = state.x[:, points.particle] + torch.einsum("wpij,pj->wpi", state.F[:, points.particle], arms)
    torch.testing.assert_close(x, want, rtol=0, atol=1e-15)
    for field, exact in ((ones, torch.ones(2, len(arms), 1).double()), (grid, x)):
        torch.testing.assert_close(at_points(scene, points, state, field), exact, rtol=0, atol=1e-14)


def alone(dim: int, fraction: float) -> tuple[Scene, Points, State, torch.Tensor]:
    """One particle of 0.3 kg with a point below it, and ``fraction`` of a cell from where its highest nodes lose their mass."""
    scene = floor(dim)
    x = f64([[[0.4 + 0.5 * DX, 0.3 + (0.5 + fraction) * DX, 0.4 + 0.6 * DX][:dim]]])
    F = torch.eye(dim).double() + 0.2 * randn(1, 1, dim, dim)
    state = State(x, f64([[[1.0, -2.0, 0.5][:dim]]]), randn(1, 1, dim, dim, seed=1), F)
    arm = f64([[0.01, -0.03, 0.02][:dim]])
    points = Points(torch.zeros(1, dtype=torch.int64), arm, f64([0.05]), f64([3e3]))
    return scene, points, state, f64([[0.3]])


def response(dim: int, fraction: float) -> list[torch.Tensor]:
    """That particle after a substep in which its point meets the floor, with the gradient with respect to x, F and mass."""
    scene, points, (x, v, C, F, *_), mass = alone(dim, fraction)
    low = places(points, State(x, v, C, F))[0, 0, 1].item()
    wall = Wall(normal=(0.0, 1.0, 0.0)[:dim], offset=low - 1e-3, friction=0.3)
    scene = dataclasses.replace(scene, walls=[wall])
    leaves = [one.clone().requires_grad_() for one in (x, F, mass)]
    state = State(leaves[0], v, C, leaves[1])
    of_nodes, star = on_grid(scene, state, leaves[2])
    grid, _, J = meet(scene, points, state, across_walls(scene, places(points, state)), of_nodes, star)
    after = moving.from_grid(scene, state, grid, Inputs())
    end = places(points, after)[0, 0, 1].item()
    assert end == pytest.approx(wall.offset, abs=1e-14) and (J[0, 0, 0, 1] > 0)
    value = sum((randn(*one.shape, seed=k) * one).sum() for k, one in enumerate((after.v, after.C, J)))
    return [after.v.detach(), after.C.detach(), J.detach(), *torch.autograd.grad(value, leaves)]


@DIMS
def test_nodes_that_lose_their_mass(dim):
    """|W|/m is at most |1 + (4/dx²) r·b| / m_p whatever mass a node has; response and gradient tend to those without such nodes, and
    the point ends on the floor."""
    for fraction in (0.3, 1e-3, 1e-6, 1e-9):
        scene, points, state, mass = alone(dim, fraction)
        of_nodes, _ = on_grid(scene, state, mass)
        node, W = (part[0, 0] for part in weights(scene, points, state))
        r = nodes(scene)[node] - state.x[0, 0]
        bound = (1 + 4 / DX**2 * r @ state.F[0, 0] @ points.arm[0]).abs() / mass
        share = W.abs() / of_nodes[0, node]
        assert (share <= bound * (1 + 1e-12)).all() and of_nodes[0, node].min() <= 0.3 * fraction**2
    empty = response(dim, 0.0)
    for fraction in (1e-4, 1e-8):
        for got, want in zip(response(dim, fraction), empty, strict=True):
            assert torch.isfinite(got).all() and (got - want).abs().max() <= 1e2 * fraction * want.abs().max()


def met(scene: Scene, speed: float, reach: float = 1.0):
    """A block in random motion with arms ``reach`` times as long and its outermost points 1 nm from both walls: state, points, masses
    and velocities of the nodes, the response."""
    (state, params), points = rest(scene), surface_points(scene)
    points = points._replace(arm=reach * points.arm)
    push = speed * (randn(*state.v.shape) - f64([2.0, 2.0, 0.0][: scene.grid.dim]))
    state = state._replace(v=push, C=speed / DX * 0.1 * randn(*state.C.shape, seed=1))
    of_nodes, v = on_grid(scene, state, masses(scene, params).expand(1, -1))
    x = places(points, state)
    lowest = [(x @ f64(wall.normal)).min() - 1e-9 for wall in scene.walls]
    inputs = Inputs(wall_offset=torch.stack(lowest)[None])
    after = meet(scene, points, state, across_walls(scene, x), of_nodes, v, inputs)
    return state, points, of_nodes[..., None], v, after


def cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """a ∧ b, every component."""
    return a[..., :, None] * b[..., None, :] - a[..., None, :] * b[..., :, None]


@DIMS
def test_contact_gives_the_momentum_of_its_impulses(dim):
    """Σ m (v' − v*) = Σ A J, and about the origin Σ x_i ∧ m (v' − v*) = Σ x_s ∧ A J: they act at the points."""
    scene = floor(dim)
    state, points, mass, v, (after, _, J) = met(scene, speed=10.0)
    assert (J != 0).any(-1).any(2).all()
    gained, given = mass * (after - v), points.area[:, None] * J.sum(1)
    torch.testing.assert_close(gained.sum(1), given.sum(1), rtol=1e-12, atol=0)
    turned = cross(nodes(scene), gained).sum(1), cross(places(points, state), given).sum(1)
    torch.testing.assert_close(*turned, rtol=0, atol=1e-12 * turned[1].abs().max().item())


@DIMS
@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("reach", [1.0, 3.0])
def test_contact_takes_energy_from_the_moving_grid(dim, friction, reach):
    """Points that are not inside a wall and whose anchors are where they are gain no kinetic energy, with weights of both signs too."""
    for speed in (0.3, 3.0, 30.0):
        state, points, mass, v, (after, _, J) = met(floor(dim, friction), speed, reach)
        least = weights(floor(dim), points, state)[1].min()
        assert (least < -0.05) if reach > 1 else (least > -0.02)
        before, later = ((mass * one**2).sum() for one in (v, after))
        assert (J != 0).any(-1).any(-1).all() and later < before


@DIMS
def test_points_move_with_the_velocity_of_the_contact(dim):
    """x'_s = x_s + Δt Σ W v' after G2P, and that of a driven particle goes with it: ≤ 1e-14."""
    count = len(floor(dim).bodies[0].particles)
    scene = floor(dim, driven=range(0, count, 3))
    (state, _), points = shaken(scene, worlds=2), surface_points(scene)
    v, given = randn(2, len(nodes(scene)), dim, seed=5), randn(2, len(scene.driven), dim, seed=6)
    after = moving.from_grid(scene, state, v, Inputs(velocity=given))
    want = places(points, state) + scene.dt * at_points(scene, points, state, v)
    carried, _ = transfer.g2p(scene, state.x, v)
    driven = torch.isin(points.particle, torch.tensor(scene.driven))
    assert driven.any() and not driven.all()
    torch.testing.assert_close(places(points, after)[:, ~driven], want[:, ~driven], rtol=0, atol=1e-14)
    beyond = (scene.dt * (after.v - carried))[:, points.particle]
    torch.testing.assert_close(places(points, after), want + beyond, rtol=0, atol=1e-14)


def test_points_stay_at_their_body():
    """Half a second of a block that tumbles and wobbles in a corner: the points end where Σ W v' carried them, ≤ 1e-12, and where their
    second nearest particles show them, ≤ 0.02 cells."""
    scene = floor(2, gravity=(-5.0, -20.0))
    (state, params), points = rest(scene), surface_points(scene)
    X, shape = state.x[0], state.x - state.x.mean(1, keepdim=True)
    spin = f64([[0.5, -4.0], [7.0, -0.5]])
    state = state._replace(v=shape @ spin.T - f64([1.0, 1.0]), C=spin.expand_as(state.F))
    mass = masses(scene, params)[None]
    mu, lam = (one[None] for one in stress.lame(params.young, params.poisson))
    x = places(points, state)
    anchor, worst, touched = across_walls(scene, x), 0.0, 0
    for _ in range(500):
        of_nodes, v = moving.to_grid(scene, state, None, mu, lam, mass, Inputs(), 0.0, 1.0, ())
        v, anchor, J = meet(scene, points, state, anchor, of_nodes, v)
        x = x + scene.dt * at_points(scene, points, state, v)
        state = moving.from_grid(scene, state, v, Inputs())
        worst, touched = max(worst, (state.F - torch.eye(2)).abs().max().item()), touched + J.any().item()
    assert worst > 0.2 and touched > 100
    torch.testing.assert_close(x, places(points, state), rtol=0, atol=1e-12)
    at_rest = X[points.particle] + points.arm
    second = torch.cdist(at_rest, X).argsort(1)[:, 1]
    other = points._replace(particle=second, arm=at_rest - X[second])
    away = (places(other, state) - x).norm(dim=-1) / DX
    assert 0 < away.max() <= 0.02


@DIMS
@pytest.mark.parametrize("smoothing", [0.0, 4e-3])
def test_adjoint(dim, smoothing):
    """(K10.adj), (K9.adj) and (K8.adj) around the adjoint of the walls, from arbitrary cotangents, equal autograd: ≤ 1e-12."""
    scene = floor(dim)
    (state, params), points = shaken(scene, worlds=2), surface_points(scene)
    state = state._replace(v=10.0 * state.v)
    inputs = Inputs(wall_offset=f64([[0.31, 0.41]]))
    mass, v = on_grid(scene, state, masses(scene, params).expand(2, -1))
    anchor = across_walls(scene, places(points, state)) + 1e-3 * randn(2, 2, len(points.area), dim, seed=1)
    values = {"x": state.x, "F": state.F, "anchor": anchor, "mass": mass, "v": v}
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    moved = state._replace(x=leaves["x"], F=leaves["F"])
    end = meet(scene, points, moved, leaves["anchor"], leaves["mass"], leaves["v"], inputs, smoothing)
    bar_v, bar_a, bar_J = (randn(*one.shape, seed=2 + k) for k, one in enumerate(end))
    want = torch.autograd.grad(end, list(leaves.values()), (bar_v, bar_a, bar_J))
    got = adjoint(scene, points, state, anchor, mass, v, inputs, smoothing, bar_v, bar_a, bar_J)
    assert (weights(scene, points, state)[1] < -1e-3).any() and end[2].any(-1).any(-1).all()
    for name, theirs in zip(leaves, want, strict=True):
        scale = theirs.abs().max()
        assert scale > 0 and (got[name] - theirs).abs().max() <= 1e-12 * scale, name


def adjoint(
    scene, points, state, anchor, mass, v, inputs, smoothing, bar_v, bar_a, bar_J
) -> dict[str, torch.Tensor]:
    """docs/math/contact.md line by line; the walls, (K7.adj) to (K3.adj), by autograd."""
    (node, W), A, k = weights(scene, points, state), points.area, 4 / DX**2
    world = torch.arange(2)[:, None, None]
    around = node.flatten(1)

    def sums(share: torch.Tensor) -> torch.Tensor:
        """Sums over the points at the nodes of (world, point, 3^dim)."""
        return torch.zeros_like(mass).scatter_add(1, around, share.flatten(1))

    m = mass[world, node]
    inverse = torch.where(m > 0, 1 / m, 0.0)
    L = sums(W.abs() * A[:, None])[world, node]
    D = (W.abs() * L * inverse).sum(-1, keepdim=True)
    v_s = (W[..., None] * v[world, node]).sum(-2)
    met = [one.requires_grad_() for one in (D, places(points, state), v_s, anchor.clone())]
    anchors, J = meet_walls(scene, points.stiffness, *met, inputs, smoothing, 0.0, 1.0)
    push = A[:, None] * J.detach().sum(1)

    bar = bar_v[world, node] * inverse[..., None]
    bar_W = (push[:, :, None] * bar).sum(-1)  # (K10.adj)
    bar_m = -sums(W * inverse * bar_W)
    bar_J_s = A[:, None] * (W[..., None] * bar).sum(-2)
    bar_D, bar_x, bar_v_s, bar_anchor = torch.autograd.grad(
        (anchors, J), met, (bar_a, bar_J + bar_J_s[:, None])
    )

    bar_L = sums(W.abs() * bar_D)[world, node] * inverse  # (K9.adj)
    bar_m = bar_m - sums(W.abs() * L * inverse**2 * bar_D)
    bar_W = bar_W + (v[world, node] * bar_v_s[:, :, None]).sum(-1)
    bar_W = bar_W + W.sign() * (L * inverse * bar_D + A[:, None] * bar_L)
    bar_star = bar_v + torch.stack([sums(W * bar_v_s[..., axis, None]) for axis in range(v.shape[-1])], -1)

    p, a = points.particle, places(points, state) - state.x[:, points.particle]  # (K8.adj)
    r = nodes(scene)[node] - state.x[:, p, None]
    d = r / DX
    one = torch.where(d.abs() < 0.5, 0.75 - d**2, 0.5 * (1.5 - d.abs()) ** 2)
    slope = torch.where(d.abs() < 0.5, 2 * d, d.sign() * (1.5 - d.abs())) / DX
    w = one.prod(-1)
    grad_w = slope * w[..., None] / one
    c = 1 + k * (r * a[:, :, None]).sum(-1)
    bar_arm = bar_x + k * ((bar_W * w)[..., None] * r).sum(-2)
    bar_x = bar_x + ((bar_W * c)[..., None] * grad_w).sum(-2) - k * (bar_W * w).sum(-1, keepdim=True) * a
    got = {"anchor": bar_anchor, "mass": bar_m, "v": bar_star}
    got["x"] = torch.zeros_like(state.x).index_add(1, p, bar_x)
    got["F"] = torch.zeros_like(state.F).index_add(1, p, bar_arm[..., None] * points.arm[:, None])
    return got
