"""The robots: what they are made of, that they stand where they should, and that their muscles move them."""

import dataclasses
import functools

import numpy as np
import pytest
import torch

import softmpm
from softmpm_learn.runs.identity import identity
from softmpm_learn.settings import Settings
from softmpm_learn.tasks import TASKS, ArmConf, BipedConf, ElephantConf, arm, biped, elephant, make_task
from softmpm_learn.tasks.outline import Limb, foot, smooth, smooth_line
from softmpm_learn.tasks.task import LAWS, Resolution, Task, TaskConf
from softmpm_learn.tasks.walker import EDGE, WalkerConf, track

ROBOTS = ("elephant", "arm", "biped")
"""The tasks that need no file."""
SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


@pytest.fixture(scope="module", params=ROBOTS)
def task(request):
    """Each task at its own settings."""
    return make_task(TASKS[request.param][0]())


@functools.cache
def robot(name: str, resolution: Resolution, formulation="moving", contact="auto") -> Task:
    """A task that several tests look at; none changes it."""
    conf, build = TASKS[name]
    return build(conf(resolution=resolution, formulation=formulation, contact=contact))


def simulate(task, activation, seconds):
    model = softmpm.build(task.scene, device="cpu", **task.build)
    steps = round(seconds / task.control_period)
    rows = torch.as_tensor(activation, dtype=torch.float32).expand(steps, 1, model.muscle_count)
    with torch.no_grad():
        return model, softmpm.simulate(model, model.rest(), rows, model.params(), substeps=task.substeps)


def test_elephant_has_its_particles_at_each_resolution():
    """At least 5,000 at the standard resolution, about 2,000 as a draft; the outline's area is the same to 3 %."""
    count, area = {}, {}
    for resolution in Resolution:
        task = robot("elephant", resolution)
        particles = task.scene.bodies[0].particles
        count[resolution.name], area[resolution.name] = len(particles), particles.volume.sum()
    assert count["standard"] >= 5000 and 1500 <= count["draft"] <= 2500 and count["fine"] > 10000
    assert max(area.values()) / min(area.values()) < 1.03


def test_regions_and_muscles_are_particles_of_the_robot(task):
    """Regions do not overlap; every muscle has particles at even the coarsest resolution, and nothing is out of range."""
    count = len(task.scene.bodies[0].particles)
    every = np.concatenate(list(task.regions.values()))
    assert len(np.unique(every)) == len(every) and every.min() >= 0 and every.max() < count
    assert all(len(region) > 20 for region in task.regions.values())
    assert all(len(muscle.particles) > 20 for muscle in task.scene.muscles)
    assert len(task.scene.muscles) % 2 == 0


def test_muscles_have_telling_names(task):
    """Different ones, whose front half is in front and whose left half is on the left."""
    names = task.scene.muscle_names
    assert names == tuple(muscle.name for muscle in task.scene.muscles)
    places = np.concatenate([body.particles.positions for body in task.scene.bodies])
    for k in range(0, len(names), 2):
        limb, first = names[k].split(", ")
        assert names[k + 1].split(", ") == [limb, {"front": "back", "left": "right"}[first]]
        ahead, behind = (places[task.scene.muscles[k + j].particles, 0].mean() for j in range(2))
        assert (ahead > behind) == (first == "front")


def test_names_are_no_part_of_a_run(task):
    """A run of before there were names goes on: its identity does not see them."""
    muscles = [dataclasses.replace(muscle, name="") for muscle in task.scene.muscles]
    nameless = dataclasses.replace(task, scene=dataclasses.replace(task.scene, muscles=muscles))
    named, plain = (
        identity(one, softmpm.build(one.scene, device="cpu", **one.build), Settings())
        for one in (task, nameless)
    )
    assert named == plain


def test_a_pair_of_muscles_splits_a_limb(task):
    """The muscles of a pair share no particle and pull along the same direction, so that they bend it."""
    muscles = task.scene.muscles
    for left, right in zip(muscles[::2], muscles[1::2], strict=True):
        assert not np.intersect1d(left.particles, right.particles).size
        assert left.direction == pytest.approx(right.direction)
        assert len(left.particles) == pytest.approx(len(right.particles), rel=0.3)


