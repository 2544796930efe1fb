"""Each setting refuses what it cannot mean, in a sentence that names it."""

import copy
import pickle

import numpy as np
import pytest
import torch

from softmpm.scene.actuators import Actuator, Muscle, Pressure
from softmpm.scene.materials import FixedCorotated, Material, NeoHookean
from softmpm.scene.presets import ECOFLEX_00_30
from softmpm.scene.scene import Body, Grid, Particles, Scene, Wall

SOFT = dict(density=1.0, young=10.0)


def pressure(**changes) -> Pressure:
    return Pressure(**(dict(particles=[0], strength=2.0) | changes))


def scene(**changes) -> Scene:
    body = Body(Particles(np.full((1, 2), 0.5), 0.01), NeoHookean(**SOFT))
    return Scene(**(dict(grid=Grid(shape=(8, 8), spacing=0.1), bodies=[body], dt=1e-3) | changes))


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Grid(shape=(8,), spacing=0.1), "grid shape must have 2 or 3 axes"),
        (lambda: Grid(shape=8, spacing=0.1), "grid shape must have 2 or 3 axes"),
        (lambda: Grid(shape=(8, 3), spacing=0.1), "at least 4 nodes along each axis"),
        (lambda: Grid(shape=(8, 8.5), spacing=0.1), "whole numbers"),
        (lambda: Grid(shape=(8, np.nan), spacing=0.1), "grid shape must be finite"),
        (lambda: Grid(shape=(8, 8), spacing=0), "grid spacing must be > 0 m, got 0"),
        (lambda: Grid(shape=(8, 8), spacing=np.inf), "grid spacing must be finite"),
        (lambda: Particles(np.zeros((3, 4)), 1.0), r"shape \(particle, 2\) or \(particle, 3\), got \(3, 4\)"),
        (lambda: Particles(np.zeros((2, 3, 2)), 1.0), r"got \(2, 3, 2\)"),
        (lambda: Particles(np.zeros((0, 2)), 1.0), "no particles"),
        (lambda: Particles(np.zeros((3, 2)), [1.0, 2.0]), r"shape \(3,\), got \(2,\)"),
        (lambda: Particles([[0, 0], [0, np.nan]], 1.0), "positions must be finite; particle 1 is not"),
        (lambda: Particles(np.zeros((3, 2)), [1, 1, np.inf]), "volume must be finite; particle 2 is not"),
        (lambda: Particles(np.zeros((3, 2)), np.nan), "volume must be finite; particle 0 is not"),
        (lambda: Particles(np.zeros((2, 2)), [1.0, 0.0]), "volume must be > 0, got 0"),
        (lambda: Material(**SOFT), "use NeoHookean, StableNeoHookean, FixedCorotated or BarrierCorotated"),
        (lambda: NeoHookean(density=0.0, young=1.0), "density must be > 0"),
        (lambda: NeoHookean(density=np.nan, young=1.0), "density must be finite"),
        (lambda: NeoHookean(density=1.0, young=-1.0), "young must be > 0 Pa, got -1"),
        (lambda: FixedCorotated(**SOFT, poisson=0.5), r"poisson must lie in \(-1, 0.5\), got 0.5"),
        (lambda: FixedCorotated(**SOFT, poisson=-1.0), r"poisson must lie in \(-1, 0.5\)"),
        (lambda: NeoHookean(**SOFT, viscosity=-1.0), "viscosity must be ≥ 0 Pa s, got -1"),
        (lambda: NeoHookean(**SOFT, viscosity=np.inf), "material viscosity must be finite"),
        (lambda: Muscle(particles=[], direction=(1, 0), strength=1), "not empty"),
        (lambda: Muscle(particles=[[0, 1]], direction=(1, 0), strength=1), "list of particle indices"),
        (lambda: Muscle(particles=[True, False], direction=(1, 0), strength=1), "np.flatnonzero"),
        (lambda: Muscle(particles=[0.0, 1.0], direction=(1, 0), strength=1), "whole numbers, got float64"),
        (lambda: Muscle(particles=[2, 1, 2], direction=(1, 0), strength=1), "names a particle twice"),
        (lambda: Actuator(particles=[0], strength=1), "an actuator needs a kind: use Muscle or Pressure"),
        (lambda: pressure(particles=[]), "a pressure needs a list of particle indices, not empty"),
        (
            lambda: pressure(name="  "),
            "pressure name must have at most 64 printable characters, and no space",
        ),
        (lambda: pressure(name="leg "), "no space at either end, got 'leg '"),
        (lambda: pressure(name="two\nlines"), r"printable characters, .* got 'two\\nlines'"),
        (lambda: pressure(name="\ud800"), "printable characters"),
        (lambda: pressure(name=65 * "x"), "at most 64"),
        (
            lambda: pressure(particles=np.zeros((5, 2))),
            r"particle indices, not empty, got an array of shape \(5, 2\); np.flatnonzero\(mask\) makes one",
        ),
        (lambda: pressure(particles=[1, 1]), "a pressure names a particle twice"),
        (lambda: pressure(strength=np.nan), "pressure strength must be finite"),
        (lambda: Muscle(particles=[0], direction=(0, 0), strength=1), "direction must not be zero"),
        (lambda: Muscle(particles=[0], direction=(np.nan, 0), strength=1), "direction must be finite"),
        (lambda: Muscle(particles=[0], direction=(1, 0), strength=np.inf), "strength must be finite"),
        (
            lambda: Wall(normal=(0, 1), offset=0, contact="sticky"),
            "one of stick, slip, separate, clamp, symmetry, got 'sticky'",
        ),
        (lambda: Wall(normal=(0, 1), offset=np.nan), "wall offset must be finite"),
        (lambda: Wall(normal=(0, 0), offset=0), "wall normal must not be zero"),
        (lambda: scene(driven=[0, 0]), "scene driven names a particle twice"),
        (lambda: scene(driven=[[0]]), "scene driven needs a list of particle indices"),
        (lambda: scene(driven=[0.5]), "scene driven particles must be whole numbers, got float64"),
        (lambda: scene(driven=[True]), "np.flatnonzero"),
        (lambda: Wall(normal=(0, 1), offset=0, friction=-0.1), "friction must be ≥ 0"),
        (lambda: Wall(normal=(0, 1), offset=0, contact="slip", friction=0.1), "a slip wall has no friction"),
        (lambda: scene(bodies=[]), "at least one body"),
        (lambda: scene(gravity=(0, -9.8, 0)), "gravity needs 2 numbers"),
        (lambda: scene(gravity=(0, np.nan)), "gravity must be finite"),
        (lambda: scene(damping=-1.0), "damping must be ≥ 0"),
        (lambda: scene(dt=0.0), "dt must be > 0 s, got 0"),
        (lambda: scene(dt=np.nan), "scene dt must be finite, at most 1.8e308, got nan"),
        (
            lambda: Grid(shape=(8, 8), spacing=10**400),
            "grid spacing must be finite, at most 1.8e308, got inf",
        ),
        (lambda: scene(gravity=(0, 10**5000)), "gravity must be finite"),
    ],
)
def test_refuses_values(make, message):
    """A value that cannot be meant is a ValueError that says what must hold and what came."""
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Grid(shape=(8, 8), spacing="wide"), "grid spacing must be one number, got 'wide'"),
        (lambda: NeoHookean(density=1.0, young=np.ones(3)), "material young must be one number"),
        (lambda: NeoHookean(density=None, young=1.0), "material density must be one number, got None"),
        (lambda: Body(np.zeros((3, 2)), NeoHookean(**SOFT)), "particles must be a Particles, got ndarray"),
        (lambda: Body(Particles(np.zeros((3, 2)), 1.0), 5.0), "material must be a Material, got float"),
        (
            lambda: Muscle(particles=[0], direction=("x", 0), strength=1),
            "direction must be made of plain numbers",
        ),
        (lambda: scene(grid=(8, 8)), "grid must be a Grid, got tuple"),
        (lambda: scene(bodies=scene().bodies[0]), "bodies must be a list of Body, got Body"),
        (lambda: scene(muscles=[None]), r"muscles\[0\] must be a Muscle or Pressure, got NoneType"),
        (lambda: scene(muscles=pressure()), "muscles must be a list of Muscle or Pressure, got Pressure"),
        (lambda: Pressure(particles=[0], strength="p"), "pressure strength must be one number, got 'p'"),
        (lambda: pressure(name=None), "pressure name must be a text, got None; leave it out for none"),
        (lambda: scene(walls=3), "walls must be a list of Wall, got int"),
        (lambda: Particles(np.zeros((3, 2)), "a"), "volume must be real numbers, got <U1"),
        (lambda: Particles("abc", 1.0), "positions must be real numbers, got <U3"),
        (
            lambda: Particles([[0, 0], [0]], 1.0),
            "positions must be an array of real numbers; its rows differ",
        ),
        (lambda: Particles(np.zeros((3, 2), complex), 1.0), "positions must be real numbers, got complex128"),
        (lambda: Particles(np.ma.zeros((3, 2)), 1.0), "positions must not be a masked array"),
        (lambda: Particles(np.zeros((3, 2)), np.ma.ones(3)), "volume must not be a masked array"),
        (
            lambda: Muscle(particles=np.ma.array([0, 1], mask=[0, 1]), direction=(1, 0), strength=1),
            "muscle particles must not be a masked array",
        ),
        (
            lambda: Muscle(particles=[0], direction="01", strength=1),
            "direction must be made of plain numbers",
        ),
        (lambda: scene(gravity=("0", "-9.8")), "gravity must be made of plain numbers"),
        (lambda: scene(gravity=(0, 1j)), "gravity must be made of plain numbers"),
        (lambda: scene(gravity=np.array([0, 1j])), "gravity must be made of plain numbers"),
        (lambda: NeoHookean(density=np.complex64(1), young=1.0), "material density must be one number"),
        (lambda: NeoHookean(density=True, young=1.0), "material density must be one number, got True"),
    ],
)
def test_refuses_kinds(make, message):
    """A thing of the wrong kind is a TypeError that says which kind belongs there."""
    with pytest.raises(TypeError, match=message):
        make()


