"""Moving walls of the float64 oracle: kinematics, bodies that they push and carry, and the adjoint of docs/math/grid.md."""

import pytest
import torch
from oracle_scenes import DIMS, assert_same, f64, full, randn, rest, shaken, tiny

from softmpm.inputs import Inputs
from softmpm.oracle import moving, walls
from softmpm.scene.scene import Grid, Scene, Wall
from softmpm.state import Params, State

KINDS = [("stick", 0.0), ("slip", 0.0), ("separate", 0.0), ("separate", 0.4)]


def poses(scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    """One pose of the scene's walls: offsets (1, 1, wall) and normals (1, 1, wall, dim)."""
    return f64([[[wall.offset for wall in scene.walls]]]), f64([[[wall.normal for wall in scene.walls]]])


@DIMS
def test_walls_at_rest_are_the_scenes(dim):
    """One pose, or equal ones, and a zero velocity: the numbers of a scene without inputs, to the last bit where nothing is divided."""
    scene = full(dim)
    start, params = shaken(scene, worlds=2)
    activation = randn(2, 2, 2, seed=61)

    def go(**given):
        return moving.simulate(scene, start, activation, params, substeps=2, inputs=Inputs(**given))

    want, (offset, normal) = go(), poses(scene)
    still = torch.zeros(2, 2, 3, dim, dtype=torch.float64)
    for given in (
        dict(wall_offset=offset),
        dict(wall_velocity=still),
        dict(wall_offset=offset, wall_velocity=still),
    ):
        assert all(torch.equal(a, b) for a, b in zip(go(**given)[:4], want[:4], strict=True))
    assert_same(go(wall_offset=3 * offset, wall_normal=3 * normal), want, 1e-13)  # the same planes
    assert_same(go(wall_offset=offset.expand(3, 2, 3), wall_normal=normal.expand(3, 2, 3, dim)), want, 1e-13)


@DIMS
@pytest.mark.parametrize("contact, friction", KINDS)
def test_a_wall_takes_a_resting_body_along(dim, contact, friction):
    """A body at rest inside a wall that advances at u gets the velocity u n, whatever the contact; it stays behind a separate one that
    retreats."""
    n = f64((0.6, 0.8, 0.0)[:dim])
    wall = Wall(normal=n.tolist(), offset=3.0, contact=contact, friction=friction)
    scene = tiny(dim, walls=[wall])
    start, params = rest(scene)
    for speed in (0.3, -0.3):
        moved = f64([3.0, 3.0 + speed * 5 * scene.dt])[:, None, None]
        end = moving.simulate(scene, start, None, params, substeps=5, inputs=Inputs(wall_offset=moved))
        want = 0.0 * n if contact == "separate" and speed < 0 else speed * n
        torch.testing.assert_close(end.v, want.expand_as(end.v), rtol=0, atol=1e-12)
        torch.testing.assert_close(
            end.x - start.x, (5 * scene.dt * want).expand_as(end.x), rtol=0, atol=1e-12
        )


def test_a_conveyor_belt_carries_what_lies_on_it():
    """Friction takes a body that is pressed onto a moving surface to the speed of the surface, by no more than c g a second."""
    wall = Wall(normal=(0.0, 1.0), offset=3.0, contact="separate", friction=0.5)
    scene = tiny(2, walls=[wall], gravity=(0.0, -10.0))
    start, params = rest(scene)
    inputs = Inputs(wall_velocity=f64([0.02, 0.0]).expand(1, 1, 1, 2))

    def speed(substeps):
        end = moving.simulate(scene, start, None, params, substeps=substeps, inputs=inputs)
        return end.v[0].mean(0)

    torch.testing.assert_close(speed(2), f64([2 * scene.dt * 0.5 * 10.0, 0.0]), rtol=0, atol=1e-12)
    torch.testing.assert_close(speed(10), f64([0.02, 0.0]), rtol=0, atol=1e-12)


@DIMS
def test_kinematics_of_a_turning_wall(dim):
    """(C4): on the surface u·n̂ is −∂/∂t of the distance (a·x − o)/|a|, by differences; a is between the unit poses."""
    scene = tiny(dim, walls=[Wall(normal=(0.0, 1.0, 0.0)[:dim], offset=0.4)])
    normal, offset = randn(2, 1, 1, dim, seed=1), randn(2, 1, 1, seed=2)
    inputs, like = Inputs(wall_normal=normal, wall_offset=offset), torch.zeros(1, 1, dim).double()
    length = torch.linalg.vector_norm(normal, dim=-1)

    def at(time):
        return walls.surface(scene, 0, inputs, like, time, 0.5)

    torch.testing.assert_close(at(0.0).normal, normal[0, 0] / length[0])
    torch.testing.assert_close(at(0.5).normal, normal[1, 0] / length[1])
    torch.testing.assert_close(at(0.5).offset, offset[1, 0] / length[1, 0])
    now, h = at(0.2), 1e-4
    a, o = now.normal[0], now.offset[0]
    x = walls.nodes(scene)
    x = x - ((x @ a - o) / (a @ a))[:, None] * a  # projected onto the surface

    def distance(wall):
        return (x @ wall.normal[0] - wall.offset[0]) / torch.linalg.vector_norm(wall.normal[0])

    want = -(distance(at(0.2 + h)) - distance(at(0.2 - h))) / (2 * h)
    got = (now.offset_rate[0] - x @ now.normal_rate[0]) / torch.linalg.vector_norm(a)
    torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-7)
    u, at_nodes = walls.wall_velocity(scene, now)[0], walls.nodes(scene)
    speed = (now.offset_rate[0] - at_nodes @ now.normal_rate[0]) / torch.linalg.vector_norm(a)
    torch.testing.assert_close(u, speed[:, None] * now.unit[0], rtol=1e-13, atol=1e-13)


