import dataclasses
import math

import numpy as np
import pytest
import torch

import softmpm
from softmpm_learn.design import DESIGNABLE, Design, declared_inputs
from softmpm_learn.settings import DesignConf

EVERY = dict(strength=True, viscosity=True)
"""Switches of what is off by default."""


@pytest.fixture(scope="module")
def viscous(make_block) -> softmpm.Model:
    """The block with some viscosity, a muscle of strength 5 and a pressure of -2."""
    scene = make_block()
    material = softmpm.NeoHookean(density=1.0, young=20.0, poisson=0.3, viscosity=0.1)
    muscles = [
        softmpm.Muscle(particles=np.arange(16), direction=(1.0, 0.0), strength=5.0),
        softmpm.Pressure(particles=np.arange(16, 32), strength=-2.0),
    ]
    bodies = [softmpm.Body(scene.bodies[0].particles, material)]
    scene = make_block(bodies=bodies, muscles=muscles, dt=1e-3)
    return softmpm.build(scene, device="cpu", inputs=declared_inputs(DesignConf(**EVERY)))


@pytest.mark.parametrize("per, values", [("particle", 32), ("region", 3), ("uniform", 1)])
def test_starts_at_the_scene_with_as_many_values_as_asked(model, task, per, values):
    """The first design is the scene's own materials to rounding; particles outside all regions share a value of their own."""
    design = Design(DesignConf(per=per), model, task.regions)
    params, inputs = design()
    assert inputs == softmpm.Inputs()
    for now, start in zip(params, model.params(), strict=True):
        torch.testing.assert_close(now, start, rtol=1e-6, atol=0)
    assert all(free.shape == (values,) for free in design.free.values()) and len(design.free) == 3
    with torch.no_grad():
        design.free["young"][0] += 1.0
    young = design()[0].young
    changed = (young != young[15]).nonzero().flatten()
    assert len(changed) == {"particle": 1, "region": 28, "uniform": 0}[per] or per == "region"
    if per == "region":  # group 0 is the rest: 12 to 15
        assert changed.tolist() == [k for k in range(32) if not 12 <= k < 16]


@pytest.mark.parametrize("per", ["particle", "region", "uniform"])
def test_stiff_parts_remain_stiff(make_block, task, per):
    """Each particle starts at its own value and stays between its own bounds; those with one variable change by one factor. What has
    bounds of its own must be the same where there is one variable."""
    scene = make_block()
    particles = scene.bodies[0].particles
    halves = [
        softmpm.Particles(particles.positions[part], 0.05**2) for part in (slice(None, 20), slice(20, None))
    ]
    laws = [softmpm.NeoHookean(density=1.0, young=young, poisson=0.3) for young in (20.0, 200.0)]
    bodies = [softmpm.Body(half, law) for half, law in zip(halves, laws, strict=True)]
    model = softmpm.build(make_block(bodies=bodies), device="cpu")
    design, start = Design(DesignConf(per=per), model, task.regions), model.params()
    for now, was in zip(design()[0], start, strict=True):
        torch.testing.assert_close(now, was, rtol=1e-6, atol=0)
    with torch.no_grad():
        design.free["young"].fill_(50.0)
    torch.testing.assert_close(design()[0].young, 2.0 * start.young)
    laws[1] = softmpm.NeoHookean(density=1.0, young=20.0, poisson=0.25)
    bodies = [softmpm.Body(half, law) for half, law in zip(halves, laws, strict=True)]
    model = softmpm.build(make_block(bodies=bodies), device="cpu")
    if per == "particle":
        Design(DesignConf(per=per), model, task.regions)
        return
    with pytest.raises(ValueError, match="the scene's poisson must be the same .* design.per=particle"):
        Design(DesignConf(per=per), model, task.regions)


def test_stays_between_its_bounds(model, task):
    """However far the free variables go, the values stay in [low, high], and reach both ends."""
    conf = DesignConf(young_factor=[0.5, 3.0], poisson_range=[0.1, 0.45], density_factor=[0.9, 1.1])
    design, start = Design(conf, model, task.regions), model.params()
    bounds = {"young": (10.0, 60.0), "poisson": (0.1, 0.45), "density": (0.9, 1.1)}
    for push, end in ((-50.0, 0), (50.0, 1)):
        with torch.no_grad():
            for free in design.free.values():
                free.fill_(push)
        for name, value in design()[0]._asdict().items():
            torch.testing.assert_close(value, torch.full_like(getattr(start, name), bounds[name][end]))
    change = design.change()
    assert change["young"] == pytest.approx(2.0) and change["density"] == pytest.approx(0.1, rel=1e-5)


def test_a_poisson_ratio_that_starts_at_zero(make_block, task):
    """It has no relative change: that of the others is reported, and nan where there is none."""
    body, other = make_block().bodies[0], np.array([[0.35, 0.45], [0.4, 0.45]])
    soft = dataclasses.replace(body, material=dataclasses.replace(body.material, poisson=0.0))
    rest = dataclasses.replace(body, particles=softmpm.Particles(other, 0.05**2))
    for bodies, want in (([soft], math.nan), ([soft, rest], 2 / 3)):
        model = softmpm.build(make_block(bodies=bodies), device="cpu")
        design = Design(DesignConf(poisson_range=[-0.2, 0.4]), model, {})
        with torch.no_grad():
            design.free["poisson"].fill_(0.0)  # in the middle of the bounds: 0.1
        assert design.change()["poisson"].item() == pytest.approx(want, nan_ok=True)


