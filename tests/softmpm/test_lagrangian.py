"""The reference formulation: every value and gradient against the float64 oracle, and what it promises."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers import (
    GIVEN,
    LAWS,
    WALL_INPUTS,
    assert_relative,
    busy_inputs,
    busy_scene,
    cotangent,
    dot,
    full_scene,
    little_memory,
)
from surface_scenes import by_reference, compare

import softmpm
from softmpm.kernels.lagrangian import bricks
from softmpm.schemes.lagrangian.frame import quantum
from softmpm.schemes.lagrangian.nodal import nodes_of, particles_of


def build(made: softmpm.Scene, **settings) -> softmpm.Model:
    alarms = softmpm.Alarms(collapse=None)
    return softmpm.build(
        made, device=settings.pop("device", "cpu"), formulation="reference", alarms=alarms, **settings
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_the_end_and_all_gradients_are_those_of_the_reference(dim, device):
    """All laws, overlapping muscles, pressure, viscosity, walls of each kind, two worlds with other values each."""
    made = full_scene(dim, driven=())
    names = (*GIVEN, "strength")
    compare(build(made, device=device, dtype=torch.float64, worlds=2, inputs=names), names, 1e-10)
    compare(build(made, device=device, worlds=2, inputs=names), names, 5e-4)


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_that_move_nodes(dim, device):
    """Walls of each kind that advance, turn and slide, other ones in each world; the nodes they meet move as well: ≤ 1e-10."""
    names = ("friction", *WALL_INPUTS)
    model = build(full_scene(dim, driven=()), device=device, dtype=torch.float64, worlds=2, inputs=names)
    compare(model, names, 1e-10)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
def test_each_law_alone(law, dim, device):
    """Without the features that the other test has: what is absent is not compiled."""
    made = busy_scene(dim, (law,), muscles=[], walls=[], gravity=None, damping=0.0)
    model = build(made, device=device, dtype=torch.float64)
    leaves = busy_inputs(model)
    del leaves["activation"]
    copies = {name: t.detach().cpu().requires_grad_() for name, t in leaves.items()}
    found = []
    for tensors in (leaves, copies):
        start = softmpm.State(*(tensors[name] for name in "xvCF"))
        params = softmpm.Params(*(tensors[name] for name in softmpm.Params._fields))
        if tensors is leaves:
            end = softmpm.simulate(model, start, None, params, substeps=4)
        else:
            end, _ = by_reference(model, start, None, params, substeps=4)
        found.append([*end[:4], *torch.autograd.grad(dot(cotangent(end), end), list(tensors.values()))])
    for name, got, want in zip([*"xvCF", *leaves], *found, strict=True):
        assert_relative(got.detach().cpu(), want.detach(), 1e-10, name)


def on_lattice(made: softmpm.Scene, places: int) -> softmpm.Scene:
    """The scene with its particles at random places of a lattice, with holes."""
    generator, dim, h = np.random.default_rng(3), made.grid.dim, made.grid.spacing / places
    lattice = np.stack(np.meshgrid(*[np.arange(round(0.3 / h), round(0.65 / h))] * dim), -1).reshape(-1, dim)
    positions = (generator.permutation(lattice) + 0.5) * h
    bodies, first = [], 0
    for body in made.bodies:
        count = len(body.particles)
        particles = softmpm.Particles(positions[first : first + count], body.particles.volume)
        bodies.append(dataclasses.replace(body, particles=particles))
        first += count
    return dataclasses.replace(made, bodies=bodies)


@pytest.mark.parametrize(("dim", "places"), [(2, 3), (3, 2)])
def test_lattices_have_the_values_and_gradients_of_the_reference(dim, places, device):
    """Cells whose particles share their weights have kernels of their own."""
    made = on_lattice(full_scene(dim, driven=()), places)
    names = ("gravity", "damping", "friction", "direction", "viscosity", "strength")
    model = build(made, device=device, dtype=torch.float64, worlds=2, inputs=names)
    assert model.rest_grid.lattice is not None and model.rest_grid.lattice.shape == (dim, places)
    compare(model, names, 1e-10)
    compare(build(made, device=device, worlds=2, inputs=names), names, 5e-4)


@pytest.mark.gpu
@pytest.mark.parametrize("viscosity", [0.0, 0.02])
def test_bricks_of_large_scenes(viscosity, monkeypatch):
    """The same for a small scene with the bricks that large ones have on a GPU."""
    monkeypatch.setattr(bricks, "FEW", {2: 0, 3: 0})
    made = on_lattice(full_scene(3, driven=(), viscosity=viscosity), 2)
    names = ("gravity", "damping", "friction", "direction", "strength")
    model = build(made, device="cuda", worlds=2, inputs=names)
    assert model.rest_grid.bricks.cells == (4, 4, 4)
    compare(model, names, 5e-4)


@pytest.mark.parametrize("budget", [None, 40_000])
def test_calls_in_turn_are_one_call(budget, device):
    """A state with nodes continues without loss: values to the bit, gradients too, stored or recomputed."""
    model = build(
        full_scene(2, driven=()),
        device=device,
        dtype=torch.float64,
        memory_budget=budget,
        calls=1 if budget else 2,
    )
    inputs = busy_inputs(model, control_steps=4)
    start = softmpm.State(*(inputs[name] for name in "xvCF"))
    params = softmpm.Params(*(inputs[name] for name in softmpm.Params._fields))
    rows = inputs["activation"]
    whole = softmpm.simulate(model, start, rows, params, substeps=5)
    first = softmpm.simulate(model, start, rows[:2], params, substeps=5)
    parts = softmpm.simulate(model, first, rows[2:], params, substeps=5)
    for got, want in zip(parts[:4], whole[:4], strict=True):
        assert torch.equal(got, want)
    found = [torch.autograd.grad(dot(cotangent(end), end), list(inputs.values())) for end in (whole, parts)]
    for name, want, got in zip(inputs, *found, strict=True):
        assert_relative(got, want, 1e-12, name)


def test_the_same_bits_in_every_run(device):
    """No atomic additions: also on a GPU, in float32, without ``deterministic``."""
    model = build(full_scene(3, driven=()), device=device)
    inputs = busy_inputs(model)
    found = []
    for _ in range(3):
        start = softmpm.State(*(inputs[name] for name in "xvCF"))
        nodes = nodes_of(model, start, model.mass.expand(1, -1)).detach()
        state = particles_of(model, nodes)
        leaves = [nodes.u.requires_grad_(), nodes.v.requires_grad_()]
        end = softmpm.simulate(
            model, state._replace(nodes=nodes), inputs["activation"], model.params(), substeps=8
        )
        assert end.nodes is not None
        loss = end.nodes.u.square().sum() + end.nodes.v.sum()
        found.append([*end.nodes.detach(), *torch.autograd.grad(loss, leaves)])
    for again in found[1:]:
        for got, want in zip(again, found[0], strict=True):
            assert torch.equal(got, want)


def test_affine_states_are_projected_exactly(device):
    """What particles show of the nodes of an affine state is that state."""
    model = build(busy_scene(3), device=device, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    F = torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    C = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    x = model.positions.cpu() @ F.T + 0.1
    fields = (x, 0.3 + x @ C.T, C.expand(len(x), 3, 3), F.expand(len(x), 3, 3))
    state = softmpm.State(*(field[None].to(model.device).contiguous() for field in fields))
    shown = particles_of(model, nodes_of(model, state, model.mass.expand(1, -1)))
    for name, got, want in zip("xvCF", shown[:4], state[:4], strict=True):
        torch.testing.assert_close(got, want, rtol=1e-11, atol=1e-11, msg=name)


def test_states_far_from_rest_are_projected_without_loss():
    """In float32 a rest state has no displacement at all, with and without remainders of rounding; others have them, and a shift."""
    model = build(busy_scene(3))
    rest, mass, way = model.rest(), model.mass.expand(1, -1), 7.3 * quantum(model)
    assert rest.low is not None and rest.low.x.any()
    for state in (rest, rest._replace(low=None)):
        nodes = nodes_of(model, state, mass)
        assert not nodes.u.any() and not nodes.shift.any()
    moved = nodes_of(model, rest._replace(low=rest.low._replace(x=rest.low.x + 1e-6)), mass)
    torch.testing.assert_close(moved.u, torch.full_like(moved.u, 1e-6), rtol=1e-3, atol=0.0)
    far = nodes_of(model, rest._replace(x=rest.x + way, low=None), mass)
    assert far.u.mean(1).abs().max() <= quantum(model)
    moved = far.shift + far.u.double()
    torch.testing.assert_close(moved, torch.full_like(moved, way), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_particles_in_the_middle_of_cells(dim, device):
    """One particle in the middle of each cell, where the last spline along each axis is zero: a free fall by the discrete law."""
    made = busy_scene(dim, walls=[], muscles=[], damping=0.0)
    shape = softmpm.box((0.3,) * dim, (0.6,) * dim, spacing=0.1)
    positions = np.round(shape.positions / 0.05) * 0.05
    assert (positions / made.grid.spacing - 0.5 == np.floor(positions / made.grid.spacing - 0.5)).any()
    body = softmpm.Body(
        softmpm.Particles(positions, shape.volume), softmpm.NeoHookean(density=1.0, young=80.0)
    )
    made = dataclasses.replace(made, bodies=[body])
    model = build(made, device=device, dtype=torch.float64)
    start = model.rest()
    end = softmpm.simulate(model, start, None, model.params(), substeps=10)
    fallen = (end.x - start.x).cpu()
    want = torch.tensor(made.gravity, dtype=torch.float64) * made.dt**2 * 55
    torch.testing.assert_close(fallen, want.expand_as(fallen), rtol=1e-9, atol=1e-12)


def test_a_changed_state_is_not_ignored():
    """A state whose tensors differ from what its nodes show is refused; without nodes it runs."""
    model = build(busy_scene(2), dtype=torch.float64, worlds=2)
    state = softmpm.simulate(model, model.rest(), None, model.params(), substeps=3)
    for name in "xvCF":
        field = getattr(state, name).clone()
        field[-1, -1].view(-1)[-1] += 0.25
        changed = state._replace(**{name: field})
        with pytest.raises(ValueError, match=f"state.{name} was changed.*they differ by 0.25;"):
            softmpm.simulate(model, changed, None, model.params(), substeps=1)
    assert state.nodes is not None
    u = state.nodes.u.clone()
    u[0, 3, 0] = torch.nan
    with pytest.raises(
        ValueError, match=r"state.nodes.u must be finite, but state.nodes.u\[0, 3, 0\] is nan"
    ):
        softmpm.simulate(
            model, state._replace(nodes=state.nodes._replace(u=u)), None, model.params(), substeps=1
        )
    softmpm.simulate(model, changed._replace(nodes=None), None, model.params(), substeps=1)
    moving = softmpm.build(busy_scene(2), device="cpu", dtype=torch.float64, worlds=2)
    with pytest.raises(ValueError, match="state.nodes must be None with formulation='moving'"):
        softmpm.simulate(moving, state, None, moving.params(), substeps=1)


def test_a_gradient_that_nodes_would_lose_is_refused():
    """A kick that is to be optimised and begins at zero changes no value; without nodes its gradient is that of differences."""
    model = build(busy_scene(2), dtype=torch.float64)
    params = model.params()
    warm = softmpm.simulate(model, model.rest(), None, params, substeps=3).detach()
    kick = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    kicked = warm._replace(v=warm.v + kick)
    with pytest.raises(
        ValueError, match=r"state.v requires a gradient, but a call continues from state.nodes, .*nodes=None"
    ):
        softmpm.simulate(model, kicked, None, params, substeps=3)
    with torch.no_grad():
        softmpm.simulate(model, kicked, None, params, substeps=3)

    def way(by: torch.Tensor) -> torch.Tensor:
        start = warm._replace(v=warm.v + by, nodes=None)
        return softmpm.simulate(model, start, None, params, substeps=3).x[..., 0].mean()

    (gradient,) = torch.autograd.grad(way(kick), kick)
    step = torch.tensor([1e-4, 0.0], dtype=torch.float64)
    difference = (way(step) - way(-step)) / 2e-4
    assert gradient[0].item() == pytest.approx(difference.item(), rel=1e-6) and gradient[0] > 0
    changed = warm._replace(v=2 * warm.v)
    with pytest.raises(ValueError, match="state.v was changed, but state.nodes was not"):
        softmpm.kinetic_energy(model, changed, params)
    with pytest.raises(ValueError, match="state.v requires a gradient"):
        softmpm.kinetic_energy(model, kicked, params)
    softmpm.kinetic_energy(model, changed._replace(nodes=None), params)


def test_no_nodes_show_a_particle_parted_from_its_neighbours():
    """Nor one that is mirrored: the projection would bring it back among them. Both are named, and an affine deformation is neither."""
    settings = dict(device="cpu", dtype=torch.float64, worlds=2, formulation="reference")
    model = softmpm.build(busy_scene(2), **settings, alarms=softmpm.Alarms(step=None, overlap=None))
    rest, args = model.rest(), (None, model.params())
    x, F = rest.x.clone(), rest.F.clone()
    x[1, 20] += 2.3 * model.scene.grid.spacing
    with pytest.raises(
        ValueError, match=r"particle 20 of world 1 is 1\.91 cells from where the displacement"
    ):
        softmpm.simulate(model, rest._replace(x=x), *args, substeps=1)
    F[1, 20, 0, 0] = -1.0
    with pytest.raises(
        ValueError, match=r"det state.F must be above 0.05, but that of particle 20 of world 1 is -1;"
    ):
        softmpm.simulate(model, rest._replace(F=F), *args, substeps=1)
    middle = rest.x.mean(dim=1, keepdim=True)
    A = torch.tensor([[0.3, 0.7], [-0.8, 1.1]], dtype=torch.float64)
    bent = rest._replace(x=middle + (rest.x - middle) @ A.T, F=A.expand_as(rest.F).clone())
    softmpm.simulate(model, bent, *args, substeps=1)


def test_remainders_of_rounding_reach_the_nodes():
    """A float32 state with a strain below its precision gives the nodes of the same state in float64."""
    single, double = (build(busy_scene(2), dtype=dtype) for dtype in (torch.float32, torch.float64))
    rest = double.rest()
    H = 1e-9 * torch.randn(rest.F.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    zero = single.rest()
    low = softmpm.Low(single.rest_low.expand_as(zero.x), H.float())
    got = nodes_of(single, zero._replace(low=low), single.mass.expand(1, -1))
    want = nodes_of(double, rest._replace(F=rest.F + H), double.mass.expand(1, -1))
    assert want.u.abs().max() > 1e-11
    torch.testing.assert_close(got.u.double(), want.u, rtol=1e-4, atol=1e-15)


def test_what_the_formulation_lacks_is_refused():
    """By name, before anything is launched."""
    with pytest.raises(ValueError, match="leave scheme out"):
        build(full_scene(2, driven=()), scheme="fast")
    with pytest.raises(ValueError, match="formulation must be 'auto', 'moving' or 'reference'"):
        softmpm.build(busy_scene(2), formulation="lagrangian")


def test_auto_takes_the_reference_formulation_where_it_serves():
    """Only if the scene says that bodies meet walls only, and nothing is asked for that the formulation lacks; the summary says why."""
    alone = {"driven": (), "body_contact": False}
    for changes, settings, formulation, why in (
        (alone, {}, "reference", "bodies meet walls only"),
        ({"driven": ()}, {}, "moving", "the scene does not state body_contact=False"),
        ({"body_contact": False}, {}, "reference", "bodies meet walls only"),
        (alone, {"inputs": ("wall_offset",)}, "reference", "bodies meet walls only"),
        (alone, {"scheme": "plain"}, "moving", "has one scheme, got scheme='plain'"),
    ):
        model = softmpm.build(full_scene(2, **changes), device="cpu", formulation="auto", **settings)
        assert model.formulation == formulation and why in model.formulation_reason
        assert f"{formulation} formulation: {model.formulation_reason}" in model.describe(substeps=10)
    model = softmpm.build(full_scene(2, **alone), device="cpu")
    assert model.formulation == "moving"  # the default, which nobody asked for
    assert "moving formulation: formulation='moving', the default\n" in model.describe(substeps=10)
    with pytest.raises(TypeError, match="body_contact must be True or False, got 'no'"):
        full_scene(2, body_contact="no")


def collapsing(device: str = "cpu", **settings) -> tuple[softmpm.Model, softmpm.State]:
    """Two worlds, of which the second collapses."""
    made = busy_scene(2, ("fixed_corotated",), walls=[], muscles=[], per_law=30)
    model = softmpm.build(
        made, device=device, dtype=torch.float64, worlds=2, formulation="reference", **settings
    )
    state = model.rest()
    state.F[1] = 0.3 * state.F[1]
    state.C[1] = -400.0 * torch.eye(2).to(state.C)
    center = state.x[1].mean(0)
    return model, state._replace(x=torch.stack([state.x[0], center + 0.3 * (state.x[1] - center)]))


@pytest.mark.parametrize("memory", ["stored", "recomputed"])
def test_a_world_that_fails_takes_no_gradient_and_leaves_that_of_the_others(memory, device):
    """Its velocities no longer move its nodes, and the gradient computes displacements from velocities."""
    model, state = collapsing(device)
    settings = {} if memory == "stored" else little_memory(model)
    model, state = collapsing(device, **settings)
    found = []
    for start in (state, model.rest()):
        start = start._replace(v=(start.v + 0.1).requires_grad_())
        failures = softmpm.Failures("freeze")
        end = softmpm.simulate(model, start, None, model.params(), substeps=40, failures=failures)
        found.append(torch.autograd.grad((end.x**2).sum(), start.v)[0])
        assert [error.substep for error in failures.errors] == [1] * (start.x is state.x)
    assert torch.equal(found[0][0], found[1][0]) and found[0][0].abs().max() > 0
    assert not found[0][1].any()


def test_a_particle_that_collapses_is_named():
    """With world, particle and substep, and the state before it."""
    model, state = collapsing()
    with pytest.raises(softmpm.UnstableError, match="of world 1") as caught:
        softmpm.simulate(model, state, None, model.params(), substeps=40)
    assert caught.value.kind == "collapsed" and caught.value.substep >= 0
    failures = softmpm.Failures("freeze")
    end = softmpm.simulate(model, state, None, model.params(), substeps=40, failures=failures)
    assert len(failures.errors) == 1 and torch.isfinite(end.x).all()
    assert repr(failures) == "Failures(freeze: 1 failure in worlds [1])"
    alone = softmpm.simulate(model, model.rest(), None, model.params(), substeps=40)
    assert torch.equal(end.x[0], alone.x[0])


def test_no_numerical_fracture():
    """A bar that is stretched to 2.5 times its length, far beyond what the moving grid holds together, comes back."""
    made = busy_scene(2, walls=[], muscles=[], gravity=None, damping=0.0)
    shape = softmpm.box((0.3, 0.4), (0.6, 0.5), spacing=0.05)
    body = softmpm.Body(shape, softmpm.BarrierCorotated(density=1.0, young=50.0, poisson=0.3, viscosity=0.2))
    made = dataclasses.replace(made, bodies=[body], dt=2.5e-4)
    model = softmpm.build(made, device="cpu", dtype=torch.float64, formulation="reference")
    state = model.rest()
    state.F[..., 0, 0] = 2.5
    state.x[..., 0] = 0.45 + 2.5 * (state.x[..., 0] - 0.45)
    end = softmpm.simulate(model, state, None, model.params(), substeps=8000)
    torch.testing.assert_close(end.F, model.rest().F, rtol=0, atol=0.02)


@pytest.mark.filterwarnings(
    "ignore:.torch.jit.script. is deprecated:DeprecationWarning"
)  # of PyTorch's own jvp
def test_transforms_of_pytorch():
    """torch.func.grad gives the gradient of autograd; batches, forward mode and second derivatives are refused in a sentence."""
    model = build(full_scene(2, driven=(3, 4)), dtype=torch.float64)
    rest, params = model.rest(), model.params()

    def height(v: torch.Tensor) -> torch.Tensor:
        return softmpm.simulate(model, rest._replace(v=v), None, params, substeps=3).x[..., 1].mean()

    v = rest.v.clone().requires_grad_()
    (want,) = torch.autograd.grad(height(v), v)
    torch.testing.assert_close(torch.func.grad(height)(rest.v), want, rtol=0, atol=0)
    with pytest.raises(RuntimeError, match=r"softmpm: torch.vmap .* build the model with worlds=N"):
        torch.vmap(height)(torch.stack([rest.v, rest.v]))
    with pytest.raises(RuntimeError, match=r"softmpm: forward-mode .* use reverse mode"):
        torch.func.jvp(height, (rest.v,), (rest.v,))
    (first,) = torch.autograd.grad(height(v), v, create_graph=True)
    with pytest.raises(RuntimeError, match="softmpm: second derivatives are not available"):
        torch.autograd.grad(first.sum(), v)
