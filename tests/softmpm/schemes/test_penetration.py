"""The alarm on surface points that are deep inside a wall."""

import pytest
import torch
from surface_scenes import made, slab

import softmpm
from softmpm import Inputs


def jumped(model: softmpm.Model, cells: float) -> Inputs:
    """The floor, in the second of two worlds higher by so many cells."""
    offset = model.scene.walls[0].offset + model.scene.grid.spacing * torch.tensor([0.0, cells]).double()
    return Inputs(wall_offset=offset[None, :, None])


def test_a_wall_that_jumps_into_a_body_is_named():
    """World, wall, point, depth and limit, at the start of a call; below the limit it runs, and so it does without the alarm."""
    model = made(slab(), worlds=2, inputs=("wall_offset",))
    surface, cell = model.surface, model.scene.grid.spacing
    assert surface is not None
    most = model.scene.dt * surface.waves[0].item() / cell
    start = softmpm.simulate(model, model.rest(), None, model.params(), substeps=10)
    assert start.nodes is not None
    for state in (start, start._replace(nodes=None)):
        inputs = jumped(model, 1.0)
        with pytest.raises(softmpm.UnstableError) as caught:
            softmpm.simulate(model, state, None, model.params(), substeps=10, inputs=inputs)
        error = caught.value
        text = str(error)
        assert (error.kind, error.world, error.substep) == ("in_wall", 1, 0)
        assert "cells) inside wall 0 in the start state" in text and "surface point" in text
        assert f"at most {most * cell:.4g} m are allowed" in text
        depth = float(text.split(" m (")[1].split(" cells")[0])
        height = float(text.split("is at (")[1].split(")")[0].split(", ")[1])
        assert depth == pytest.approx((inputs.wall_offset[0, 1, 0].item() - height) / cell, abs=0.01)
        assert most < depth <= 1.01
        place = surface.points[int(text.split("surface point ")[1].split(" ")[0])]
        assert (model.positions[error.particle] - place).norm() < cell
    with pytest.raises(softmpm.UnstableError, match="inside wall 0"):
        softmpm.simulate(model, start, None, model.params(), substeps=1, inputs=jumped(model, 1.05 * most))
    softmpm.simulate(model, start, None, model.params(), substeps=1, inputs=jumped(model, 0.95 * most))
    failures = softmpm.Failures("freeze")
    about = (model, start, None, model.params())
    end = softmpm.simulate(*about, substeps=10, inputs=jumped(model, 1.0), failures=failures)
    alone = softmpm.simulate(*about, substeps=10, inputs=jumped(model, 0.0))
    assert failures.worlds == [1] and torch.equal(end.x[0], alone.x[0]) and torch.equal(end.x[1], start.x[1])
    loose = made(slab(), worlds=2, inputs=("wall_offset",), alarms=softmpm.Alarms(depth=None, collapse=None))
    softmpm.simulate(loose, start, None, loose.params(), substeps=1, inputs=jumped(loose, 1.5 * most))


def test_a_point_that_is_driven_into_a_wall_is_named_while_running():
    """Two walls press a body against each other: the substep and the pose are those of the error."""
    walls = [
        softmpm.Wall(normal=(0.0, 1.0), offset=4.5 / 32),
        softmpm.Wall(normal=(0.0, -1.0), offset=-7.5 / 32),
    ]
    soft = softmpm.FixedCorotated(density=1000.0, young=2e5, poisson=0.3)
    scene = slab(walls=walls, bodies=[softmpm.Body(slab().bodies[0].particles, soft)])
    model = made(scene, inputs=("wall_offset",), alarms=softmpm.Alarms(collapse=None))
    closing = torch.tensor([[[4.5, -7.5]], [[6.5, -5.7]]], dtype=torch.float64) / 32
    about = dict(substeps=100, inputs=Inputs(wall_offset=closing))
    with pytest.raises(softmpm.UnstableError) as caught:
        softmpm.simulate(model, model.rest(), None, model.params(), **about)
    error, text = caught.value, str(caught.value)
    assert error.kind == "in_wall" and error.substep > 0 and error.state is not None
    wall, share = int(text.split("inside wall ")[1].split(" ")[0]), (error.substep + 1) / 100
    offset = ((1 - share) * closing[0, 0, wall] + share * closing[1, 0, wall]).item()
    height = float(text.split("is at (")[1].split(")")[0].split(", ")[1])
    depth = float(text.split(") m, ")[1].split(" m (")[0])
    assert depth == pytest.approx(offset - walls[wall].normal[1] * height, rel=0.05)
