import pytest
import torch

import softmpm
from softmpm_learn.design import Design
from softmpm_learn.settings import DesignConf


@pytest.mark.parametrize("per, values", [("particle", 32), ("region", 3), ("uniform", 1)])
def test_starts_at_the_scene_with_as_many_values_as_asked(model, task, per, values):
    """The first design is the scene's own materials to rounding; particles outside all regions share a value of their own."""
    design = Design(DesignConf(per=per), model, task.regions)
    for now, start in zip(design(), model.params(), strict=True):
        torch.testing.assert_close(now, start, rtol=1e-6, atol=0)
    assert all(free.shape == (values,) for free in design.free.values()) and len(design.free) == 3
    with torch.no_grad():
        design.free["young"][0] += 1.0
    changed = (design().young != design().young[15]).nonzero().flatten()
    assert len(changed) == {"particle": 1, "region": 28, "uniform": 0}[per] or per == "region"
    if per == "region":  # group 0 is the rest: 12 to 15
        assert changed.tolist() == [k for k in range(32) if not 12 <= k < 16]


def test_stays_between_its_bounds(model, task):
    """However far the free variables go, the values stay in [low, high], and reach both ends."""
    conf = DesignConf(young_factor=[0.5, 3.0], poisson_range=[0.1, 0.45], density_factor=[0.9, 1.1])
    design, start = Design(conf, model, task.regions), model.params()
    bounds = {"young": (10.0, 60.0), "poisson": (0.1, 0.45), "density": (0.9, 1.1)}
    for push, end in ((-50.0, 0), (50.0, 1)):
        with torch.no_grad():
            for free in design.free.values():
                free.fill_(push)
        for name, value in design()._asdict().items():
            torch.testing.assert_close(value, torch.full_like(getattr(start, name), bounds[name][end]))
    change = design.change()
    assert change["young"] == pytest.approx(2.0) and change["density"] == pytest.approx(0.1, rel=1e-5)


def test_switched_off_parts_are_the_scene(model, task):
    """A parameter that is switched off has no variable and no change; with the design off there is nothing to optimise."""
    design = Design(DesignConf(poisson=False, density=False), model, task.regions)
    assert list(design.free) == ["young"] and torch.equal(design().density, model.params().density)
    off = Design(DesignConf(enabled=False), model, task.regions)
    assert not list(off.parameters()) and off.change() == {"young": 0.0, "poisson": 0.0, "density": 0.0}
    assert all(torch.equal(a, b) for a, b in zip(off(), model.params(), strict=True))


def test_gradient_reaches_the_free_variables(model, task):
    """d value / dθ of (D1) is width · s (1 − s)."""
    design = Design(DesignConf(per="uniform"), model, task.regions)
    (gradient,) = torch.autograd.grad(design().young.mean(), design.free["young"])
    torch.testing.assert_close(gradient, torch.tensor([(20 - 14) * (40 - 20) / (40 - 14)]), rtol=1e-5, atol=0)


def test_a_start_outside_the_bounds_is_named(make_block):
    """A scene whose Poisson's ratio is outside the range is told which bound to widen."""
    scene = make_block()
    soft = softmpm.NeoHookean(density=1.0, young=20.0, poisson=0.1)
    scene = make_block(bodies=[softmpm.Body(scene.bodies[0].particles, soft)])
    with pytest.raises(ValueError, match=r"poisson must lie between .* 0\.2 and 0\.4"):
        Design(DesignConf(), softmpm.build(scene, device="cpu"), {})