def test_legs_stand_on_the_floor():
    """The soles of all legs are at the same height, half a cell above the floor's nodes if those meet it, at every resolution."""
    for name in ("elephant", "biped"):
        for resolution in Resolution:
            task = robot(name, resolution, contact="nodes")
            scene, positions = task.scene, task.scene.bodies[0].particles.positions
            floor = scene.walls[0].offset
            legs = [region for name, region in task.regions.items() if name not in ("body", "trunk")]
            for leg in legs:
                gap = (positions[leg, 1].min() - floor) / scene.grid.spacing
                assert 0.5 < gap < 1.0
            assert positions[:, 1].min() == min(positions[leg, 1].min() for leg in legs)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("resolution", Resolution)
def test_outlines_fit_their_robots(name, resolution):
    """The outline closes around the volume of the particles: to half a spacing of the lattice, to 5e-4 with cut cells."""
    for formulation, contact, tolerance in (("moving", "nodes", 0.01), ("reference", "auto", 5e-4)):
        task = robot(name, resolution, formulation, contact)
        particles, spacing = task.scene.bodies[0].particles, task.scene.grid.spacing / 2
        outline = particles.outline
        assert np.linalg.norm(outline.areas @ outline.normals) < 1e-12
        assert outline.enclosed_volume == pytest.approx(particles.volume.sum(), rel=tolerance)
        whole = bool(np.allclose(particles.volume, spacing**2, rtol=1e-9))
        assert whole == (contact == "nodes")
        assert particles.volume.min() > 0.35 * spacing**2


@pytest.mark.parametrize("name", ["elephant", "biped"])
@pytest.mark.parametrize("resolution", Resolution)
def test_soles_meet_the_floor_on_spline_knots(name, resolution):
    """With surface contact, soles and floor are at one height, in the middle between two rows of nodes, and are exactly level; nodes
    meet a floor that is half a cell lower."""
    for formulation, contact, gap in (
        ("moving", "auto", 0.0),
        ("reference", "auto", 0.0),
        ("reference", "surface", 0.0),
        ("reference", "nodes", 0.5),
    ):
        task = robot(name, resolution, formulation, contact)
        scene, outline = task.scene, task.scene.bodies[0].particles.outline
        lowest = outline.points[:, 1].min()
        assert (lowest / scene.grid.spacing) % 1 == pytest.approx(0.5, abs=1e-9)
        assert (lowest - scene.walls[0].offset) / scene.grid.spacing == pytest.approx(gap, abs=1e-9)
        soles = outline.points[:, 1] < lowest + 1e-9
        legs = 4 if name == "elephant" else 2
        width = {"elephant": 0.106 * 0.44, "biped": 0.078}[name]
        flat = width - 2 * EDGE
        assert outline.areas[soles].sum() == pytest.approx(legs * flat, rel=0.05)  # of oblique legs
        if resolution is Resolution.draft:
            model = softmpm.build(scene, device="cpu", **task.build)
            assert (model.surface is not None) == (contact != "nodes")


def test_retardation_is_viscosity_over_shear_modulus():
    """η = τ μ, and the step is smaller."""
    scene = biped(BipedConf(retardation=1e-3, young=5e4, poisson=0.25)).scene
    assert scene.bodies[0].material.viscosity == pytest.approx(20.0)
    assert scene.dt < biped(BipedConf(retardation=0.0, young=5e4, poisson=0.25)).scene.dt


@pytest.mark.parametrize("law", LAWS)
def test_a_law_is_that_of_the_material(law):
    """Of every task, with the numbers of the settings; an unknown one is refused by a list."""
    for kind in (ArmConf, BipedConf):
        material = make_task(kind(law=law, young=2e4)).scene.bodies[0].material
        assert type(material) is LAWS[law] and material.young == 2e4
    with pytest.raises(ValueError, match="task.law must be one of neo_hookean, stable_neo_hookean"):
        ArmConf(law="rubber")