def test_nodes_inside_a_moving_wall():
    """A wall acts from the substep at whose beginning its plane has reached the node, not before; a node on the plane is inside."""
    wall = Wall(normal=(0.0, 1.0), offset=0.25, contact="stick")
    scene = tiny(2, walls=[wall], grid=Grid(shape=(5, 6), spacing=0.125))
    inputs = Inputs(wall_offset=f64([0.25, 0.5])[:, None, None])
    mass = torch.ones(1, 30, dtype=torch.float64)
    momentum = torch.ones(1, 30, 2, dtype=torch.float64)
    for time, row in ((0.0, 2), (0.125, 2), (0.5, 3), (0.75, 3), (1.0, 4)):
        v = moving.grid_velocity(scene, mass, momentum, inputs, time, 1.0).view(5, 6, 2)
        torch.testing.assert_close(v[:, : row + 1], f64([0.0, 0.25]).expand(5, row + 1, 2))
        assert (v[:, row + 1 :] == 1.0).all()


@DIMS
def test_control_steps_and_worlds_of_moving_walls(dim):
    """Three poses over two control steps in two worlds are two calls of one step each, and each world alone: ≤ 1e-13."""
    scene = full(dim)
    start, params = shaken(scene, worlds=2)
    offset, normal = poses(scene)
    offset = offset + 0.002 * randn(3, 2, 3, seed=5)
    normal = normal + 0.01 * randn(3, 2, 3, dim, seed=6)
    slide = 0.3 * randn(2, 2, 3, dim, seed=7)

    def go(state, p, rows, worlds):
        inputs = Inputs(
            wall_offset=offset[rows.start : rows.stop + 1, worlds],
            wall_normal=normal[rows.start : rows.stop + 1, worlds],
            wall_velocity=slide[rows, worlds],
        )
        return moving.simulate(scene, state, None, p, substeps=3, inputs=inputs)

    every = slice(0, 2)
    both = go(start, params, every, every)
    assert_same(go(go(start, params, slice(0, 1), every), params, slice(1, 2), every), both, 1e-13)
    for w in (slice(0, 1), slice(1, 2)):
        alone = go(State(*(t[w] for t in start[:4])), Params(*(p[w] for p in params)), every, w)
        assert_same(alone, State(*(t[w] for t in both[:4])), 1e-13)
    assert (both.v - moving.simulate(scene, start, None, params, substeps=6).v).abs().max() > 1e-3


