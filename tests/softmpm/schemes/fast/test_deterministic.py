"""A deterministic model gives the same bits from run to run, whatever the order in which its sums are taken."""

import functools

import numpy as np
import pytest
import torch
from helpers import INPUTS, assert_relative, busy_inputs, busy_scene, cotangent, dot, gradients, run

import softmpm
from softmpm.oracle import moving
from softmpm.schemes.fast.particle_order import ParticleLayout


def build(dim: int, deterministic=True, device="cpu", **settings) -> softmpm.Model:
    settings = dict(scheme="fast", worlds=2) | settings
    return softmpm.build(busy_scene(dim), device=device, deterministic=deterministic, **settings)


def everything(model, inputs, substeps=10, weights=None) -> dict[str, torch.Tensor]:
    """The end, and the gradient with respect to each input."""
    end = run(softmpm.simulate, model, inputs, substeps)
    found = gradients(softmpm.simulate, model, inputs, substeps, weights)
    return {f"end.{name}": t.detach() for name, t in zip("xvCF", end[:4], strict=True)} | found


@pytest.mark.parametrize("dim", [2, 3])
def test_fixed_point_gives_what_floating_point_gives(dim, device):
    """The end to 2e-6 and every gradient to 1e-5 of the ordinary fast scheme."""
    exact, plain = build(dim, device=device), build(dim, False, device=device)
    inputs = busy_inputs(exact)
    got, want = everything(exact, inputs), everything(plain, inputs)
    for name in got:
        assert_relative(got[name], want[name], 2e-6 if name.startswith("end") else 1e-5, name)


@pytest.mark.parametrize("dim", [2, 3])
def test_state_and_every_gradient_are_the_references(dim, device):
    """Against float64: as near as single precision allows."""
    model = build(dim, device=device)
    inputs = busy_inputs(model)
    copies = {name: t.detach().cpu().double().requires_grad_() for name, t in inputs.items()}
    want_end = run(moving.simulate, model.scene, copies, 10)
    weights = cotangent(want_end)
    want = gradients(moving.simulate, model.scene, copies, 10, weights)
    got = everything(model, inputs, weights=weights.to(model.device, model.dtype))
    for name, end in zip("xvCF", want_end[:4], strict=True):
        assert_relative(got[f"end.{name}"].cpu(), end, 2e-6, name)
    for name in INPUTS:
        assert_relative(got[name].cpu(), want[name], 1e-5, name)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_order_of_the_particles_leaves_no_trace(dim, monkeypatch):
    """Any order gives the same bits on the CPU, where particles add to nodes one by one; sums of floats do not."""
    orders = {
        "sorted": lambda order: order,
        "reversed": lambda order: order.flip(1),
        "shuffled": lambda order: order[:, torch.randperm(order.shape[1])],
    }
    resort = ParticleLayout.resort

    def put(layout, x, change):
        resort(layout, x)
        layout.order.copy_(change(layout.order).clone())

    for deterministic in (True, False):
        found = {}
        for name, change in orders.items():
            monkeypatch.setattr(ParticleLayout, "resort", functools.partialmethod(put, change=change))
            model = build(dim, deterministic)
            found[name] = everything(model, busy_inputs(model))
        names = set(found["sorted"]) - {"activation"}  # that is added up in the order of the places
        traces = {
            name
            for name in names
            for other in orders
            if not torch.equal(found[other][name], found["sorted"][name])
        }
        assert not traces if deterministic else {"end.v", "x", "v"} <= traces, traces
        assert_relative(found["reversed"]["activation"], found["sorted"]["activation"], 1e-6)


def test_what_ran_before_leaves_no_trace(device):
    """The order follows from where a chunk starts, not from the one kept from other calls."""
    model = build(2, device=device, alarms=softmpm.Alarms(gap=None))
    inputs = busy_inputs(model, control_steps=7)
    first = everything(model, inputs, substeps=40)  # more than a chunk holds
    moved = {name: t.detach().clone() for name, t in inputs.items()}
    moved["x"] = moved["x"].flip(1)
    run(softmpm.simulate, model, moved, 5)
    again = everything(model, inputs, substeps=40)
    for name, value in first.items():
        assert torch.equal(value, again[name]), name


def test_units_follow_the_size_of_the_gradient_in_each_world():
    """A cotangent 2^40 times as large in one world, 2^-60 times in the other: gradients exactly as many times as large."""
    model = build(3)
    inputs = busy_inputs(model)
    weights = cotangent(model.rest())
    times = torch.tensor([2.0**40, 2.0**-60])
    scaled = [w * times.view(2, *(1 for _ in w.shape[1:])) for w in weights[:4]]
    one, other = (gradients(softmpm.simulate, model, inputs, 5, w) for w in (weights, scaled))
    for name in INPUTS:
        factor = (
            times.view(2, 1) if name == "activation" else times.view(2, *(1 for _ in one[name].shape[1:]))
        )
        assert torch.equal(other[name], one[name] * factor), name


@pytest.mark.parametrize("dim", [2, 3])
def test_a_crowd_on_one_node_does_not_overflow(dim):
    """5,000 particles in one cell, fast and of one velocity: the whole of them moves on as one."""
    place = np.random.default_rng(0).uniform(0.46, 0.54, (5000, dim))
    body = softmpm.Body(softmpm.Particles(place, 1e-4), softmpm.NeoHookean(density=1e3, young=1e-9))
    scene = softmpm.Scene(grid=softmpm.Grid(shape=(12,) * dim, spacing=0.1), bodies=[body], dt=1e-3)
    model = softmpm.build(scene, device="cpu", deterministic=True)
    start = model.rest()
    start.v[..., 0] = 40.0  # [m/s], less than half a cell in each substep
    end = softmpm.simulate(model, start, None, model.params(), substeps=3)
    torch.testing.assert_close(end.v, start.v, rtol=1e-5, atol=1e-5)