def test_walkers_learn_with_contact_that_converges():
    """By default they are viscous and stand on surface points with a smooth onset, and change to nodes by one setting; the arm, which
    meets no floor, is elastic and has neither."""
    surface = dict(
        formulation="moving", contact="surface", contact_width=0.01, alarms=softmpm.Alarms(step=None)
    )
    nodes = dict(formulation="moving", contact="nodes", contact_width=0.0, alarms=softmpm.Alarms())
    for conf in (ElephantConf, BipedConf):
        task = make_task(conf())
        material = task.scene.bodies[0].material
        assert material.viscosity == pytest.approx(2e-3 * material.young / (2 * (1 + material.poisson)))
        assert task.build == surface and conf(contact="nodes").build == nodes
        assert conf(formulation="reference").build == surface | {"formulation": "reference"}
        assert conf(contact_width=0.0).build == surface | {"contact_width": 0.0}
    task = make_task(ArmConf())
    assert task.build == nodes and task.scene.bodies[0].material.viscosity == 0.0


def test_limbs_may_pass_each_other_if_they_are_told_to():
    """The alarm is off with task.overlap alone."""
    for overlap in (False, True):
        task = biped(BipedConf(formulation="reference", overlap=overlap))
        assert (softmpm.build(task.scene, device="cpu", **task.build).overlap is None) == overlap


def test_the_step_is_stable_with_room_for_co_design(task):
    """dt is at most 0.4 of the limit, whole substeps fill a control period, and the episode lasts as long as asked."""
    assert task.scene.dt <= 0.4 * softmpm.stable_dt(task.scene) * (1 + 1e-12)
    conf = TASKS[task.name][0]()
    assert task.substeps * task.scene.dt == pytest.approx(conf.control_period)
    assert task.control_steps * task.control_period == pytest.approx(conf.seconds)
    assert task.seconds == pytest.approx(conf.seconds)


def test_the_walkers_stand_without_activation():
    """Left alone for 0.3 s they sink by less than a sixth of their height and stay where they are."""
    for task in (elephant(ElephantConf()), biped(BipedConf())):
        model, end = simulate(task, 0.0, 0.3)
        rest = model.rest().x[0]
        floor = task.scene.walls[0].offset
        assert end.x[0, :, 1].mean() - floor > (rest[:, 1].mean() - floor) * 5 / 6
        assert abs(float(end.x[0, :, 0].mean() - rest[:, 0].mean())) < 0.1 * task.body_length


def test_the_arm_is_clamped_and_bends_to_the_side_that_pulls():
    """Pulling with the muscles on the right brings the tip to the right; the clamped foot stays."""
    task = arm(ArmConf())
    tip = task.objective.terms[0].particles
    for side, sign in ((0, -1), (1, 1)):  # muscles come in pairs, left and right
        activation = torch.zeros(len(task.scene.muscles))
        activation[side::2] = 1.0
        model, end = simulate(task, activation, 0.15)
        moved = (end.x - model.rest().x)[0]
        assert sign * float(moved[tip, 0].mean()) > 0.02
        clamped = model.positions[:, 1] < task.scene.walls[0].offset - task.scene.grid.spacing
        assert clamped.any() and moved[clamped].abs().max() < 1e-3


def test_a_leg_swings_when_its_halves_work_against_each_other():
    """The elephant's foot goes forward when the front half of the leg shortens and the back half lengthens."""
    task = elephant(ElephantConf(gravity=0.0))
    pair = 2 * list(task.regions).index("leg4")
    activation = torch.zeros(len(task.scene.muscles))
    muscles = task.scene.muscles
    positions = task.scene.bodies[0].particles.positions
    means = [positions[muscles[pair + k].particles, 0].mean() for k in (0, 1)]
    front = pair + int(np.argmax(means))
    activation[front], activation[2 * pair + 1 - front] = 1.0, -1.0
    model, end = simulate(task, activation, 0.1)
    leg = task.regions["leg4"]
    foot = leg[positions[leg, 1] < positions[leg, 1].min() + 0.02]
    assert float((end.x - model.rest().x)[0, foot, 0].mean()) > 0.005


