"""Every rule of a whole scene and of the tensors that meet a model, and what its message says."""

import dataclasses
import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from softmpm import checks
from softmpm.checks import (
    BOUNDS,
    check_activation,
    check_bounds,
    check_finite,
    check_params,
    check_scene,
    check_state,
    check_whole,
)
from softmpm.scene import Body, Grid, Muscle, NeoHookean, Particles, Scene, Wall
from softmpm.shapes import box
from softmpm.state import Low, Params, State

SOFT = NeoHookean(density=1.0, young=10.0)
DX = 0.125  # a power of two, so that places between nodes are exact


def body(*positions) -> Body:
    return Body(Particles(np.array(positions, dtype=float), 0.01), SOFT)


def scene(*bodies, **changes) -> Scene:
    settings = dict(grid=Grid(shape=(9, 11), spacing=DX), bodies=bodies or [body((0.5, 0.5))], dt=1e-3)
    return Scene(**(settings | changes))


def refused(made: Scene, *words: str):
    """check_scene refuses, with these words in this order."""
    with pytest.raises(ValueError, match=".*".join(re.escape(word) for word in words)):
        check_scene(made)


def test_particles_keep_three_nodes():
    """A particle may be wherever ⌊x/dx − 0.5⌋ and the two nodes after it exist, and nowhere else."""
    inside = np.array([(0.5, 0.5), (7.5 - 1e-9, 9.5 - 1e-9), (0.5, 9.4), (7.4, 0.5)]) * DX
    check_scene(scene(body(*inside)))
    for outside in [(0.5 - 1e-9, 5), (5, 0.5 - 1e-9), (7.5, 5), (5, 9.5), (-3, 5), (5, 100)]:
        refused(scene(body((0.5, 0.5), np.multiply(outside, DX))), "body 0 leaves the grid: particle 1 at (")


def test_message_of_a_body_outside():
    """The message names the body, the first particle, how many more there are, and the room there is."""
    far = body((0.5, 0.5), (2.0, 0.5), (0.5, 0.25), (3.0, 0.5))
    refused(
        scene(body((0.25, 0.25)), far),
        "body 1 leaves the grid: particle 1 at (2, 0.5) m, and 1 more of its 4;",
        "[0.0625, 0.9375) × [0.0625, 1.1875) m",
        "Move the body or enlarge the grid.",
    )


def test_dimensions_agree():
    """Particles, fibres and walls have as many axes as the grid."""
    refused(scene(body((0.5, 0.5, 0.5))), "body 0 has 3D particles, but the grid (9, 11) has 2 axes")
    muscle = Muscle(particles=[0], direction=(0, 1, 0), strength=1.0)
    refused(scene(muscles=[muscle]), "muscle 0 direction needs 2 numbers", "got (0, 1, 0)")
    refused(scene(walls=[Wall(normal=(0, 1, 0), offset=0)]), "wall 0 normal needs 2 numbers", "got (0, 1, 0)")


def test_muscles_name_particles_of_the_scene():
    """A muscle's indices run through the bodies in their order, from 0 to the last."""
    bodies = [body((0.5, 0.5), (0.6, 0.5)), body((0.5, 0.7))]

    def muscle(*index):
        return Muscle(particles=index, direction=(0, 1), strength=1.0)

    check_scene(scene(*bodies, muscles=[muscle(0, 1, 2), muscle(2)]))
    refused(
        scene(*bodies, muscles=[muscle(0), muscle(1, 3)]),
        "muscle 1 names particle 3",
        "3 particles are 0 to 2",
    )
    refused(scene(*bodies, muscles=[muscle(0, -1)]), "muscle 0 names particle -1")


@pytest.mark.parametrize("grid_spacing", [0.1, 1 / 7, 1 / 64])
def test_no_particle_twice(grid_spacing):
    """Two bodies may touch, not overlap: every particle that is there twice is found."""
    step = grid_spacing / 2
    room = Grid(shape=(64, 64), spacing=grid_spacing)
    left = box((4 * step, 4 * step), (10 * step, 10 * step), step)
    for shift in (3, 5):  # moved by whole spacings, written in another way
        corner, far = (4 + shift) * step, (10 + shift) * step
        right = box((corner, 4 * step), (far, 10 * step), step)
        both, more = scene(Body(left, SOFT), Body(right, SOFT), grid=room), 6 * (6 - shift) - 1
        refused(both, "(body 0) and", "(body 1) are at the same place", f"{more} more", "must not overlap")
    touching = box((10 * step, 4 * step), (16 * step, 10 * step), step)
    check_scene(scene(Body(left, SOFT), Body(touching, SOFT), grid=room))