def test_a_value_that_is_not_finite_is_reported_and_stays_in_its_world(device):
    """Stress overflows: the particle is named, and the other world ends as it would."""
    model = build(2, device=device)
    inputs = {name: t.detach() for name, t in busy_inputs(model).items()}
    reset_status = run(softmpm.simulate, model, inputs, 10)
    inputs["F"] = inputs["F"].clone()
    inputs["F"][1, 5] *= 5e18
    with pytest.raises(softmpm.UnstableError) as caught:
        run(softmpm.simulate, model, inputs, 10)
    error = caught.value
    assert (error.kind, error.world, error.particle, error.substep) == ("not_finite", 1, 5, 0)
    for name in "xvCF":
        assert torch.equal(getattr(error.state, name)[0], getattr(reset_status, name)[0]), name


def test_a_gradient_that_is_not_finite_is_an_error(device):
    """It is not lost in integers: the backward pass raises, and names the world."""
    model = build(2, device=device)
    inputs = busy_inputs(model)
    end = run(softmpm.simulate, model, inputs, 4)
    weight = torch.zeros_like(end.x)
    weight[1, 3] = 3e38
    with pytest.raises(softmpm.UnstableError) as caught:
        (end.x * weight * 10).sum().backward()
    assert (caught.value.kind, caught.value.world) == ("gradient", 1)


def block(dim: int, count: tuple[int, ...], spacing: float) -> softmpm.Scene:
    """A soft block of equal particles with two muscles, just above a rough floor."""
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), -1).reshape(-1, dim)
    places = (lattice + 0.5) * spacing / 2 + 8 * spacing
    material = softmpm.NeoHookean(density=1e3, young=1e5, poisson=0.3)
    half = np.arange(len(places)) < len(places) // 2
    up = (0.0, 1.0, 0.0)[:dim]
    return softmpm.Scene(
        grid=softmpm.Grid(shape=tuple(n // 2 + 24 for n in count), spacing=spacing),
        bodies=[softmpm.Body(softmpm.Particles(places, (spacing / 2) ** dim), material)],
        muscles=[
            softmpm.Muscle(particles=np.flatnonzero(side), direction=up, strength=2e3)
            for side in (half, ~half)
        ],
        walls=[softmpm.Wall(normal=up, offset=7.9 * spacing, friction=0.4)],
        gravity=(0.0, -9.8, 0.0)[:dim],
        dt=1e-4,
    )


def test_an_observers_sums_do_not_depend_on_the_order_either():
    """rasterize of equal particles in another order: the same bits."""
    model = softmpm.build(block(2, (12, 10), 0.05), device="cpu", deterministic=True)
    generator = torch.Generator().manual_seed(3)
    state = model.rest()
    state.v.normal_(generator=generator)
    state.C.normal_(generator=generator)
    order = torch.randperm(model.particle_count, generator=generator)
    one, other = (
        softmpm.rasterize(model, state),
        softmpm.rasterize(model, softmpm.State(*(t[:, order] for t in state[:4]))),
    )
    assert torch.equal(one.mass, other.mass) and torch.equal(one.velocity, other.velocity)
    want = softmpm.rasterize(softmpm.build(model.scene, device="cpu"), state)
    assert_relative(one.mass, want.mass, 1e-6)
    assert_relative(one.velocity, want.velocity, 1e-5)


def test_the_model_says_how_it_adds():
    """And kernels of other models know nothing of it; on the CPU every scheme and precision may be asked."""
    exact, plain = build(2), build(2, False)
    assert exact.spec.deterministic and "sums       in fixed point: deterministic" in exact.describe()
    assert not plain.spec.deterministic and "in floating point, in one order" in plain.describe()
    for settings in (dict(dtype=torch.float64, scheme="auto"), dict(scheme="plain")):
        model = build(2, **settings)
        assert model.deterministic and not model.spec.deterministic


@pytest.mark.gpu
@pytest.mark.parametrize("dim, count", [(2, (80, 80)), (3, (20, 20, 20))])
def test_two_runs_give_the_same_bits(dim, count):
    """100 substeps forward and backward, with muscles and a rough floor, in models of their own and with other work between."""
    scene = block(dim, count, 0.02)
    found = []
    for _ in range(2):
        model = softmpm.build(scene, device="cuda", deterministic=True, worlds=2)
        generator = torch.Generator().manual_seed(4)
        for _ in range(3):
            generator.manual_seed(4)
            start = softmpm.State(*(t.detach().requires_grad_() for t in model.rest()[:4]))
            activation = torch.rand(5, 2, model.muscle_count, generator=generator).cuda().requires_grad_()
            params = softmpm.Params(*(p.requires_grad_() for p in model.params()))
            end = softmpm.simulate(model, start, activation, params, substeps=20)
            loss = dot(cotangent(end), end)
            inputs = (*start[:4], activation, *params)
            field = softmpm.rasterize(model, end.detach())
            found.append((*end[:4], *torch.autograd.grad(loss, inputs), *field))
            thrown = softmpm.State(
                start.x.detach(), start.v.detach() + 5.0, start.C.detach(), start.F.detach()
            )
            softmpm.simulate(model, thrown, activation.detach(), model.params(), substeps=30)  # another order
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert torch.equal(a, b)
