"""Driven particles in the reference formulation: every value and gradient against the float64 oracle, and what they promise."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp
from helpers import busy_inputs, cotangent, dot, given
from surface_scenes import block, build, compare

import softmpm
from softmpm import Inputs
from softmpm.oracle import driven as oracle_driven
from softmpm.oracle import lagrangian
from softmpm.schemes.lagrangian.driven import of_nodes

STEPS = 3


def gripped(dim: int) -> softmpm.Scene:
    """The block on two rough walls, driven at one corner by a few particles in no order."""
    made = block(dim)
    x = made.bodies[0].particles.positions
    handle = np.flatnonzero((x[:, 0] > 0.45) & (x[:, 1] < 0.4))[::-1]
    return dataclasses.replace(made, driven=handle)


@pytest.mark.parametrize(("dim", "contact"), [(2, "nodes"), (2, "surface"), (3, "surface")])
def test_the_end_and_all_gradients_are_those_of_the_reference(dim, contact, device):
    """Driven particles with other velocities each, in two worlds, beside and between nodes that walls stop and push."""
    model = build(gripped(dim), device=device, dtype=torch.float64, worlds=2, contact=contact)
    compare(model, ("velocity",), 1e-10)


def test_the_gradient_agrees_with_central_differences():
    """Through twelve substeps, along a random direction of the velocities."""
    model = build(gripped(2), dtype=torch.float64, contact="surface")
    velocity = given(model, ("velocity",), STEPS)["velocity"]
    way = torch.randn(velocity.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def loss(velocity):
        inputs = Inputs(velocity=velocity)
        end = softmpm.simulate(model, model.rest(), None, model.params(), substeps=4, inputs=inputs)
        return dot(cotangent(end), end)

    gradient = (torch.autograd.grad(loss(velocity), velocity)[0] * way).sum()
    up, down = (loss(velocity.detach() + h * way) for h in (1e-6, -1e-6))
    assert abs((up - down) / 2e-6 - gradient) <= 1e-7 * abs(gradient)


def test_a_step_on_a_tape_has_the_gradient(device):
    """With respect to the velocities of the nodes, from which follows that of the particles."""
    model = build(gripped(2), device=device, dtype=torch.float64, contact="surface")
    velocity = given(model, ("velocity",), 1)["velocity"]
    inputs = Inputs(velocity=velocity)
    end = softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, inputs=inputs)
    want = torch.autograd.grad(end.nodes.v.square().sum(), velocity)[0]
    solid = softmpm.warp_solid(model, inputs=Inputs(velocity=velocity.detach()), requires_grad=True)
    states = [softmpm.warp_state(model, requires_grad=True) for _ in range(2)]
    tape = wp.Tape()
    softmpm.step(model, *states, solid, tape=tape)
    assert torch.equal(states[1].nodal().v, end.nodes.v)
    tape.backward(grads={states[1].v: wp.from_torch(2.0 * end.nodes.v.detach(), dtype=states[1].v.dtype)})
    found = wp.to_torch(solid.others["driven_velocity"].grad)[None]
    leaf = velocity.detach().requires_grad_()
    got = torch.autograd.grad((of_nodes(model, leaf) * found).sum(), leaf)[0]
    assert want.abs().max() > 0 and torch.equal(got, want)


@pytest.mark.parametrize(
    "devices", [("cpu", "cpu"), pytest.param(("cuda:0", "cuda:1"), marks=pytest.mark.gpu)], ids=["one", "two"]
)
def test_worlds_on_two_devices_have_the_bits_of_one(devices):
    """Four worlds in one model, or two of them on each device, which work at the same time: the same ends, gradients and steps on Warp
    arrays. Nothing of the second device comes to lie on the first, which is the current one.
    """
    gpus = devices[0] != "cpu"
    if gpus and torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    settings = dict(contact="surface", deterministic=gpus)
    whole = build(gripped(2), device=devices[0], worlds=4, **settings)
    leaves = busy_inputs(whole, control_steps=STEPS) | given(whole, ("velocity",), STEPS)
    weights = cotangent(whole.rest())

    def advanced(model, part):
        rows = {name: (slice(None), part) if t.shape[1] == 4 else part for name, t in leaves.items()}
        mine = {name: t.detach()[rows[name]].to(model.device).requires_grad_() for name, t in leaves.items()}
        start = softmpm.State(*(mine[name] for name in "xvCF"))
        params = softmpm.Params(*(mine[name] for name in softmpm.Params._fields))
        inputs = Inputs(velocity=mine["velocity"])
        end = softmpm.simulate(model, start, mine["activation"], params, substeps=5, inputs=inputs)
        states = [softmpm.warp_state(model, start), softmpm.warp_state(model)]
        softmpm.step(model, *states, softmpm.warp_solid(model, params))
        return mine, end, states[1].nodal()

    def results(mine, end, stepped, part):
        loss = dot([weight[part].to(end.x.device) for weight in weights[:4]], end)
        return [*end[:4], *stepped[:4], *torch.autograd.grad(loss, list(mine.values()))]

    all_worlds = slice(0, 4)
    want = results(*advanced(whole, all_worlds), all_worlds)
    before = torch.cuda.memory_allocated(0) if gpus else 0
    other = build(gripped(2), device=devices[1], worlds=2, **settings)
    half = slice(2, 4)
    advanced(other, half)
    second = advanced(other, half)  # replayed
    got = [results(*second, half)]
    assert not gpus or (torch.cuda.current_device() == 0 and torch.cuda.memory_allocated(0) <= before)
    one = build(gripped(2), device=devices[0], worlds=2, **settings)
    pair = [(advanced(model, part), part) for model, part in ((one, slice(0, 2)), (other, half))]
    got += [results(*found, part) for found, part in pair]
    for part, found in ((half, got[0]), (slice(0, 2), got[1]), (half, got[2])):
        for there, here in zip(found, want, strict=True):
            rows = (slice(None), part) if here.shape[1] == 4 else part
            assert torch.equal(there.to(here.device), here[rows])


@pytest.mark.parametrize("dim", [2, 3])
def test_affine_velocities_are_fitted_exactly(dim):
    """Σ a = 1 and Σ a X = X_i for a handle of several layers, as the oracle has it; a single layer is constant across."""
    for positions in (block(dim).bodies[0].particles.positions, single_layer(dim)):
        body = softmpm.Body(
            softmpm.Particles(positions, 0.05**dim), softmpm.NeoHookean(density=1.0, young=80.0)
        )
        made = softmpm.Scene(
            grid=softmpm.Grid(shape=(12, 11, 10)[:dim], spacing=0.1),
            bodies=[body],
            driven=np.arange(len(positions)),
            dt=1e-3,
        )
        model = build(made, dtype=torch.float64)
        grid = model.driven_grid
        assert grid is not None
        unit = torch.eye(len(positions), dtype=torch.float64)[..., None].repeat(1, 1, dim)
        a = of_nodes(model, unit[:, None])[:, 0, :, 0].T
        nodes = model.rest_grid.nodes[grid.nodes.long()].double() * 0.1
        torch.testing.assert_close(a.sum(1), torch.ones(grid.count).double(), rtol=0, atol=1e-12)
        reached = a @ torch.tensor(positions)
        flat = torch.from_numpy(np.ptp(positions, axis=0) == 0)
        torch.testing.assert_close(reached[:, ~flat], nodes[:, ~flat], rtol=0, atol=1e-12)
        torch.testing.assert_close(
            reached[:, flat], torch.full_like(reached[:, flat], 0.5), rtol=0, atol=1e-12
        )
        assert bool(flat.any()) == (len(positions) == 4 ** (dim - 1))
        points = lagrangian.quadrature(made)
        index = model.rest_grid.index[grid.nodes.long()]
        assert torch.equal(index, oracle_driven.held(made, points.node, points.N))
        torch.testing.assert_close(a, oracle_driven.fit(made, points.X, index), rtol=0, atol=1e-12)


def single_layer(dim: int) -> np.ndarray:
    lattice = np.stack(np.meshgrid(*[0.33 + 0.05 * np.arange(4)] * (dim - 1)), -1).reshape(-1, dim - 1)
    return np.column_stack([np.full(len(lattice), 0.5), lattice])


def test_a_body_that_is_driven_as_a_whole_moves_rigidly(device):
    """Whatever forces and walls act on it, for 20 cells, in float32: each substep moves it by Δt V, and it keeps its shape."""
    made = (
        block(2, walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.4)], viscosity=None) if False else block(2)
    )
    made = dataclasses.replace(made, driven=np.arange(len(made.bodies[0].particles)))
    model = build(made, device=device)
    V = torch.tensor([2.0, 0.5], device=model.device)
    end = softmpm.simulate(
        model, model.rest(), None, model.params(), substeps=1000, inputs=Inputs(velocity=V)
    )
    torch.testing.assert_close(end.x, model.rest().x + V, rtol=0, atol=1e-5)
    torch.testing.assert_close(end.F, model.rest().F, rtol=0, atol=1e-4)
    assert (end.v == V).all() or (end.v - V).abs().max() < 1e-6


def test_a_handle_that_turns_is_where_it_is_sent(device):
    """Particles that are sent along a circle have their places and velocities to rounding."""
    made = dataclasses.replace(gripped(2), walls=[], gravity=None, damping=0.0)
    model = build(made, device=device, dtype=torch.float64)
    steps, substeps, centre = 10, 25, torch.tensor([0.4, 0.4], dtype=torch.float64, device=model.device)
    arms = model.positions[model.driven] - centre
    angles = torch.linspace(0.0, 0.4, steps + 1, dtype=torch.float64, device=model.device)[1:]
    turns = torch.stack(
        [torch.stack([angles.cos(), -angles.sin()], -1), torch.stack([angles.sin(), angles.cos()], -1)], 1
    )
    places = centre + torch.einsum("sij,pj->spi", turns, arms)
    inputs = Inputs(position=places[:, None])
    end = softmpm.simulate(model, model.rest(), None, model.params(), substeps=substeps, inputs=inputs)
    torch.testing.assert_close(end.x[0, model.driven], places[-1], rtol=0, atol=1e-12)
    duration = substeps * made.dt
    torch.testing.assert_close(
        end.v[0, model.driven], (places[-1] - places[-2]) / duration, rtol=0, atol=1e-11
    )


def test_driven_particles_meet_no_walls():
    """A foot that is sunk into the floor stays there, without an alarm and without a force; the points above it are pushed up."""
    made = block(2, walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.4, friction=0.4)])
    x = made.bodies[0].particles.positions
    foot = np.flatnonzero(x[:, 1] < 0.4)
    made = dataclasses.replace(made, driven=foot)
    model = softmpm.build(made, device="cpu", dtype=torch.float64, formulation="reference")
    start = model.rest()
    end = softmpm.simulate(model, start, None, model.params(), substeps=200)
    assert model.surface is not None and model.driven_grid is not None
    sunk = ~model.surface.carried(~model.driven_grid.held)
    forces = softmpm.contact_forces(model, end)
    assert sunk.any() and (forces.traction[0, 0, sunk] == 0).all()
    assert (forces.points[0, sunk, 1] < 0.35).any()
    torch.testing.assert_close(end.x[:, foot], start.x[:, foot], rtol=0, atol=1e-14)
    assert (end.x != start.x).any()


def test_both_formulations_agree_on_a_handle():
    """A bar that is lifted by its end and pulled: the tips differ by an error of the moving grid that halves with the spacing."""
    apart = []
    for n in (16, 32):
        shape = softmpm.box((0.2, 0.4), (0.7, 0.525), spacing=0.5 / n)
        material = softmpm.NeoHookean(density=1.0, young=300.0, poisson=0.3, viscosity=1.5)
        made = softmpm.Scene(
            grid=softmpm.Grid(shape=(n + 1, n + 1), spacing=1 / n),
            bodies=[softmpm.Body(shape, material)],
            driven=np.flatnonzero(shape.positions[:, 0] < 0.325),
            gravity=(0.0, -2.0),
            dt=0.1 / n**2,
        )
        velocity = torch.tensor([[0.0, 0.25], [0.1, 0.0]], dtype=torch.float64)
        found = []
        for formulation in ("moving", "reference"):
            model = softmpm.build(made, device="cpu", dtype=torch.float64, formulation=formulation)
            inputs = Inputs(velocity=velocity[:, None, None].expand(2, 1, model.driven_count, 2))
            end = softmpm.simulate(
                model, model.rest(), None, model.params(), substeps=4 * n**2, inputs=inputs
            )
            moved = (end.x - model.rest().x)[0]
            want = velocity.sum(0) * 0.4
            torch.testing.assert_close(
                moved[model.driven], want.expand(model.driven_count, 2), rtol=0, atol=1e-13
            )
            found.append(moved[shape.positions[:, 0] > 0.6375].mean(0))
        apart.append((found[0] - found[1]).norm().item())
        assert found[1][1] < 0.96 * want[1]  # the bar hangs
    assert 0.4 < apart[1] / apart[0] < 0.6, apart


def test_driven_particles_at_clamps_are_refused():
    """Two rules for one node."""
    clamp = softmpm.Wall(normal=(1.0, 0.0), offset=0.2, contact="clamp")
    body = softmpm.Body(
        softmpm.box((0.2, 0.3), (0.6, 0.5), spacing=0.05), softmpm.NeoHookean(density=1.0, young=80.0)
    )
    grid = softmpm.Grid(shape=(12, 11), spacing=0.1)
    for first, fits in ((0.38, False), (0.48, True)):
        driven = np.flatnonzero(body.particles.positions[:, 0] > first)
        made = softmpm.Scene(grid=grid, bodies=[body], walls=[clamp], driven=driven, dt=1e-3)
        if fits:
            build(made)
            continue
        with pytest.raises(ValueError, match="three cells or more from clamps and planes of symmetry"):
            build(made)
