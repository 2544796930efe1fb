"""The reference formulation over long ways: u stays small, whatever the way, and nothing else changes."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import assert_relative, cotangent, dot
from surface_scenes import slab

import softmpm
from softmpm.oracle import contact, lagrangian
from softmpm.schemes.lagrangian.nodal import particles_of, quantum

DX = 1 / 25


def block(dim=2, dt=None, **changes) -> softmpm.Scene:
    box = softmpm.box((0.3,) * dim, (0.5,) * dim, spacing=DX / 2)
    body = softmpm.Body(box, softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3))
    made = softmpm.Scene(grid=softmpm.Grid(shape=(24,) * dim, spacing=DX), bodies=[body], dt=1.0, **changes)
    return dataclasses.replace(made, dt=dt or 0.5 * float(softmpm.stable_dt(made)))


def build(made: softmpm.Scene, dtype=torch.float64, device="cpu", **settings) -> softmpm.Model:
    return softmpm.build(made, device=device, dtype=dtype, formulation="reference", **settings)


def flying(model: softmpm.Model, speed: float) -> softmpm.State:
    """A body that flies along x and vibrates."""
    state = model.rest()
    x = state.x - state.x.mean(1, keepdim=True)
    state.C[..., 0, 0], state.C[..., 1, 1] = 1.5, -1.5
    state.v[:] = (state.C @ x[..., None])[..., 0]
    state.v[..., 0] += speed
    return state


def test_the_strain_of_a_body_that_flew_1000_cells(device):
    """In float32 within 2e-5 of that in float64; with one number per displacement it was 2e-3 off, and 1e-4 without what rounding kept
    from the velocities. u stays within a few cells."""
    substeps, found = 4000, []
    for dtype in (torch.float32, torch.float64):
        made = block()
        model = build(made, dtype, device)
        start = flying(model, 1000 * DX / (substeps * made.dt))
        end = softmpm.simulate(model, start, None, model.params(), substeps=substeps)
        assert end.nodes is not None and end.nodes.shift is not None
        assert end.nodes.shift.dtype == torch.float64 and end.nodes.u.abs().max() <= 2.1 * quantum(model)
        found.append(end)
    way = found[1].x - model.rest().x
    assert way[..., 0].mean().item() == pytest.approx(1000 * DX, rel=1e-6)
    assert found[1].F.sub(torch.eye(2).to(found[1].F)).abs().max() > 0.02
    assert (found[0].F.double() - found[1].F).abs().max() <= 2e-5
    assert (found[0].x.double() - found[1].x).abs().max() <= 2e-5 * 1000 * DX


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_division_into_calls_does_not_matter(dtype, device):
    """The shift depends on the state alone: the same bits in one call, in many, and in chunks that are recomputed for a gradient."""
    made = block(walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.28, friction=0.3)], gravity=(0.0, -9.8))
    model = build(made, dtype, device)
    start = flying(model, 0.3 * DX / made.dt)
    whole = softmpm.simulate(model, start, None, model.params(), substeps=60)
    state = start
    for substeps in (1, 7, 20, 32):
        state = softmpm.simulate(model, state, None, model.params(), substeps=substeps)
    assert whole.nodes is not None and state.nodes is not None
    found, wanted = ((*one[:4], *one.nodes._replace(force=one.x)) for one in (state, whole))
    for got, want in zip(found, wanted, strict=True):  # forces are means over calls
        assert torch.equal(got, want)
    assert whole.nodes.shift is not None and whole.nodes.shift[0, 0] > 10 * DX


def test_values_and_gradients_are_those_of_the_reference(device):
    """With friction at surface points of a body that slides over many cells, where u_total is a single number: 1e-10."""
    walls = [
        softmpm.Wall(normal=(-0.1, 1.0), offset=0.24, friction=0.3),
        softmpm.Wall(normal=(0.0, -1.0), offset=-0.8),
    ]
    made = block(walls=walls, gravity=(0.0, -9.8))
    made = dataclasses.replace(
        made,
        bodies=[
            dataclasses.replace(
                made.bodies[0], material=dataclasses.replace(made.bodies[0].material, viscosity=20.0)
            )
        ],
    )
    made = dataclasses.replace(made, dt=0.4 * float(softmpm.stable_dt(made)))
    model = build(made, device=device)
    start = flying(model, 0.2 * DX / made.dt)
    start.v[..., 1] -= 0.5
    params, leaves = model.params(), [t.requires_grad_() for t in start[:4]]
    end = softmpm.simulate(model, softmpm.State(*leaves), None, params, substeps=40)
    found = [*end[:4], *torch.autograd.grad(dot(cotangent(end), end), leaves)]
    copies = [t.detach().cpu().requires_grad_() for t in leaves]
    own = softmpm.Params(*(t.cpu() for t in params))
    points = model.surface
    assert points is not None
    surface = contact.Surface(
        points.points.cpu(),
        model.rest_grid.index.cpu()[points.stencil.cpu().long()],
        points.weights.cpu(),
        points.areas.cpu(),
        points.stiffness.cpu(),
    )
    u, v = lagrangian.project(made, softmpm.State(*copies), own)
    u, v, anchor, _ = lagrangian.simulate(made, u, v, None, own, substeps=40, surface=surface)
    shown = lagrangian.evaluate(made, u, v)
    wanted = [*shown[:4], *torch.autograd.grad(dot(cotangent(shown), shown), copies)]
    for name, got, want in zip([*"xvCF", "adj_x", "adj_v", "adj_C", "adj_F"], found, wanted, strict=True):
        assert want.abs().max() > 0
        assert_relative(got.detach().cpu(), want.detach(), 1e-10, name)
    assert end.v[..., 0].mean() < start.v[..., 0].mean() - 0.01, "the body must rub on the wall"
    nodes = end.nodes
    assert nodes is not None and nodes.shift is not None
    shift = nodes.shift.cpu()
    assert shift[0, 0] > 5 * DX
    normals = points.normals.cpu()
    across = shift[:, None] - torch.einsum("wd,kd->wk", shift, normals)[..., None] * normals
    assert_relative(nodes.anchor.detach().cpu() + across[:, :, None], anchor.detach(), 1e-10, "anchor")


def test_a_start_far_away_and_a_state_without_a_shift():
    """A state without nodes gets its shift from x; nodes without a shift have none, and continue like those with the sum."""
    model = build(block(), torch.float32)
    state = flying(model, 0.0)
    far = state._replace(x=state.x + torch.tensor([80.0, 0.0]), low=None)
    end = softmpm.simulate(model, far, None, model.params(), substeps=3)
    assert end.nodes is not None and end.nodes.shift is not None
    assert end.nodes.shift[0].tolist() == [80.0, 0.0] and end.nodes.u.abs().max() < DX
    exact = build(block())
    state = softmpm.simulate(exact, flying(exact, 20.0), None, exact.params(), substeps=3)
    assert state.nodes is not None and state.nodes.shift is not None
    plain = softmpm.Nodal(state.nodes.u + state.nodes.shift[:, None], *state.nodes[1:4])
    ends = [
        softmpm.simulate(exact, particles_of(exact, nodes), None, exact.params(), substeps=4)
        for nodes in (state.nodes, plain)
    ]
    for got, want in zip(ends[0][:4], ends[1][:4], strict=True):
        torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-11)
    moved = state.nodes.to(torch.float32)
    assert moved.u.dtype == torch.float32 and moved.shift is not None and moved.shift.dtype == torch.float64
    wrong = state.to(torch.float32)._replace(nodes=moved._replace(shift=moved.shift.float()))
    with pytest.raises(ValueError, match=r"state.nodes.shift must be torch.float64 in every precision"):
        softmpm.simulate(model, wrong, None, model.params(), substeps=1)


def test_the_quantum_is_a_power_of_two():
    """From a cell on, so that a change of frame rounds nothing."""
    for spacing in (0.04, 1 / 32, 1.0, 3.0):
        scene = dataclasses.replace(block(), grid=softmpm.Grid(shape=(24, 24), spacing=spacing))
        fake = SimpleNamespace(scene=scene, mirror=None, spec=SimpleNamespace(moving=False))
        q = quantum(fake)
        assert spacing <= q < 2 * spacing and np.log2(q) == round(np.log2(q))


def test_a_body_that_turns_keeps_its_angular_momentum_in_float32():
    """To 5e-8 in 600 substeps, with what rounding kept from displacements and velocities; without either, twice as badly or worse."""

    def spin(state: softmpm.State) -> float:
        grid, nodes = model.rest_grid, state.nodes
        assert nodes is not None
        x, v = grid.nodes * DX + nodes.u[0].double(), nodes.v[0].double()
        x = x - grid.weight @ x / grid.weight.sum()
        return (grid.weight @ (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])).item()

    def drift(kept: tuple[float, float]) -> float:
        """Largest change over 600 calls of a substep, with these shares of the remainders of u and v."""
        state, changes = start, []
        for _ in range(600):
            nodes = state.nodes
            assert nodes is not None and nodes.low is not None
            low = nodes.low * torch.tensor(kept)[:, None, None]
            state = state._replace(nodes=nodes._replace(low=low))
            state = softmpm.simulate(model, state, None, model.params(), substeps=1)
            changes.append(abs(spin(state) / spin(start) - 1))
        return max(changes)

    model = build(block(), torch.float32)
    turning = model.rest()
    turning.C[..., 0, 1], turning.C[..., 1, 0] = -5.0, 5.0
    x = turning.x - turning.x.mean(1, keepdim=True)
    turning.v[:] = (turning.C @ x[..., None])[..., 0]
    start = softmpm.simulate(model, turning, None, model.params(), substeps=1)
    least = drift((1.0, 1.0))
    assert least <= 5e-8
    assert drift((0.0, 1.0)) > 2 * least and drift((1.0, 0.0)) > 2 * least


@pytest.mark.parametrize("dtype, limit", [(torch.float64, 1e-9), (torch.float32, 2e-3)])
def test_a_shifted_state_goes_on_at_walls_that_turn(dtype, limit):
    """A block slides by eight cells in a model with walls at rest and goes on in one whose floor turns about a place: end and gradients
    are those of the second model from the beginning on. Its anchors had stayed relative to the shift."""
    scene = slab(
        friction=0.8, gravity=(0.0, -9.8), width=4, grid=softmpm.Grid(shape=(40, 28), spacing=1 / 32)
    )
    settings = dict(device="cpu", dtype=dtype, formulation="reference")
    still = softmpm.build(scene, **settings)
    turning = softmpm.build(scene, **settings, inputs=("wall_normal", "wall_offset"))
    angle = torch.linspace(0.0, 0.1, 5, dtype=torch.float64)
    pivot = torch.tensor([0.4, scene.walls[0].offset], dtype=torch.float64)
    found = []
    for model in (still, turning):
        start = model.rest()
        start = start._replace(v=start.v + torch.tensor([2.0, 0.0], dtype=dtype))
        start = softmpm.simulate(model, start, None, model.params(), substeps=1400)  # until it rests
        assert start.nodes.shift.abs().sum() > 0 or model is turning
        normal = torch.stack([-angle.sin(), angle.cos()], -1)[:, None, None].requires_grad_()
        poses = softmpm.Inputs(wall_normal=normal, wall_offset=(normal.detach() * pivot).sum(-1))
        end = softmpm.simulate(turning, start, None, turning.params(), substeps=200, inputs=poses)
        (gradient,) = torch.autograd.grad(end.x[..., 0].mean() + end.v[..., 0].mean(), normal)
        assert end.nodes.shift.abs().sum() == 0
        found.append((end.x.detach(), end.v.detach(), gradient))
    assert found[1][2].norm() > 0.1
    for name, carried, own in zip(("x", "v", "gradient"), *found, strict=True):
        assert_relative(carried, own, limit, name)
