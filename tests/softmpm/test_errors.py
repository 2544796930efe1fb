"""A failing simulation says where, when and why, on every device, and loses nothing."""

import itertools

import numpy as np
import pytest
import torch
from helpers import LAWS, assert_relative, busy_inputs, busy_scene, run

import softmpm
from softmpm import autograd


def single(law="neo_hookean", device="cpu", worlds=1, dtype=torch.float32, alarms=None, **scene):
    particles = softmpm.Particles(np.array([[0.5, 0.5], [0.7, 0.55], [0.52, 0.73]]), 0.01)
    body = softmpm.Body(particles, LAWS[law](density=1.0, young=10.0, poisson=0.3))
    settings = dict(grid=softmpm.Grid(shape=(12, 12), spacing=0.1), bodies=[body], dt=1e-3)
    scene = softmpm.Scene(**(settings | scene))
    return softmpm.build(scene, device=device, dtype=dtype, worlds=worlds, alarms=alarms)


def fails(model, start, **kwargs) -> softmpm.UnstableError:
    with pytest.raises(softmpm.UnstableError) as caught:
        softmpm.simulate(model, start, None, model.params(), **({"substeps": 10} | kwargs))
    return caught.value


def test_leaving_the_grid_names_particle_world_and_substep(device):
    """Particle 1 of world 2 flies out after 3 substeps; the others are where they would be without it."""
    model = single(device=device, worlds=3)
    start = model.rest()
    start.v[2, 1, 0] = 100.0  # 0.1 m a substep, from 0.7 m; the grid ends at 1.05 m
    error = fails(model, start)
    assert (error.kind, error.world, error.particle, error.substep) == ("left_grid", 2, 1, 3)
    assert (
        "particle 1 (body 0) of world 2" in str(error)
        and "off the grid" in str(error)
        and "1.05" in str(error)
    )
    reset_status = softmpm.simulate(model, model.rest(), None, model.params(), substeps=10)
    for name in "xvCF":
        assert torch.equal(getattr(error.state, name)[:2], getattr(reset_status, name)[:2]), name


def test_a_start_that_is_inverted_is_named(device):
    """Not a value that is not finite, which is what it leads to; a fixed corotated body may start like that if it is told to."""
    model = single(device=device, worlds=2)
    start = model.rest()
    start.F[1, 2] = -start.F[1, 2].flip(-1)
    error = fails(model, start)
    assert (error.kind, error.world, error.particle, error.substep) == ("start", 1, 2, 0)
    assert "det F = -1 in the start state" in str(error) and "not inverted" in str(error)
    reset_status = softmpm.simulate(model, model.rest(), None, model.params(), substeps=10)
    assert_relative(error.state.x[0], reset_status.x[0], 1e-6)  # the other world went on to the end
    model = single("fixed_corotated", device, alarms=softmpm.Alarms(collapse=None))
    start = model.rest()
    start.F[0, 2] = -start.F[0, 2].flip(-1)
    softmpm.simulate(model, start, None, model.params(), substeps=1)


def test_advice_depends_on_how_far_a_particle_left_the_grid(device):
    """A step beyond the edge asks for more room; one that jumps over many cells was thrown there, and needs a smaller step."""
    for speed, advice in ((100.0, "Make the grid larger"), (10_000.0, "It was thrown out. Use a smaller dt")):
        model = single(device=device)
        start = model.rest()
        start.v[0, 1, 0] = speed
        assert advice in str(fails(model, start))


def test_inversion_is_an_error_in_every_law(device):
    """A particle must keep det F > 0; laws that survive inversion let it pass if the alarm is off, the others do not."""
    for law, alarm in itertools.product(LAWS, (0.05, None)):
        model = single(law, device, alarms=softmpm.Alarms(collapse=alarm))
        start = model.rest()
        start.C[0, 2] = torch.tensor([[-1500.0, 0.0], [0.0, 0.0]])
        start.v[0, :, 0] = -1500.0 * (start.x[0, :, 0] - start.x[0, 2, 0])
        start.v[0, :2] = 0
        if LAWS[law].survives_inversion and alarm is None:
            softmpm.simulate(model, start, None, model.params(), substeps=1)
            continue
        error = fails(model, start, substeps=1)
        assert (error.kind, error.particle, error.substep) == ("inverted", 2, 0)
        assert "det F = -" in str(error)


def test_a_value_that_is_not_finite_is_reported_where_it_arises(device):
    """Stress overflows in float32: the particle is named, with what is not finite."""
    model = single(device=device, alarms=softmpm.Alarms(step=None))
    start = model.rest()
    start.F[0, 0] *= 1e18
    error = fails(model, start)
    assert (error.kind, error.particle, error.substep) == ("not_finite", 0, 0)
    assert "not finite" in str(error)


def test_a_start_off_the_grid_is_refused_before_anything_is_written(device):
    """No stencil node may lie outside: the first kernel refuses, names the particle and gives the limits."""
    model = single(device=device)
    for corner in ((0.04, 0.5), (0.5, 1.06), (-3.0, 0.5), (1e9, 0.5)):
        start = model.rest()
        start.x[0, 1] = torch.tensor(corner)
        error = fails(model, start)
        assert (error.kind, error.particle) == ("start", 1) and "in the start state" in str(error)