def test_settings_reach_the_scene():
    """Materials, strength, gravity, friction and resolution of the settings are those of the scene."""
    conf = ElephantConf(
        young=4e4,
        poisson=0.25,
        density=900.0,
        viscosity=20.0,
        retardation=0.0,
        strength=1e4,
        gravity=3.0,
        friction=0.3,
        damping=0.5,
    )
    scene = elephant(conf).scene
    material = scene.bodies[0].material
    assert (material.young, material.poisson, material.density) == (4e4, 0.25, 900.0)
    assert material.viscosity == 20.0
    assert {muscle.strength for muscle in scene.muscles} == {1e4}
    assert scene.gravity == (0.0, -3.0) and scene.walls[0].friction == 0.3 and scene.damping == 0.5
    assert scene.grid.spacing == pytest.approx(1 / 80)


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (ElephantConf, {"seconds": 0.0}, "task.seconds must be > 0"),
        (ElephantConf, {"young": float("nan")}, "task.young must be > 0"),
        (ElephantConf, {"viscosity": -1.0}, "task.viscosity must be ≥ 0"),
        (ElephantConf, {"retardation": -1.0}, "task.retardation must be ≥ 0"),
        (ElephantConf, {"safety": 1.1}, "task.safety must be at most 1"),
        (ElephantConf, {"viscosity": 1.0}, "two names for one thing"),
        (ElephantConf, {"contact_width": -0.1}, "task.contact_width must be ≥ 0"),
        (ArmConf, {"formulation": "auto"}, "task.formulation must be one of moving, reference; got 'auto'"),
        (
            ArmConf,
            {"contact": "surfaces"},
            "task.contact must be one of auto, nodes, surface; got 'surfaces'",
        ),
        (ElephantConf, {"gravity": -1.0}, "task.gravity must be ≥ 0"),
        (ElephantConf, {"friction": -0.1}, "task.friction must be ≥ 0"),
        (BipedConf, {"upright": -1.0}, "task.upright must be ≥ 0"),
        (BipedConf, {"lead": 1.99}, "task.lead must be ≥ 0 and at most 1.9875 s"),
        (BipedConf, {"lead": -0.1}, "task.lead must be ≥ 0"),
        (ElephantConf, {"control_period": 3.0}, "task.control_period must be at most task.seconds"),
        (ArmConf, {"goal": [0.5]}, "task.goal must be two numbers"),
        (ArmConf, {"goal": [0.9, 0.9]}, "at most the arm's 0.36 m"),
        (ArmConf, {"goal": [0.45, 0.01]}, "above the clamp"),
    ],
)
def test_a_wrong_setting_says_what_must_hold(kind, change, message):
    """Settings are checked where they are made."""
    with pytest.raises(ValueError, match=message):
        kind(**change)


def test_make_task_knows_its_tasks():
    """Each name of the table builds a task of that name; other settings are refused."""
    for name in ROBOTS:
        conf = TASKS[name].kind
        assert conf().name == name and make_task(conf()).name == name

    @dataclasses.dataclass(kw_only=True)
    class Other(TaskConf):
        name: str = "other"

    with pytest.raises(ValueError, match="no task has settings of type Other"):
        make_task(Other())


def test_smooth_curves_pass_through_their_points():
    """Every step-th point of a curve is one that was given; a closed curve has no double point where it closes."""
    assert smooth(SQUARE, 4)[::4] == pytest.approx(SQUARE)
    assert len(smooth(SQUARE, 4)) == 16
    line = np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 2.0), (2.0, 1.0, 1.0)])
    assert smooth_line(line, 5)[::5] == pytest.approx(line)