@pytest.mark.parametrize("sign", [-1, 1])
def test_rounding_hides_no_copy(sign):
    """A copy that differs in its last digits is a copy, also at a multiple of the tolerance."""
    copy = np.array((0.25, 0.5)) * (1 + sign * 1e-15)
    refused(scene(body((0.25, 0.5)), body(copy)), "at the same place")
    check_scene(scene(body((0.25, 0.5)), body(copy + 1e-5 * DX)))


def test_numbers_that_agree_by_chance_are_no_particle_twice(monkeypatch):
    """What the rows are told apart by first need not tell them apart."""
    monkeypatch.setattr(checks, "MIXERS", (0, 1, 0))
    one, other = body((0.25, 0.5)), body((0.75, 0.5))
    check_scene(scene(one, other))
    refused(scene(one, other, body((0.75, 0.5))), "at the same place")


def test_message_of_a_particle_twice():
    """The message names both particles by the model's index, their place, and how many more pairs."""
    overlap = scene(body((0.5, 0.5), (0.25, 0.5)), body((0.75, 0.5), (0.25, 0.5), (0.5, 0.5)))
    refused(overlap, "particles 1 (body 0) and 3 (body 1)", "(0.25, 0.5) m, and 1 more such pairs")
    refused(scene(body((0.5, 0.5), (0.5, 0.5))), "particles 0 (body 0) and 1 (body 0)", "0 more")


def test_walls_cover_some_nodes_not_all():
    """A wall that no node feels, or that leaves no node free, is a slip of sign or place."""
    for wall in [
        Wall(normal=(0, 1), offset=0.0),
        Wall(normal=(-1, 0), offset=-1.0),
        Wall(normal=(1, 1), offset=0.01),
        Wall(normal=(0, 1), offset=1.2),
    ]:
        check_scene(scene(walls=[wall]))
    good = Wall(normal=(0, 1), offset=0.1)
    refused(scene(walls=[good, Wall(normal=(0, 1), offset=-0.01)]), "wall 1 covers no node", "0 to 1.25 m")
    refused(scene(walls=[Wall(normal=(-1, 0), offset=-1.01)]), "wall 0 covers no node", "-1 to 0 m")
    refused(scene(walls=[Wall(normal=(0, -1), offset=0.1)]), "wall 0 covers every node", "out of the wall")
    refused(scene(walls=[Wall(normal=(1, 0), offset=1.0)]), "wall 0 covers every node")


def test_walls_can_be_counted():
    wall = Wall(normal=(0, 1), offset=0.1)
    check_scene(scene(walls=64 * [wall]))
    refused(scene(walls=65 * [wall]), "at most 64 walls", "got 65")


def test_acceptable_scene_in_space():
    """A 3D scene that keeps every rule passes."""
    muscle = Muscle(particles=np.arange(8), direction=(0, 1, 0), strength=1.0)
    made = scene(
        Body(box((0.5,) * 3, (0.625,) * 3, DX / 2), SOFT),
        grid=Grid(shape=(9, 9, 9), spacing=DX),
        muscles=[muscle],
        walls=[Wall(normal=(0, 1, 0), offset=0.25)],
    )
    check_scene(made)
    check_scene(dataclasses.replace(made, muscles=(), walls=()))


MODEL = SimpleNamespace(
    dim=2, worlds=2, particle_count=3, muscle_count=4, dtype=torch.float32, device=torch.device("cpu")
)


def state(**changes) -> State:
    lead = (2, 3)
    eye = torch.eye(2).expand(*lead, 2, 2).clone()
    return State(torch.ones(*lead, 2), torch.zeros(*lead, 2), torch.zeros(*lead, 2, 2), eye)._replace(
        **changes
    )


def params(**changes) -> Params:
    return Params(torch.full((3,), 10.0), torch.full((2, 1), 0.3), torch.ones(()))._replace(**changes)


def test_good_tensors_pass():
    """Everything of the model's shape, precision and device passes, and all broadcasts of a material."""
    check_state(MODEL, state())
    check_activation(MODEL, None)
    for control_steps in (1, 5):
        check_activation(MODEL, torch.zeros(control_steps, 2, 4))
    for shape in [(), (1,), (3,), (1, 3), (2, 1), (2, 3), (1, 1)]:
        check_params(MODEL, params(young=torch.ones(shape)))
    check_whole("substeps", 1)
    check_whole("substeps", np.int64(20))
    check_bounds(params())
    check_finite(state(), torch.zeros(1, 2, 4))
    check_finite(state(), None)
    check_state(MODEL, state(low=Low(state().v, state().C)))


@pytest.mark.parametrize("name", ["x", "v", "C", "F"])
def test_state_shape(name):
    """Each field's message says the shape that it must have and the one that came."""
    good = getattr(state(), name)
    want = re.escape(f"state.{name} must have shape {tuple(good.shape)}")
    for bad in (good[0], good[:1], good[:, :2], good[..., :1]):
        with pytest.raises(ValueError, match=want + ".*" + re.escape(f"got {tuple(bad.shape)}")):
            check_state(MODEL, state(**{name: bad}))