def test_directions_are_normalised():
    """A direction keeps its way, not its length; a wall's plane stays where it was written."""
    assert Muscle(particles=[0], direction=(3, 4), strength=1).direction == pytest.approx(
        (0.6, 0.8), abs=1e-15
    )
    wall = Wall(normal=(0, 2), offset=1.0)  # 2 y ≤ 1
    assert wall.normal == (0.0, 1.0) and wall.offset == 0.5
    assert Wall(normal=(0.6, 0.8), offset=0.3).offset == 0.3


def test_plain_numbers_inside():
    """NumPy scalars and lists become plain numbers and tuples, so equal settings hash alike."""
    grid = Grid(shape=np.array([8, 9]), spacing=np.float32(0.5))
    assert grid == Grid(shape=[8, 9.0], spacing=0.5) and hash(grid) == hash(Grid(shape=(8, 9), spacing=0.5))
    assert all(type(n) is int for n in grid.shape) and type(grid.spacing) is float
    assert scene().gravity == (0.0, 0.0) and isinstance(scene(muscles=iter(())).muscles, tuple)


def test_particles_are_a_copy():
    """A scene does not change when the arrays that it was made from do; one volume is every particle's."""
    positions = np.zeros((3, 2))
    particles = Particles(positions, 0.5)
    positions += 1.0
    assert (particles.positions == 0).all() and len(particles) == 3
    assert particles.volume.tolist() == [0.5, 0.5, 0.5]


