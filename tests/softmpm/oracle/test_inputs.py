"""Inputs of the float64 oracle besides state, activation and material, against closed forms and central differences."""

import dataclasses

import numpy as np
import pytest
import torch
from oracle_scenes import DIMS, assert_same, f64, full, masses, randn, rest, shaken, slopes, tiny

from softmpm.inputs import Inputs
from softmpm.oracle import moving
from softmpm.scene.actuators import Pressure
from softmpm.scene.scene import Scene
from softmpm.state import Params, State


def with_viscosity(scene: Scene, viscosity: float) -> Scene:
    """The scene with all of its materials made viscous."""
    bodies = [
        dataclasses.replace(body, material=dataclasses.replace(body.material, viscosity=viscosity))
        for body in scene.bodies
    ]
    return dataclasses.replace(scene, bodies=bodies)


def sliding(dim: int, scene: Scene, worlds: int) -> tuple[State, Params]:
    """A random start that slides with 2 m/s, so that no node changes between held, sliding and leaving nearby."""
    start, params = shaken(scene, worlds=worlds, noise=0.3)
    return start._replace(v=start.v + f64((2.0, -0.5, 0.3)[:dim])), params


@DIMS
def test_inputs_of_each_world_are_those_of_scenes(dim):
    """Gravity, damping, friction, fibres, strengths and viscosity per world give what each world's own scene gives alone: ≤ 1e-13."""
    scene = with_viscosity(full(dim), 0.05)
    start, params = sliding(dim, scene, 2)
    activation, count = randn(2, 2, 2, seed=61), start.x.shape[1]
    inputs = Inputs(
        gravity=f64([[0.1, -3.0, 0.5], [0.4, 2.0, -1.0]])[:, :dim],
        damping=f64([0.0, 2.5]),
        friction=f64([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]]),
        direction=randn(2, 2, dim, seed=62),
        strength=f64([[3.0, 9.0], [12.0, -4.0]]),
        viscosity=f64([[0.0], [0.4]]).expand(2, count),
    )
    both = moving.simulate(scene, start, activation, params, substeps=3, inputs=inputs)
    for w in range(2):
        muscles = [
            dataclasses.replace(
                muscle, direction=inputs.direction[w, k].tolist(), strength=inputs.strength[w, k].item()
            )
            for k, muscle in enumerate(scene.muscles)
        ]
        walls = [
            dataclasses.replace(wall, friction=inputs.friction[w, k].item())
            for k, wall in enumerate(scene.walls)
        ]
        own = dataclasses.replace(
            with_viscosity(scene, inputs.viscosity[w, 0].item()),
            gravity=inputs.gravity[w].tolist(),
            damping=inputs.damping[w].item(),
            muscles=muscles,
            walls=walls,
        )
        part = slice(w, w + 1)
        alone = moving.simulate(
            own,
            State(*(t[part] for t in start[:4])),
            activation[:, part],
            Params(*(p[part] for p in params)),
            substeps=3,
        )
        assert_same(State(*(t[part] for t in both[:4])), alone, 1e-13)


@DIMS
def test_one_number_for_all_worlds(dim):
    """An input without the axis ``world`` is every world's; inputs equal to the scene's values change nothing."""
    scene = full(dim)
    start, params = shaken(scene, worlds=2)
    inputs = Inputs(
        gravity=f64(scene.gravity),
        damping=f64(scene.damping),
        friction=f64([wall.friction for wall in scene.walls]),
        direction=2.0 * f64([muscle.direction for muscle in scene.muscles]),
        strength=f64([muscle.strength for muscle in scene.muscles]),
    )
    activation = randn(1, 2, 2, seed=61)
    got = moving.simulate(scene, start, activation, params, substeps=3, inputs=inputs)
    assert_same(got, moving.simulate(scene, start, activation, params, substeps=3), 1e-13)


def test_only_the_way_of_a_direction_counts():
    """A direction is normalised differentiably: longer ones move the same, and the gradient has no part along the direction."""
    scene = full(2)
    start, params = shaken(scene)
    activation, d = randn(1, 1, 2, seed=61), randn(1, 2, 2, seed=62).requires_grad_()

    def go(direction):
        given = Inputs(direction=direction)
        return moving.simulate(scene, start, activation, params, substeps=2, inputs=given)

    assert_same(go(3.0 * d), go(d), 1e-13)
    (slope,) = torch.autograd.grad(go(d).v[..., 0].sum(), d)
    assert slope.norm() > 0 and (slope * d).sum(-1).abs().max() < 1e-13 * slope.norm()