def test_the_offset_of_a_wall_at_rest_has_no_gradient():
    """The set of nodes inside a wall is not differentiated: a single pose has zero gradient for its offset, not for its normal."""
    scene = full(2)
    start, params = shaken(scene)
    offset, normal = (pose.requires_grad_() for pose in poses(scene))
    inputs = Inputs(wall_offset=offset, wall_normal=normal)
    end = moving.simulate(scene, start, None, params, substeps=3, inputs=inputs)
    slopes = torch.autograd.grad(
        end.v.square().sum(), (offset, normal), allow_unused=True, materialize_grads=True
    )
    assert (slopes[0] == 0).all() and slopes[1].norm() > 0


@DIMS
@pytest.mark.parametrize("contact, friction", KINDS)
def test_adjoint_of_a_moving_wall(dim, contact, friction):
    """(C4.adj), (C5.adj) of docs/math/grid.md equal autograd through the grid stage: ≤ 1e-11, and 1e-12 of the largest."""
    wall = Wall(normal=(0.3, 1.0, -0.2)[:dim], offset=0.5, contact=contact, friction=friction)
    scene = tiny(dim, walls=[wall])
    count, time, T = len(walls.nodes(scene)), 0.3, 0.8
    N = (f64(wall.normal) * 1.7 + 0.1 * randn(2, 1, 1, dim, seed=1)).requires_grad_()
    O = (1.7 * wall.offset + 0.1 * randn(2, 1, 1, seed=2)).requires_grad_()
    w = randn(1, 1, dim, seed=3).requires_grad_()
    v = randn(1, count, dim, seed=4).requires_grad_()
    adj = randn(1, count, dim, seed=5)
    inputs = Inputs(wall_normal=N, wall_offset=O, wall_velocity=w)
    out = moving.grid_velocity(scene, torch.ones(1, count).double(), v, inputs, time, T)
    want = torch.autograd.grad(out, (v, w, N, O), adj)

    with torch.no_grad():
        s = walls.surface(scene, 0, inputs, v, time, T)
        here = walls.inside(scene, s)[0]
        x, q = walls.nodes(scene)[here], (v - walls.wall_velocity(scene, s))[0, here]
        n, size, g = s.unit[0], torch.linalg.vector_norm(s.normal[0]), adj[0, here]
        P = torch.eye(dim).double() - torch.outer(n, n)
        q_n, q_t = (q @ n)[:, None], q @ P
        g_n, g_t, along = (g @ n)[:, None], g @ P, (g * q_t).sum(-1, keepdim=True)
        t = torch.linalg.vector_norm(q_t, dim=-1, keepdim=True)
        if contact == "stick":
            adj_q, b = torch.zeros_like(q), torch.zeros_like(q)
        elif contact == "slip":
            adj_q, b = g_t, -q_n * g_t - g_n * q_t
        else:
            l, c = -friction * q_n, friction
            phi = 1 - l / t
            adj_t = g_t * phi + along * l / t**3 * q_t
            adj_q, b = adj_t + c * along / t * n, -q_n * adj_t + (c * along / t - phi * g_n) * q_t
            held, leaving = t <= l, q_n >= 0
            adj_q = torch.where(leaving, g, torch.where(held, 0.0, adj_q))
            b = torch.where(leaving | held, 0.0, b)
            assert leaving.any() and (held.any() or friction == 0) and (~held & ~leaving).any()
        adj_v = adj[0].clone()
        adj_v[here] = adj_q
        adj_u = g - adj_q
        adj_s, speed = adj_u @ n, (s.offset_rate - x @ s.normal_rate[0]) / size
        rate_o, rate_a = adj_s.sum() / size, -(adj_s @ x) / size
        adj_a = (b + speed[:, None] * (adj_u @ P) - (adj_s * speed)[:, None] * n).sum(0) / size
        adj_n = torch.stack([(1 - time / T) * adj_a - rate_a / T, time / T * adj_a + rate_a / T])
        adj_o = torch.stack([-rate_o / T, rate_o / T])
        long = torch.linalg.vector_norm(N[:, 0, 0], dim=-1)
        unit, o = N[:, 0, 0] / long[:, None], O[:, 0, 0] / long
        across = adj_n - (adj_n * unit).sum(-1, keepdim=True) * unit
        adj_N = (across - (o * adj_o)[:, None] * unit) / long[:, None]
        got = adj_v[None], adj_u.sum(0)[None, None], adj_N[:, None, None], (adj_o / long)[:, None, None]
    for mine, value in zip(got, want, strict=True):
        assert (mine - value).abs().max() <= 1e-12 * value.abs().max() + 1e-11
