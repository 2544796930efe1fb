"""The Warp way in refuses what the PyTorch way refuses, before a kernel sees it."""

import dataclasses
import re

import numpy as np
import pytest
import torch
import warp as wp
from helpers import busy_scene

import softmpm
from softmpm.errors import MAX_SUBSTEP


@pytest.fixture(scope="module")
def models() -> dict[int, softmpm.Model]:
    """The same scene in one world and in three."""
    return {n: softmpm.build(busy_scene(2, per_law=4), device="cpu", worlds=n) for n in (1, 3)}


@pytest.fixture(scope="module")
def model(models) -> softmpm.Model:
    return models[3]


@pytest.mark.parametrize("place", ["state_in", "state_out", "solid"])
def test_step_takes_states_and_solid_of_its_own_model_only(models, place):
    """Arrays of one world given to a model of three were read and written out of bounds."""
    given = {
        "state_in": softmpm.warp_state(models[3]),
        "state_out": softmpm.warp_state(models[3]),
        "solid": softmpm.warp_solid(models[3]),
    }
    make = softmpm.warp_solid if place == "solid" else softmpm.warp_state
    with pytest.raises(ValueError, match=f"{place} belongs to another model; make one with softmpm.warp_s"):
        softmpm.step(models[3], **(given | {place: make(models[1])}))
    with pytest.raises(TypeError, match=f"{place} must be a softmpm.Warp(State|Solid), .* got State"):
        softmpm.step(models[3], **(given | {place: models[3].rest()}))
    softmpm.step(models[3], **given)


def test_reading_back_takes_the_models_own_states_only(models):
    """torch_state returned whatever lay behind the arrays as a world, and raise_failure read it."""
    solid, other = softmpm.warp_solid(models[3]), softmpm.warp_state(models[1])
    with pytest.raises(ValueError, match="state belongs to another model"):
        softmpm.torch_state(models[3], other)
    with pytest.raises(ValueError, match="state belongs to another model"):
        solid.raise_failure(models[3], other)
    with pytest.raises(ValueError, match="solid belongs to another model"):
        solid.raise_failure(models[1], other)


@pytest.mark.parametrize(
    "call",
    [
        lambda m: softmpm.warp_state(m),
        lambda m: softmpm.warp_solid(m),
        lambda m: softmpm.torch_state(m, None),
        lambda m: softmpm.step(m, None, None, None),
    ],
)
def test_a_scene_is_not_a_model(model, call):
    """Each function names itself and says where a model comes from."""
    with pytest.raises(TypeError, match=r"needs a model, as softmpm.build\(scene\) gives it, got Scene"):
        call(model.scene)


def test_warp_state_checks_the_state(model):
    """Shape, precision, type and finiteness, as simulate does."""
    rest = model.rest()
    for bad, said in (
        (rest._replace(x=rest.x[:, :5]), r"state.x must have shape \(3, 8, 2\)"),
        (rest._replace(v=rest.v.double()), "state.v must be torch.float32"),
        (rest._replace(F=rest.F.numpy()), "state.F must be a torch.Tensor, got ndarray"),
        (rest._replace(C=rest.C + torch.nan), r"state.C must be finite, but state.C\[0, 0, 0, 0\] is nan"),
        (softmpm.warp_state(model), "state must be a softmpm.State, got WarpState"),
    ):
        with pytest.raises((ValueError, TypeError), match=said):
            softmpm.warp_state(model, bad)


@pytest.mark.parametrize(
    "name, bad",
    [("density", torch.nan), ("density", -1e3), ("density", 0), ("young", -1e4), ("poisson", 0.7)],
)
def test_warp_solid_checks_the_material(model, name, bad):
    """A material that cannot exist gave nonsense that looked finite."""
    params = model.params()
    getattr(params, name)[2] = bad
    with pytest.raises(ValueError, match=rf"params.{name} must be .*params.{name}\[2\] is {bad:g}"):
        softmpm.warp_solid(model, params)


def test_warp_solid_checks_shapes_types_and_the_activation(model):
    """Arrays that are too short, of another precision or not finite are refused by name."""
    params = model.params()
    for given, said in (
        ((params._replace(young=params.young[:3]),), "params.young must broadcast"),
        ((params._replace(young=params.young.double()),), "params.young must be torch.float32"),
        ((params._replace(young=params.young.numpy()),), "params.young must be a torch.Tensor, got ndarray"),
        ((None, torch.zeros(1, 2)), r"activation must have shape \(world, muscle\) = \(3, 2\), got \(1, 2\)"),
        ((None, torch.zeros(4, 3, 2)), r"got \(4, 3, 2\); of several control steps take one row"),
        ((None, torch.zeros(3, 2, dtype=torch.float64)), "activation must be torch.float32"),
        ((None, np.zeros((3, 2), np.float32)), "activation must be a torch.Tensor, got ndarray"),
        ((None, torch.full((3, 2), torch.inf)), r"activation must be finite, but activation\[0, 0\] is inf"),
    ):
        with pytest.raises((ValueError, TypeError), match=said):
            softmpm.warp_solid(model, *given)


def test_arrays_cannot_be_replaced_by_others(models, model):
    """They are fixed once made; a state made by hand is checked array by array."""
    state, solid = softmpm.warp_state(model), softmpm.warp_solid(model)
    for owner, name in ((state, "v"), (solid, "mass")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(owner, name, getattr(owner, name))
    short = softmpm.warp_state(models[1])
    with pytest.raises(ValueError, match=re.escape("v must be (3, 8, 2) of float32 on cpu, got (1, 8, 2)")):
        dataclasses.replace(state, v=short.v)
    with pytest.raises(
        ValueError, match=re.escape("C must be (3, 8, 2, 2) of float32 on cpu, got (3, 8, 2)")
    ):
        dataclasses.replace(state, C=state.v)
    with pytest.raises(TypeError, match="fx_low must be a warp.array, got NoneType"):
        dataclasses.replace(state, fx_low=None)
    with pytest.raises(ValueError, match="mass must be"):
        dataclasses.replace(solid, mass=wp.zeros((3, 7), dtype=float, device="cpu"))


def test_states_that_share_arrays_are_the_same(model):
    """Reading and writing the same memory depends on the order of the particles."""
    state = softmpm.warp_state(model)
    with pytest.raises(ValueError, match="two different states, each with arrays of its own"):
        softmpm.step(model, state, dataclasses.replace(state), softmpm.warp_solid(model))


@pytest.mark.parametrize("substep", [-1, MAX_SUBSTEP + 1, 1.5, True])
def test_the_number_of_a_step(model, substep):
    """It has to fit into the word that a failure is reported in."""
    states = softmpm.warp_state(model), softmpm.warp_state(model)
    with pytest.raises(ValueError, match="substep must be a whole number from 0 to 134,217,727, got"):
        softmpm.step(model, *states, softmpm.warp_solid(model), substep=substep)