def test_switched_off_parts_are_the_scene(model, task):
    """A parameter that is switched off has no variable and no change; with the design off there is nothing to optimise."""
    design = Design(DesignConf(poisson=False, density=False), model, task.regions)
    assert list(design.free) == ["young"] and torch.equal(design()[0].density, model.params().density)
    off = Design(DesignConf(enabled=False), model, task.regions)
    assert not list(off.parameters()) and off.change() == {"young": 0.0, "poisson": 0.0, "density": 0.0}
    assert all(torch.equal(a, b) for a, b in zip(off()[0], model.params(), strict=True))
    assert off()[1] == softmpm.Inputs()


def test_gradient_reaches_the_free_variables(model, task):
    """d value / dθ of (D1) is width · s (1 − s)."""
    design = Design(DesignConf(per="uniform"), model, task.regions)
    (gradient,) = torch.autograd.grad(design()[0].young.mean(), design.free["young"])
    torch.testing.assert_close(gradient, torch.tensor([(20 - 14) * (40 - 20) / (40 - 14)]), rtol=1e-5, atol=0)


def test_a_start_outside_the_bounds_is_named(make_block):
    """A scene whose Poisson's ratio is outside the range is told which bound to widen."""
    scene = make_block()
    soft = softmpm.NeoHookean(density=1.0, young=20.0, poisson=0.1)
    scene = make_block(bodies=[softmpm.Body(scene.bodies[0].particles, soft)])
    with pytest.raises(ValueError, match=r"poisson must lie between .* 0\.2 and 0\.4"):
        Design(DesignConf(), softmpm.build(scene, device="cpu"), {})


def test_every_scalar_of_the_table_can_be_designed():
    """Each quantity of a particle or a muscle has a switch and bounds in the settings; those of ``Inputs`` are off by default."""
    for name in DESIGNABLE:
        bounds = [hasattr(DesignConf(), f"{name}_{kind}") for kind in ("factor", "range")]
        assert getattr(DesignConf(), name) is (name in softmpm.Params._fields) and sum(bounds) == 1, name
    assert DESIGNABLE["viscosity"] == "particle" and DESIGNABLE["strength"] == "muscle"
    assert not {"force", "direction", "gravity", "velocity", "friction"} & set(DESIGNABLE)


def test_declared_inputs_are_those_that_are_designed():
    """By default there are none; a design that is off declares none either."""
    assert declared_inputs(DesignConf()) == ()
    assert declared_inputs(DesignConf(**EVERY)) == ("strength", "viscosity")
    assert declared_inputs(DesignConf(enabled=False, **EVERY)) == ()


@pytest.mark.parametrize("per, values", [("particle", 32), ("region", 3), ("uniform", 1)])
def test_inputs_start_at_the_scene(viscous, task, per, values):
    """Viscosity has as many values as the material has, strength one for each muscle, whatever ``per`` is."""
    design = Design(DesignConf(per=per, **EVERY), viscous, task.regions)
    params, inputs = design()
    assert design.free["viscosity"].shape == (values,) and design.free["strength"].shape == (2,)
    torch.testing.assert_close(inputs.viscosity, torch.full((32,), 0.1))
    torch.testing.assert_close(inputs.strength, torch.tensor([5.0, -2.0]))
    torch.testing.assert_close(params.young, torch.full((32,), 20.0))
    rest = inputs._replace(viscosity=None, strength=None)
    assert rest == softmpm.Inputs()


def test_inputs_stay_between_their_bounds(viscous, task):
    """However far the free variables go, and of a negative strength too; ``change`` reports how far they went."""
    conf = DesignConf(strength_factor=[0.5, 1.2], viscosity_factor=[0.1, 3.0], **EVERY)
    design = Design(conf, viscous, task.regions)
    assert list(design.change()) == ["young", "poisson", "density", "strength", "viscosity"]
    assert max(design.change().values()) < 1e-6
    ends = {-50.0: (0.01, [2.5, -2.4]), 50.0: (0.3, [6.0, -1.0])}
    for push, (viscosity, strength) in ends.items():
        with torch.no_grad():
            for free in design.free.values():
                free.fill_(push)
        _, inputs = design()
        torch.testing.assert_close(inputs.viscosity, torch.full((32,), viscosity))
        torch.testing.assert_close(inputs.strength, torch.tensor(strength))
    change = design.change()
    assert change["viscosity"] == pytest.approx(2.0) and change["strength"] == pytest.approx((0.2 + 0.5) / 2)


def test_simulations_answer_to_every_variable(viscous, task):
    """The gradient of the robot's shape with respect to each variable is finite and not zero."""
    design = Design(DesignConf(per="uniform", **EVERY), viscous, task.regions)
    params, inputs = design()
    activation = torch.ones(2, 1, 2)
    end = softmpm.simulate(viscous, viscous.rest(), activation, params, substeps=20, inputs=inputs)
    loss = (end.x - viscous.positions).square().sum()
    for name, gradient in zip(
        design.free, torch.autograd.grad(loss, list(design.free.values())), strict=True
    ):
        assert gradient.isfinite().all() and gradient.ne(0).all(), name


def test_what_is_absent_cannot_be_designed(model, make_block):
    """Bounds in units of nothing, and the strength of no muscle: the message says what to change."""
    with pytest.raises(
        ValueError, match=r"viscosity is 0 nowhere.*set task\.viscosity or switch design\.viscosity off"
    ):
        Design(DesignConf(viscosity=True), model, {})
    limp = softmpm.build(make_block(muscles=[]), device="cpu")
    with pytest.raises(ValueError, match=r"design\.strength needs a scene with muscles"):
        Design(DesignConf(strength=True), limp, {})