INPUTS = {
    "gravity": lambda scene, n: randn(2, scene.grid.dim, seed=70),
    "damping": lambda scene, n: 1.0 + randn(2, seed=71).abs(),
    "friction": lambda scene, n: 0.4 + 0.1 * randn(2, len(scene.walls), seed=72).abs(),
    "direction": lambda scene, n: randn(2, len(scene.muscles), scene.grid.dim, seed=73),
    "strength": lambda scene, n: 8.0 + randn(2, len(scene.muscles), seed=74),
    "wall_offset": lambda scene, n: (
        f64([wall.offset for wall in scene.walls]) + 2e-4 * randn(3, 2, 3, seed=76)
    ),
    "wall_normal": lambda scene, n: (
        f64([wall.normal for wall in scene.walls]) + 2e-4 * randn(3, 2, 3, scene.grid.dim, seed=77)
    ),
    "wall_velocity": lambda scene, n: 0.1 * randn(2, 2, 3, scene.grid.dim, seed=78),
    "velocity": lambda scene, n: 2.0 + 0.1 * randn(2, 2, len(scene.driven), scene.grid.dim, seed=79),
    "force": lambda scene, n: 0.03 * randn(2, 2, n, scene.grid.dim, seed=80),
    "viscosity": lambda scene, n: 0.05 + 0.01 * randn(2, n, seed=75).abs(),
}
"""Values in two worlds, for a scene of n particles and two control steps."""


@DIMS
def test_gradient_of_every_input(dim):
    """Along a random direction of each input equals a central difference: 2 control steps, 2 worlds, ≤ 5e-9."""
    scene = full(dim)
    chamber = Pressure(particles=np.arange(5), strength=4.0)
    scene = dataclasses.replace(scene, muscles=[*scene.muscles, chamber], driven=[7, 2, 9])
    start, params = sliding(dim, scene, 2)
    activation, weights = 0.5 * randn(2, 2, 3, seed=60), [randn(*t.shape, seed=80) for t in start[:4]]
    given = {name: make(scene, start.x.shape[1]) for name, make in INPUTS.items()}

    def losses(values):
        copies = len(values["damping"]) // 2
        many = State(*(t.repeat(copies, *[1] * (t.dim() - 1)) for t in start[:4]))
        values = Inputs(**values)
        materials = Params(*(p.repeat(copies, 1) for p in params))
        end = moving.simulate(
            scene, many, activation.repeat(1, copies, 1), materials, substeps=4, inputs=values
        )
        return sum(
            (w * t.unflatten(0, (-1, 2))).flatten(1).sum(1) for w, t in zip(weights, end[:4], strict=True)
        )

    rounding = 4e-9  # of a difference over steps of 1e-4, of terms of up to 100
    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    gradient = torch.autograd.grad(losses(leaves).sum(), list(leaves.values()))
    along = {}
    for k, (name, value) in enumerate(given.items()):
        size = 1e-3 if name in ("wall_offset", "wall_normal") else value.abs().mean()  # of poses 4 ms apart
        along[name] = size * randn(*value.shape, seed=90 + k)
    in_time = ("wall_offset", "wall_normal", "wall_velocity", "velocity", "force")
    want = slopes(losses, given, along, 1e-4, dict.fromkeys(in_time, 1))
    for name, found in zip(given, gradient, strict=True):
        parts = found * along[name]
        assert parts.isfinite().all() and parts.norm() > 0, name
        assert abs(parts.sum() - want[name]) <= 5e-9 * max(abs(want[name]), parts.norm()) + rounding, name


@DIMS
def test_forces_give_their_impulse(dim):
    """A free body gains Σ f t, whatever its material and wherever the forces act; forces on one particle move it ahead of the rest."""
    scene = tiny(dim)
    start, params = shaken(scene)
    mass, force = masses(scene, params)[..., None], 1e-3 * randn(2, *start.x.shape, seed=1)
    end = moving.simulate(scene, start, None, params, substeps=7, inputs=Inputs(force=force))
    gained = (mass * (end.v - start.v)).sum(1)
    torch.testing.assert_close(gained, 7 * scene.dt * force.sum((0, 2)), rtol=1e-11, atol=1e-16)