def test_a_gradient_that_is_not_finite_is_an_error(device):
    """An infinite cotangent of one particle raises in the backward pass, names the substep and says that it came in."""
    model = single(device=device)
    start = model.rest()
    start.v.requires_grad_()
    end = softmpm.simulate(model, start, None, model.params(), substeps=4)
    weight = torch.zeros_like(end.x)
    weight[0, 1] = 3e38
    with pytest.raises(softmpm.UnstableError) as caught:
        (end.x * weight * 10).sum().backward()
    assert (caught.value.kind, caught.value.world, caught.value.substep) == ("gradient", 0, 3)
    assert "look at the loss" in str(caught.value)


def test_errors_have_the_notes_of_their_call():
    """Of the blocks around it, the inner one first; in the backward pass of the call too, wherever that is made."""
    model = single()
    state, ends = model.rest(), []
    state.v.requires_grad_()
    with softmpm.noted("Outer."):
        for k in range(3):
            with softmpm.noted(f"Call {k}."):
                state = softmpm.simulate(model, state, None, model.params(), substeps=4)
                ends.append((state.x, softmpm.rasterize(model, state).velocity))
    for k, seen in itertools.product((1, 2), (0, 1)):
        with pytest.raises(softmpm.UnstableError) as caught, softmpm.noted("Elsewhere."):
            (ends[k][seen].sum() * 3e38 * 10).backward(retain_graph=True)
        assert caught.value.__notes__ == [f"Call {k}. Outer."]
    start = model.rest()
    start.v.fill_(1e30)
    with pytest.raises(softmpm.UnstableError) as caught, softmpm.noted("Elsewhere."):
        softmpm.simulate(model, start, None, model.params(), substeps=4)
    assert caught.value.__notes__ == ["Elsewhere."]
    with softmpm.noted("Outer."):
        made = softmpm.noted("Made before.")
    with pytest.raises(softmpm.UnstableError) as caught, softmpm.noted("Around."), made:
        softmpm.simulate(model, start, None, model.params(), substeps=4)
    assert caught.value.__notes__ == ["Made before. Around."]
    with pytest.raises(softmpm.UnstableError) as caught:
        softmpm.simulate(model, start, None, model.params(), substeps=4)
    assert not hasattr(caught.value, "__notes__")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bad_numbers_are_refused_before_any_launch(dtype, scheme, device, monkeypatch):
    """NaN and infinity in every input, with its name and index."""
    monkeypatch.setattr(autograd, "rollout", lambda *_, **__: pytest.fail("it was launched"))
    model = softmpm.build(busy_scene(2), device=device, dtype=dtype, scheme=scheme)
    for name in ("x", "v", "C", "F", "activation", "young", "poisson", "density"):
        for bad in (float("nan"), float("inf")):
            inputs = {k: t.detach().clone() for k, t in busy_inputs(model).items()}
            inputs[name].view(-1)[3] = bad
            with pytest.raises(ValueError, match=rf"{name}\b.*finite|{name} must be in"):
                run(softmpm.simulate, model, inputs, 1)


def test_failures_of_another_type_are_refused():
    """At once: the name of a policy would be taken until the first failure."""
    model = single()
    for wrong in ("freeze", [], softmpm.Failures):
        with pytest.raises(
            TypeError, match=r"failures must be a softmpm.Failures or None, got .*\('freeze'\) makes one"
        ):
            softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, failures=wrong)  # pyright: ignore


def test_a_bad_activation_is_refused_at_whatever_control_step(scheme, device):
    """In the last row, in one muscle of one world of a deterministic model."""
    deterministic = scheme == "fast"
    model = softmpm.build(busy_scene(2), device=device, worlds=2, scheme=scheme, deterministic=deterministic)
    inputs = {k: t.detach().clone() for k, t in busy_inputs(model, control_steps=3).items()}
    inputs["activation"][2, 1, 0] = float("nan")
    with pytest.raises(ValueError, match=r"activation must be finite, but activation\[2, 1, 0\] is nan"):
        run(softmpm.simulate, model, inputs, 2)


def test_a_world_that_fails_leaves_the_others_alone(device):
    """Eight worlds, the third one poisoned: the other seven end as they do without it, on the CPU to the last bit.

    On a GPU all of them are in two warps, where the particles of others come after those that have stopped.
    """
    model = single(worlds=8, device=device)
    start = model.rest()
    start.v.add_(torch.linspace(-0.5, 0.5, 8, device=device)[:, None, None])
    start.v[:, 1].neg_()  # all at one velocity would leave nothing in C but rounding errors
    alone = softmpm.simulate(model, start, None, model.params(), substeps=30)
    start.v[3, 0] = torch.tensor([500.0, 0.0], device=device)
    error = fails(model, start, substeps=30)
    others = [0, 1, 2, 4, 5, 6, 7]
    assert error.world == 3
    for name in "xvCF":
        got, want = getattr(error.state, name)[others], getattr(alone, name)[others]
        if device == "cpu":
            assert torch.equal(got, want), name
        else:
            assert_relative(got, want, 1e-5, name)