def test_low_order_parts():
    """The kernels read them as they read x and F: another shape or precision is refused."""
    good = Low(state().v, state().C)
    for bad in (good._replace(x=good.x[:1]), good._replace(F=good.F[..., :1])):
        with pytest.raises(ValueError, match=r"state.low.(x|F) must have shape"):
            check_state(MODEL, state(low=bad))
    with pytest.raises(ValueError, match=r"state.low.F must be torch.float32"):
        check_state(MODEL, state(low=good._replace(F=good.F.double())))


def test_activation_shape():
    """Rows, worlds and muscles are told apart; no row at all is refused."""
    for bad in (torch.zeros(2, 4), torch.zeros(5, 4, 2), torch.zeros(5, 2, 3), torch.zeros(5, 1, 4)):
        with pytest.raises(ValueError, match=r"\(any, 2, 4\), got .*activation\[None\]"):
            check_activation(MODEL, bad)
    with pytest.raises(ValueError, match="at least one control step"):
        check_activation(MODEL, torch.zeros(0, 2, 4))
    with pytest.raises(ValueError, match=r"\(any, 1, 4\), got \(5, 4\); one world is activation\[:, None\]"):
        check_activation(SimpleNamespace(**vars(MODEL) | {"worlds": 1}), torch.zeros(5, 4))


@pytest.mark.parametrize("shape", [(2,), (3, 2), (3, 1), (1, 2, 3), (4,), (0,)])
def test_params_shape(shape):
    """A material that does not broadcast to (world, particle) is refused; it says how to give one a world."""
    with pytest.raises(ValueError, match=r"params.poisson must broadcast to .* \(2, 3\).*\(world, 1\)"):
        check_params(MODEL, params(poisson=torch.ones(shape)))


CHECKS = {
    "state.C": lambda change: check_state(MODEL, state(C=change(state().C))),
    "activation": lambda change: check_activation(MODEL, change(torch.zeros(1, 2, 4))),
    "params.density": lambda change: check_params(MODEL, params(density=change(params().density))),
}


@pytest.mark.parametrize("name", CHECKS)
def test_kind_precision_and_device(name):
    """A tensor of another precision or device, or no tensor, is refused by its name with the cure."""
    with pytest.raises(
        ValueError, match=f"{name} must be torch.float32 like the model, got torch.float64; use .to"
    ):
        CHECKS[name](lambda tensor: tensor.double())
    with pytest.raises(ValueError, match=f"{name} must be on cpu like the model, got meta; use .to"):
        CHECKS[name](lambda tensor: tensor.to("meta"))
    with pytest.raises(TypeError, match=f"{name} must be a torch.Tensor, got ndarray"):
        CHECKS[name](lambda tensor: tensor.numpy())


def test_wrong_records():
    """What is not a State or Params is named."""
    with pytest.raises(TypeError, match="state must be a softmpm.State, got Params"):
        check_state(MODEL, params())
    with pytest.raises(TypeError, match="params must be a softmpm.Params, got State"):
        check_params(MODEL, state())


@pytest.mark.parametrize("substeps", [0, -1, 2.0, True, None, "3"])
def test_substeps(substeps):
    """Substeps are a whole number of at least one."""
    with pytest.raises(ValueError, match="substeps must be a whole number of at least 1, got"):
        check_whole("substeps", substeps)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", ["x", "v", "C", "F", "activation", "young", "poisson", "density"])
def test_not_finite(name, bad):
    """One bad number anywhere is found and named by its index."""
    start, activation, material = state(), torch.zeros(1, 2, 4), Params(*(p.clone() for p in params()))
    tensor = (start._asdict() | {"activation": activation} | material._asdict())[name]
    tensor.view(-1)[-1] = bad
    index = ", ".join(str(n - 1) for n in tensor.shape)
    check = partial(check_bounds, material)
    if name not in BOUNDS:
        check = partial(check_finite, start, activation)
    with pytest.raises(
        ValueError, match=re.escape(f"{name}[{index}] is {bad:g}" if index else f"{name} is {bad:g}")
    ):
        check()


@pytest.mark.parametrize(
    "name, bad", [("young", 0.0), ("density", -1.0), ("poisson", 0.5), ("poisson", -1.0)]
)
def test_impossible_materials(name, bad):
    """A material outside its bounds is refused, also where it requires gradients."""
    tensors = params(**{name: torch.tensor([0.3, 0.3, bad], requires_grad=True)})
    with pytest.raises(ValueError, match=rf"params.{name} must be .*{name}\[2\] is {bad:g}"):
        check_bounds(tensors)