@DIMS
def test_driven_particles_go_where_they_are_sent(dim):
    """x' = x + Δt V to the last bit over two control steps; without a velocity they stand still, and the body hangs on them."""
    scene = tiny(dim, driven=[4, 1], gravity=(0.3, -9.8, 0.2)[:dim])
    start, params = rest(scene)
    V = randn(2, 1, 2, dim, seed=2)
    end = moving.simulate(scene, start, None, params, substeps=5, inputs=Inputs(velocity=V))
    x = start.x[:, [4, 1]]
    for row in V:
        for _ in range(5):
            x = x + scene.dt * row
    assert torch.equal(end.x[:, [4, 1]], x) and torch.equal(end.v[:, [4, 1]], V[1])
    held = moving.simulate(scene, start, None, params, substeps=10)
    assert torch.equal(held.x[:, [4, 1]], start.x[:, [4, 1]]) and (held.v[:, [4, 1]] == 0).all()
    assert (held.F[:, [4, 1]] - start.F[:, [4, 1]]).abs().max() > 1e-4
    free = moving.simulate(dataclasses.replace(scene, driven=()), start, None, params, substeps=10)
    assert held.x[0, 0, 1] > free.x[0, 0, 1]  # a neighbour falls less


def test_a_body_that_is_driven_as_a_whole_moves_rigidly():
    """All particles sent with one velocity: after the first substep they keep their shape, to rounding, and any force is in vain."""
    scene = tiny(2)
    scene = dataclasses.replace(scene, driven=np.arange(12), gravity=(0.0, -9.8))
    start, params = rest(scene)
    V = f64([0.7, -0.2]).expand(1, 1, 12, 2)
    inputs = Inputs(velocity=V, force=f64([0.0, 1.0]))
    end = moving.simulate(scene, start, None, params, substeps=8, inputs=inputs)
    torch.testing.assert_close(end.x - start.x, 8 * scene.dt * V[0], rtol=0, atol=1e-15)
    torch.testing.assert_close(end.v, V[0])


@DIMS
def test_adjoints_of_force_and_velocity(dim):
    """(T4.adj), (T5.adj): f̄ = v̄ Δt/m, V̄ = v̄' + Δt x̄', and a loss on driven x' and v' alone gives the start only x̄ = x̄'."""
    scene = full(dim)
    index = [5, 0, 8]
    driven = dataclasses.replace(scene, driven=index)
    start, params = shaken(scene)
    force = (1e-3 * randn(1, *start.x.shape, seed=3)).requires_grad_()
    V = randn(1, 1, 3, dim, seed=4).requires_grad_()
    leaves = State(*(t.clone().requires_grad_() for t in start[:4]))
    a, b = randn(1, 3, dim, seed=5), randn(1, 3, dim, seed=6)

    def go(which):
        inputs = Inputs(force=force, velocity=V if which is driven else None)
        return moving.simulate(which, leaves, None, params, substeps=1, inputs=inputs)

    end = go(scene)
    loss = sum((randn(*t.shape, seed=7 + k) * t).sum() for k, t in enumerate(end[:4]))
    adj_f, adj_v = torch.autograd.grad(loss, (force, leaves.v))
    mass = masses(scene, params)[..., None]
    torch.testing.assert_close(adj_f[0], scene.dt / mass * adj_v, rtol=1e-11, atol=1e-14)

    end = go(driven)
    loss = (a * end.v[:, index]).sum() + (b * end.x[:, index]).sum()
    adj_V, adj_x, adj_v, adj_C = torch.autograd.grad(loss, (V, *leaves[:3]), materialize_grads=True)
    torch.testing.assert_close(adj_V[0], a + scene.dt * b, rtol=1e-14, atol=1e-15)
    want = torch.zeros_like(adj_x).index_copy(1, torch.tensor(index), b)
    assert torch.equal(adj_x, want) and (adj_v == 0).all() and (adj_C == 0).all()


def test_rows_of_inputs_agree_with_the_control_steps():
    """A number of control steps or poses that does not fit the activation is an error that names the input."""
    scene = full(2)
    start, params = shaken(scene)
    activation = randn(2, 1, 2, seed=61)
    for given in (
        Inputs(force=torch.zeros(3, 1, 12, 2).double()),
        Inputs(wall_offset=torch.zeros(2, 1, 3).double()),
    ):
        with pytest.raises(ValueError, match="for 2 control steps, got"):
            moving.simulate(scene, start, activation, params, substeps=1, inputs=given)
