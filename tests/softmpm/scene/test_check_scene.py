"""Every rule of a whole scene, and what its message says."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch

import softmpm
from softmpm.scene import check_scene as checks
from softmpm.scene.actuators import Muscle, Pressure
from softmpm.scene.check_scene import check_precision, check_scene
from softmpm.scene.materials import NeoHookean
from softmpm.scene.scene import Body, Grid, Particles, Scene, Wall
from softmpm.scene.shapes import ball, box

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
    for outside in [
        (0.5 - 1e-9, 5),
        (5, 0.5 - 1e-9),
        (7.5, 5),
        (7.5 - 1e-12, 5),
        (5, 9.5),
        (-3, 5),
        (5, 100),
    ]:
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


def outlined(block: Particles, **changes) -> Scene:
    """A body with these particles and an outline changed in some of its fields."""
    assert block.outline is not None
    outline = dataclasses.replace(block.outline, **changes)
    return scene(Body(Particles(block.positions, block.volume, outline), SOFT))


def test_outline_is_in_the_grid_around_its_particles():
    """An outline outside of the nodes or apart from its particles is named; one that lies between the outermost nodes is not."""
    block = box((0.0, 0.25), (0.5, 0.5), DX)
    check_scene(scene(Body(block, SOFT)))
    assert block.outline is not None
    points = block.outline.points
    refused(
        outlined(block, points=points - (0.01, 0.0)),
        "the outline of body 0 leaves the grid: point 0 at (-0.01, 0.3125) m, and 1 more of its 12",
        "from 0 to (1, 1.25) m. Move the body or enlarge the grid.",
    )
    refused(
        outlined(block, points=points + (0.5, 0.0)),
        "the outline of body 0 must surround its particles, but particle 0 at (0.0625, 0.3125) m and 5 more of 8 lie",
        "spans (0.5, 0.25) to (1, 0.5) m. Move both together",
    )


def test_outline_is_closed_around_the_volume_of_its_particles():
    """A missing side, inward normals and lengths in other units are told apart."""
    block = box((0.25, 0.25), (0.75, 0.75), DX)
    outline = block.outline
    assert outline is not None
    rest = outline.normals[:, 1] < 0.5
    refused(
        outlined(block, **{name: getattr(outline, name)[rest] for name in ("points", "normals", "areas")}),
        "body 0 must be closed: the sum of areas times normals has length 0.5, at most 5% of its area of 1.5",
    )
    refused(
        outlined(block, normals=-outline.normals), "must have normals out of the body, got normals into it"
    )
    refused(
        outlined(block, areas=3 * outline.areas),
        "must enclose the volume of its particles, 0.25, to half a particle spacing along the surface, got 0.75",
    )


def test_lattices_agree_with_their_outlines():
    """A disc of two or three particles across is as coarse as a lattice gets, and stays within the tolerance."""
    for radius in np.linspace(0.71, 4.0, 60) * DX / 2:
        for dim in (2, 3):
            if dim == 2 or radius > 0.87 * DX / 2:
                room = Grid(shape=(9, 9, 9)[:dim], spacing=DX)
                check_scene(scene(Body(ball((0.5,) * dim, radius, DX / 2), SOFT), grid=room))


def test_muscles_name_particles_of_the_scene():
    """A muscle's indices run through the bodies in their order, from 0 to the last."""
    bodies = [body((0.5, 0.5), (0.6, 0.5)), body((0.5, 0.7))]

    def muscle(*index, name=""):
        return Muscle(particles=index, direction=(0, 1), strength=1.0, name=name)

    check_scene(scene(*bodies, muscles=[muscle(0, 1, 2), muscle(2)]))
    refused(
        scene(*bodies, muscles=[muscle(0), muscle(1, 3)]),
        "muscle 1 names particle 3",
        "3 particles are 0 to 2",
    )
    refused(scene(*bodies, muscles=[muscle(0, -1)]), "muscle 0 names particle -1")
    chamber = Pressure(particles=[3], strength=1.0)
    refused(scene(*bodies, muscles=[muscle(0), chamber]), "pressure 1 names particle 3")
    refused(scene(*bodies, muscles=[muscle(0), muscle(3, name="leg")]), "muscle 1 'leg' names particle 3")
    check_scene(scene(*bodies, driven=[2, 0]))
    refused(scene(*bodies, driven=[0, 3]), "scene driven names particle 3")
    refused(scene(*bodies, driven=[-1]), "scene driven names particle -1")


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
    """The number by which rows are first compared may be equal for different rows."""
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
    """A 3D scene that satisfies every rule passes."""
    muscle = Muscle(particles=np.arange(8), direction=(0, 1, 0), strength=1.0)
    made = scene(
        Body(box((0.5,) * 3, (0.625,) * 3, DX / 2), SOFT),
        grid=Grid(shape=(9, 9, 9), spacing=DX),
        muscles=[muscle],
        walls=[Wall(normal=(0, 1, 0), offset=0.25)],
    )
    check_scene(made)
    check_scene(dataclasses.replace(made, muscles=(), walls=()))


def soft(**changes) -> Body:
    material = dataclasses.replace(SOFT, **changes)
    return Body(Particles(np.full((2, 2), 0.5) + [[0.0, 0.0], [0.1, 0.0]], [0.01, 0.02]), material)