def test_a_foot_ends_at_the_floor_with_bevelled_edges():
    """An oblique leg that goes through the floor, drawn either way round: its sole is flat, and no corner below turns by 35°."""
    leg = np.array([(0.0, 1.0), (0.1, -0.2), (0.5, -0.2), (0.4, 1.0)])
    for outline in (leg, leg[::-1], np.roll(leg, 2, axis=0)):
        found = foot(outline, 0.06)
        sole = found[np.isclose(found[:, 1], 0.0, atol=1e-12), 0]
        ends = 0.1 / 1.2 + 0.06, 0.5 - 0.1 / 6 - 0.06
        assert sorted(sole) == pytest.approx(sorted(ends)) and found[:, 1].min() > -1e-12
        side = np.diff(np.concatenate([found[-1:], found, found[:1]]), axis=0)
        angle = np.arctan2(side[:, 1], side[:, 0])
        turn = np.abs((np.diff(angle) + np.pi) % (2 * np.pi) - np.pi)
        assert turn[found[:, 1] < 0.5].max() < np.radians(35) and turn.sum() == pytest.approx(2 * np.pi)
        assert found[:, 1].max() == 1.0


def test_a_track_has_room_for_three_episodes():
    """At 1 m/s; what comes to its end leaves the grid, and no wall is there to stop it without a word."""
    assert ElephantConf().track_length == 7.0 and ElephantConf(seconds=0.5).track_length == 4.0
    task = make_task(ElephantConf(seconds=4.0))
    assert task.scene.grid.shape[0] == 13 * 80 and ElephantConf(track=2.5).track_length == 2.5
    assert [wall.normal for wall in task.scene.walls] == [(0.0, 1.0), (1.0, 0.0)]


def test_a_robot_of_ones_own_may_have_a_length():
    """A setting ``length`` of a walker is that of the robot, and leaves the track as it is."""

    @dataclasses.dataclass(kw_only=True)
    class WormConf(WalkerConf):
        name: str = "worm"
        length: float = 0.2

    assert track(WormConf())[0].shape == track(WalkerConf(name="worm"))[0].shape


@pytest.mark.parametrize("name", ["spacing", "build", "alarms", "on_surface", "track_length", "refined"])
def test_a_setting_must_not_replace_an_attribute(name):
    """The walker would be built from it; the name is refused in a class that derives from one of ours, at any distance."""
    own = dataclasses.make_dataclass("WormConf", [("length", float, 0.2)], bases=(WalkerConf,), kw_only=True)
    owner = WalkerConf if name in vars(WalkerConf) else TaskConf
    says = (
        f"{name!r} of LongConf would take the place of {owner.__name__}.{name}; give the setting another name"
    )
    for how in ((name, float, 0.2), (name, float)):
        with pytest.raises(ValueError, match=says):
            dataclasses.make_dataclass("LongConf", [how], bases=(own,), kw_only=True)
    dataclasses.make_dataclass("LongConf", [("length", float, 0.3)], bases=(own,), kw_only=True)


def test_a_limb_knows_along_and_across():
    """On a bent limb, places are measured along its line and to its left, and its parts are the halves of its outline."""
    limb = Limb(np.array([(0.0, 0.0), (0.0, -1.0), (1.0, -1.0)]), np.array([0.2, 0.2, 0.2]))
    along, left = limb.locate(np.array([(0.05, -0.5), (0.5, -0.95), (0.5, -1.05)]))
    assert along == pytest.approx([0.25, 0.75, 0.75]) and left == pytest.approx([0.05, 0.05, -0.05])
    assert limb.direction(0.0, 0.5) == pytest.approx([0.0, -1.0])
    points = softmpm.polygons([limb.outline()], 0.02).positions
    halves = [limb.part(points, 0.0, 1.01, side) for side in (1, -1)]
    assert len(np.intersect1d(*halves)) == 0
    assert len(limb.part(points, 0.0, 1.01)) == pytest.approx(sum(map(len, halves)), abs=60)
    round_limb = dataclasses.replace(limb, round_tip=True)
    assert round_limb.outline()[:, 0].max() == pytest.approx(1.1, abs=1e-3)