@pytest.mark.parametrize(
    "again", [lambda o: o, copy.copy, copy.deepcopy, lambda o: pickle.loads(pickle.dumps(o))]
)
def test_arrays_cannot_be_written_to(again):
    """Nothing can be spoiled between the checks and build: a volume of NaN made its particles vanish. Also in copies."""
    direction = (0.2, 0.7, 0.4)
    particles = again(Particles(np.zeros((3, 2)), np.ones(3)))
    muscle = again(Muscle(particles=np.arange(3), direction=direction, strength=1))
    chamber = again(pressure())
    assert chamber.strength == 2.0 and repr(chamber) == "Pressure(1 particle, strength=2 Pa)"
    made = again(scene(driven=[0]))
    for values in (
        particles.positions,
        particles.volume,
        muscle.particles,
        chamber.particles,
        made.driven,
    ):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 7
    assert muscle.direction == Muscle(particles=[0], direction=direction, strength=1).direction


def test_names_of_actuators():
    """A name is in the text of its actuator, also of a copy. Labels are names, or kind and place; all of a scene differ, whatever the
    names."""
    leg = Muscle(particles=[0], direction=(1, 0), strength=2, name=np.str_("left hind leg, front"))
    assert repr(leg) == "Muscle('left hind leg, front', 1 particle, direction=(1.0, 0.0), strength=2 Pa)"
    assert pickle.loads(pickle.dumps(leg)).name == copy.deepcopy(leg).name == leg.name
    assert repr(pressure(name="Ballon № 1")) == "Pressure('Ballon № 1', 1 particle, strength=2 Pa)"
    assert pressure(name=64 * "x").name == 64 * "x" and pressure().name == ""
    for names, labels in (
        ([], ()),
        (["", "leg", ""], ("pressure 0", "leg", "pressure 2")),
        (["leg", "", "leg"], ("leg (0)", "pressure 1", "leg (2)")),
        (["a", "a", "a (0)"], ("a (0) (0)", "a (1)", "a (0) (2)")),
        (["pressure 1", ""], ("pressure 1 (0)", "pressure 1 (1)")),
    ):
        assert scene(muscles=[pressure(name=name) for name in names]).muscle_names == labels
    assert scene(muscles=[leg, pressure(), leg]).muscle_names[1] == "pressure 1"