@pytest.mark.parametrize(
    "made, said",
    [
        (lambda: scene(soft(), dt=1e-50), "dt of 1e-50 is 0 in torch.float32"),
        (lambda: scene(soft(density=1e-40)), "density of body 0 of 1e-40 is"),
        (lambda: scene(soft(density=1e-37)), "smallest or largest mass [kg] of body 0 of 1e-39 is"),
        (
            lambda: scene(soft(density=1e-35), soft(density=1e10)),
            "smallest mass of body 0 over the largest of all of",
        ),
        (
            lambda: scene(soft(density=9e37)),
            "smallest or largest volume of body 0 per unit of mass [m³/kg] of 5.5",
        ),
        (lambda: scene(soft(density=1e39)), "density of body 0 of 1e+39 is inf"),
        (lambda: scene(soft(young=1e-50)), "young of body 0 of 1e-50 is 0"),
        (lambda: scene(soft(poisson=0.49999999)), "poisson of body 0 of 0.49999999 is 0.5"),
        (lambda: scene(soft(poisson=-0.99999999)), "poisson of body 0 of -0.99999999 is -1"),
        (lambda: scene(soft(), gravity=(0, -1e39)), "gravity along axis 1 of -1e+39 is -inf"),
        (
            lambda: scene(soft(), muscles=[Muscle(particles=[0], direction=(1, 0), strength=1e39)]),
            "strength of muscle 0 of 1e+39 is inf",
        ),
        (
            lambda: scene(soft(), muscles=[Pressure(particles=[0], strength=-1e39)]),
            "strength of pressure 0 of -1e+39 is -inf",
        ),
        (lambda: scene(soft(viscosity=1e39)), "viscosity of body 0 of 1e+39 is inf"),
        (lambda: scene(soft(viscosity=1e-50)), "viscosity of body 0 of 1e-50 is 0"),
        (lambda: scene(soft(young=1e-33)), "the stress of body 0 at a strain of 1.2e-07 [Pa] of 1.19"),
        (
            lambda: scene(soft(density=1e30, young=1e30), dt=1e-9),
            "smallest or largest volume of body 0 per unit of mass times dt [m³ s/kg] of 5e-40 is",
        ),
        (
            lambda: scene(soft(density=1e36), dt=1.0),
            "smallest or largest volume of body 0 per unit of mass [J/kg] of ",
        ),
        (
            lambda: scene(soft(), damping=1.0, dt=1e-6),
            "damping must be 0 or at least 1.91 1/s in torch.float32 with dt=1e-06 s",
        ),
    ],
)
def test_what_single_precision_takes_away(made, said):
    """A mass or a step of 0 moves nothing, in silence: it is refused with the value that float32 makes of it, and float64 helps."""
    with pytest.raises(ValueError, match=re.escape(said) + ".*use dtype=torch.float64"):
        check_precision(made(), torch.float32)
    check_precision(made(), torch.float64)


def test_build_asks_for_the_precision():
    """The first rule of a model's precision is checked before anything is made."""
    with pytest.raises(ValueError, match="density of body 0 of 1e-40"):
        softmpm.build(scene(soft(density=1e-40)), device="cpu")
    with pytest.raises(ValueError, match="in torch.float64, and must lie in .* use other units"):
        check_precision(scene(soft(density=1e-310)), torch.float64)


def test_build_takes_deterministic_as_a_truth_value():
    """A text would be taken as true, "no" among them."""
    with pytest.raises(TypeError, match="deterministic must be True or False, got 'no'"):
        softmpm.build(scene(), device="cpu", deterministic="no")


def test_a_model_that_no_memory_holds():
    """Refused by build with the bytes that it would take, not by PyTorch in the middle of a call."""
    wide = scene(soft(), grid=Grid(shape=(10**7, 10**7), spacing=DX))
    for given, settings, said in (
        (wide, {}, "bytes for 1 world.s. of 2 particles and 100,000,000,000,000 nodes, but cpu has"),
        (scene(soft()), {"worlds": 10**12}, "bytes for 1,000,000,000,000 world.s. of 2 particles"),
    ):
        with pytest.raises(ValueError, match=f"a call takes at least [0-9,]* {said} .*take fewer"):
            softmpm.build(given, device="cpu", **settings)
    with pytest.raises(ValueError, match="grid shape must be below 2,147,483,648 nodes along each axis"):
        Grid(shape=(10**12, 10**12), spacing=DX)


def test_the_cpu_has_no_number():
    """Tensors on "cpu:0" say that they are on "cpu", and a model asked for there takes them."""
    model = softmpm.build(scene(soft()), device="cpu:0")
    assert model.device == torch.device("cpu")
    softmpm.simulate(model, model.rest().to("cpu:0"), None, model.params(), substeps=1)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("spacing", [0.5, 0.6, 1.3])
@pytest.mark.parametrize("shift", [0.1, 0.25, 0.37, 0.45])
def test_bodies_that_fill_the_same_space_are_refused(dim, spacing, shift):
    """Whatever their lattices are, shifted by any part of a cell; bodies that touch, and bodies that share the space, are not."""
    h = 1 / 16

    def scene(gap: float, share=1.0) -> Scene:
        low, high = np.full(dim, 4 * h), np.full(dim, 12 * h)
        one, other = box(low, high, spacing=spacing * h), box(low, high, spacing=spacing * h)
        other = other.moved((8 + gap) * h * np.eye(dim)[0])
        bodies = [
            part if share == 1.0 else Particles(part.positions, share * part.volume) for part in (one, other)
        ]
        rubber = NeoHookean(density=1.0, young=100.0, poisson=0.3)
        return Scene(
            grid=Grid(shape=(32,) * dim, spacing=h), bodies=[Body(part, rubber) for part in bodies], dt=1e-4
        )

    check_scene(scene(0.0))
    check_scene(scene(shift))
    deep = 2 * math.ceil(2 / spacing) * spacing
    if spacing == 0.5:
        check_scene(scene(-deep - shift, share=0.5))
    with pytest.raises(ValueError, match=r"bodies 0 and 1 overlap: both fill the space around \(.*\) m"):
        check_scene(scene(-deep - shift))
