"""Remedies of the error messages: each is applied to the case that it was given for, and helps."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from helpers import bar

import softmpm


def material(scene: softmpm.Scene, law=None, **changes) -> softmpm.Scene:
    """The same scene of another material."""
    bodies = []
    for body in scene.bodies:
        numbers = {
            field.name: getattr(body.material, field.name) for field in dataclasses.fields(body.material)
        }
        bodies.append(softmpm.Body(body.particles, (law or type(body.material))(**(numbers | changes))))
    return dataclasses.replace(scene, bodies=bodies)


def pulled(scene: softmpm.Scene, activation: float) -> softmpm.UnstableError | None:
    """The error of a bar whose muscles pull for 0.15 s, at 0.4 of the stable step; None if there is none."""
    scene = dataclasses.replace(scene, dt=0.4 * softmpm.stable_dt(scene, activation=max(1.0, activation)))
    model = softmpm.build(scene, device="cpu")
    rows = torch.full((1, 1, 2), activation)
    try:
        softmpm.simulate(model, model.rest(), rows, model.params(), substeps=int(0.15 / scene.dt))
    except softmpm.UnstableError as error:
        return error
    return None


def test_a_body_that_collapses():
    """A stiffer material, a weaker activation and the barrier law each keep a bar whole."""
    scene = bar("fixed_corotated")
    for activation in (4.0, 8.0):
        error = pulled(scene, activation)
        assert error and error.kind == "collapsed"
        assert "stiffer material, or a weaker activation" in str(error) and "BarrierCorotated resists" in str(
            error
        )
        assert "smaller dt" not in str(error)  # it does not help
        assert pulled(material(scene, young=400.0), activation) is None
        assert pulled(scene, activation / 4) is None
    assert pulled(material(scene, softmpm.BarrierCorotated), 4.0) is None


def test_a_body_that_tears():
    """A stiffer material and a weaker activation each keep a bar whole."""
    error = pulled(bar(), 20.0)
    assert error and error.kind == "torn" and "stiffer material, or a weaker activation" in str(error)
    assert pulled(material(bar(), young=400.0), 20.0) is None
    assert pulled(bar(), 5.0) is None


def test_a_step_that_is_too_large():
    """The dt that the message names, a softer material, a denser one and a weaker activation each pass."""
    scene = bar()
    model = softmpm.build(scene, device="cpu")

    def run(scene=scene, activation=40.0):
        model = softmpm.build(scene, device="cpu")
        rows = torch.full((1, 1, 2), activation)
        softmpm.simulate(model, model.rest(), rows, model.params(), substeps=1)

    with pytest.raises(softmpm.UnstableError) as caught:
        run()
    text = str(caught.value)
    assert "a softer or denser material, or a weaker activation; alarms=softmpm.Alarms(step=None)" in text
    advised = float(re.search(r"dt of at most (\S+) s", text)[1])
    assert 0.1 * scene.dt < advised < scene.dt
    run(dataclasses.replace(scene, dt=advised))
    run(material(scene, density=10.0))
    run(activation=2.0)
    params = model.params()._replace(young=16 * model.params().young)
    with pytest.raises(softmpm.UnstableError, match="a softer"):
        softmpm.simulate(model, model.rest(), None, params, substeps=1)
    softmpm.simulate(model, model.rest(), None, model.params(), substeps=1)
    loose = softmpm.build(scene, device="cpu", alarms=softmpm.Alarms(step=None))
    softmpm.simulate(loose, loose.rest(), None, params, substeps=1)


def test_a_step_that_is_too_large_for_the_viscosity():
    """The dt that the message names and a less viscous material each pass."""

    def run(viscosity: float, dt: float | None = None) -> None:
        scene = bar(muscles=())
        scene = dataclasses.replace(scene, dt=dt or scene.dt)
        model = softmpm.build(scene, device="cpu", inputs=("viscosity",))
        inputs = softmpm.Inputs(viscosity=torch.full((1, 1), viscosity))
        softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, inputs=inputs)

    with pytest.raises(softmpm.UnstableError, match="a softer, denser or less viscous material") as caught:
        run(1.0)
    run(1.0, dt=float(re.search(r"dt of at most (\S+) s", str(caught.value))[1]))
    run(0.1)


def test_a_particle_that_leaves_the_grid():
    """A larger grid, a wall and a start further inside each hold a bar that flies to the right."""
    scene = bar(muscles=())

    def flies(scene: softmpm.Scene, speed=4.0, back=0.0) -> softmpm.UnstableError | None:
        model = softmpm.build(scene, device="cpu")
        start = model.rest()
        start.v[..., 0] = speed
        start.x[..., 0] -= back
        try:
            softmpm.simulate(model, start, None, model.params(), substeps=int(0.065 / scene.dt))
        except softmpm.UnstableError as error:
            return error
        return None

    error = flies(scene)
    assert error and error.kind == "left_grid"
    assert "Make the grid larger, add walls, or start further inside." in str(error)
    assert flies(dataclasses.replace(scene, grid=softmpm.Grid(shape=(49, 33), spacing=1 / 32))) is None
    assert flies(dataclasses.replace(scene, walls=[softmpm.Wall(normal=(-1.0, 0.0), offset=-0.85)])) is None
    assert flies(scene, back=0.15) is None


def test_an_inverted_start():
    """A start with det F above the limit passes."""
    model = softmpm.build(bar(muscles=()), device="cpu")
    start = model.rest()
    start.F[0, 3] = torch.tensor(np.diag([-1.0, 1.0]))
    with pytest.raises(
        softmpm.UnstableError, match="Start from a deformation gradient F that is not inverted"
    ):
        softmpm.simulate(model, start, None, model.params(), substeps=1)
    start.F[0, 3] = torch.tensor(np.diag([0.5, 1.0]))
    softmpm.simulate(model, start, None, model.params(), substeps=1)


@pytest.mark.parametrize("name", ["v", "C", "F"])
def test_a_start_whose_values_are_too_large(name, scheme):
    """Its square is no number of float32: the value is named, not a neighbour that is where it should be. A smaller one passes."""
    model = softmpm.build(bar(muscles=()), device="cpu", scheme=scheme)
    start = model.rest()
    value = getattr(start, name)[0, 3].view(-1)
    value[0], usual = 1e20, float(value[0])
    with pytest.raises(softmpm.UnstableError) as caught:
        softmpm.simulate(model, start, None, model.params(), substeps=1)
    assert f"has a value in {name} that is not finite or too large to square in the start state" in str(
        caught.value
    )
    assert "Start from finite and smaller values." in str(caught.value)
    value[0] = usual + 0.1
    softmpm.simulate(model, start, None, model.params(), substeps=1)