def test_driven_particles():
    """Their indices are stored as int64 in the order given; none by default, and then the text of the scene does not name them."""
    assert scene().driven.shape == (0,) and scene().driven.dtype == np.int64 and "driven" not in repr(scene())
    for given in ([0], (0,), np.array([0], dtype=np.int32)):
        made = scene(driven=given)
        assert made.driven.tolist() == [0] and made.driven.dtype == np.int64
    assert "driven: 1 particle" in repr(made)


def test_a_preset_is_no_material_yet():
    """It has to be given a law."""
    with pytest.raises(
        TypeError, match=r"must be a Material, got a Preset; its method material\(\) makes one"
    ):
        Body(Particles(np.full((1, 2), 0.5), 0.01), ECOFLEX_00_30)


def test_particles_of_a_scene_are_those_of_its_bodies_in_their_order():
    """The other quantities of particles are numbered alike."""
    parts = [Particles(np.full((count, 2), 0.1 * count), 0.01) for count in (2, 1, 3)]
    whole = scene(bodies=[Body(part, NeoHookean(**SOFT)) for part in parts])
    assert whole.particle_count == 6 and whole.body_index.tolist() == [0, 0, 1, 2, 2, 2]
    assert whole.positions[:, 1].tolist() == [
        part.positions[0, 0] for part in parts for _ in range(len(part))
    ]


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda value: NeoHookean(density=1.0, young=value), "material young"),
        (lambda value: pressure(strength=value), "pressure strength"),
        (lambda value: Muscle(particles=[0], direction=(1.0, value), strength=1.0), "muscle direction"),
    ],
)
def test_a_tensor_that_would_lose_its_gradient_is_refused(make, name):
    """A scene holds plain numbers; the error says where the gradient is."""
    make(torch.tensor(2.0))
    with pytest.raises(TypeError, match=f"{name} must be .*requires_grad.*in its params or inputs"):
        make(torch.tensor(2.0, requires_grad=True))
