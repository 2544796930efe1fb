"""Bodies in 3D and walls that act on their surface points: blocks on inclines and belts, cubes and spheres at rest, and bodies
that spin; spheres.py has spheres that are pressed and roll. Axis 1 points up.

Each problem returns what was measured and the exact answer of each quantity. ``place`` displaces the body against the grid [cells].
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import torch

import softmpm

from .running import Simulation

DENSITY, GRAVITY, POISSON = 1000.0, 9.81, 0.3
Place = tuple[float, float, float]
"""Displacement against the grid [cells]."""


class Found(NamedTuple):
    """Quantity as it was measured, and its exact answer."""

    measured: float
    exact: float


def simulation(
    shape: softmpm.Particles,
    formulation: str,
    h: float,
    walls: list[softmpm.Wall],
    *,
    young: float,
    relaxation: float,
    room: tuple[float, float, float] = (0.0, 0.0, 0.0),
    dtype: torch.dtype = torch.float64,
    step: float = 0.5,
    **settings,
) -> Simulation:
    """A viscous body with contact at surface points, at this part of the stable step, on a grid with ``room`` beyond it [m]."""
    material = softmpm.NeoHookean(
        density=DENSITY, young=young, poisson=POISSON, viscosity=relaxation * young / (2 * (1 + POISSON))
    )
    nodes = np.ceil((shape.positions.max(axis=0) + room) / h).astype(int) + 4
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=tuple(nodes.tolist()), spacing=h),
        bodies=[softmpm.Body(shape, material)],
        walls=walls,
        gravity=(0.0, -GRAVITY, 0.0),
        dt=1.0,
    )
    scene = dataclasses.replace(scene, dt=step * softmpm.stable_dt(scene))
    return Simulation(scene, formulation, contact="surface", dtype=dtype, **settings)


def steps(one: Simulation, seconds: float) -> int:
    return math.ceil(seconds / one.model.scene.dt)


def motion(one: Simulation) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Centre of mass, its velocity and the angular velocity about it (world, 3), and the inertia of the particles, in float64."""
    mass, x, v = one.model.mass.double(), one.state.x.double(), one.state.v.double()
    center, mean = ((mass[:, None] * field).sum(1) / mass.sum() for field in (x, v))
    r, w = x - center[:, None], v - mean[:, None]
    spin = (mass[:, None] * torch.linalg.cross(r, w)).sum(1)
    inertia = (mass * r.square().sum(2)).sum(1)[:, None, None] * torch.eye(3, dtype=torch.float64)
    inertia = inertia - torch.einsum("p,wpa,wpb->wab", mass, r, r)
    return center, mean, torch.linalg.solve(inertia, spin[..., None])[..., 0], inertia


def loads(one: Simulation, wall: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Places of the surface points (world, point, 3) [m] and the mean force of a wall on each in the last call [N], in float64."""
    forces, surface = softmpm.contact_forces(one.model, one.state), one.model.surface
    assert surface is not None
    return forces.points.double(), forces.traction[:, wall].double() * surface.areas.double()[:, None]


def slid(
    cells: int,
    formulation: str,
    place: Place = (0.5, 0.5, 0.5),
    turned: float = 0.0,
    headings: tuple[float, ...] = (0.0, 30.0, 45.0, 90.0),
    **settings,
) -> dict[str, Found]:
    """A block, half as high as long, ``turned`` about the normal against the grid [°], on inclines 3° above and 0.5° below the angle of
    friction that fall along several headings in the floor [°], and on belts of 5 cm/s along them. The worst of all headings.
    """
    long, friction, seconds = 0.1, 0.5, 0.4
    h = long / cells
    low = np.array([6.0, 3.0, 6.0]) * h + np.array(place) * h
    shape = softmpm.box(tuple(low), tuple(low + (long, long / 2, long)), spacing=h / 2)
    if turned:
        shape = about_normal(shape, low + long / 2, math.radians(turned))
    floor = softmpm.Wall(normal=(0.0, 1.0, 0.0), offset=low[1], friction=friction)
    worlds = [(degrees, heading) for degrees in (3.0, -0.5, None) for heading in headings]
    one = simulation(
        shape,
        formulation,
        h,
        [floor],
        young=2e5,
        relaxation=2e-3,
        room=(0.06, 0.0, 0.06),
        worlds=len(worlds),
        inputs=("gravity", "wall_velocity"),
        **settings,
    )
    heading = torch.tensor([math.radians(heading) for _, heading in worlds], dtype=torch.float64)
    along = torch.stack([heading.cos(), 0 * heading, heading.sin()], 1)
    across = torch.stack([-heading.sin(), 0 * heading, heading.cos()], 1)
    steep = [math.atan(friction) + math.radians(degrees) if degrees else 0.0 for degrees, _ in worlds]
    slope = torch.tensor(steep, dtype=torch.float64)[:, None]
    up, belts = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.05 * (d is None) for d, _ in worlds])
    given = softmpm.Inputs(
        gravity=(GRAVITY * (slope.sin() * along - slope.cos() * up)).to(one.model.dtype),
        wall_velocity=(belts[:, None] * along)[None, :, None].to(one.model.dtype),
    )
    one.run(steps(one, seconds / 2), given)
    before = motion(one)[1]
    one.run(steps(one, seconds / 2), given)
    after = motion(one)[1]
    time = steps(one, seconds / 2) * one.model.scene.dt
    slides, rests, carried = torch.arange(len(worlds)).split(len(headings))
    gained = ((after - before) * along).sum(1)[slides] / time
    want = GRAVITY * (math.sin(steep[0]) - friction * math.cos(steep[0]))
    worst = gained[(gained - want).abs().argmax()].item()
    return {
        "acceleration [m/s²]": Found(worst, want),
        "its range over headings [m/s²]": Found((gained.max() - gained.min()).item(), 0.0),
        "speed across [m/s]": Found((after * across).sum(1)[slides].abs().max().item(), 0.0),
        "speed at rest [m/s]": Found(after[rests].norm(dim=1).max().item(), 0.0),
        "speed against the belt [m/s]": Found((after - 0.05 * along)[carried].norm(dim=1).max().item(), 0.0),
    }


def about_normal(shape: softmpm.Particles, middle: np.ndarray, angle: float) -> softmpm.Particles:
    """The shape turned about the vertical line through a place, with its outline."""
    cos, sin, outline = math.cos(angle), math.sin(angle), shape.outline
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    assert outline is not None
    turned = softmpm.Outline(
        middle + (outline.points - middle) @ turn.T, outline.normals @ turn.T, outline.areas
    )
    return softmpm.Particles(middle + (shape.positions - middle) @ turn.T, shape.volume, turned)


def rests(cells: int, formulation: str, what: str, place: Place, **settings) -> dict[str, Found]:
    """A cube or a sphere of so many cells across on a rough floor: gap, tilt, and the floor's force and torque."""
    side, seconds, young = 0.1, 0.4, 1e5
    h = side / cells
    low = 3 * h + np.array(place) * h
    if what == "cube":
        shape = softmpm.box(tuple(low), tuple(low + side), spacing=h / 2)
    else:
        shape = softmpm.ball(tuple(low + side / 2), side / 2, spacing=h / 2, cut_cells=True)
    floor = softmpm.Wall(normal=(0.0, 1.0, 0.0), offset=low[1], friction=0.5)
    one = simulation(
        shape, formulation, h, [floor], young=young, relaxation=4e-3, inputs=("damping",), **settings
    )
    damped = softmpm.Inputs(damping=torch.tensor(40.0, dtype=one.model.dtype))
    one.run(steps(one, seconds), damped)
    one.run(steps(one, seconds / 2))
    points, force = (values[0] for values in loads(one))
    center, velocity, _, _ = motion(one)
    torque = torch.linalg.cross(points - center[0], force).sum(0).norm().item()
    weight = one.model.mass.double().sum().item() * GRAVITY
    F = one.state.F[0].double().mean(0)
    turn = (F - F.T).norm() / math.sqrt(8)  # the sine of a small angle
    found = {
        "force / weight": Found(force[:, 1].sum().item() / weight, 1.0),
        "force along the floor / weight": Found(force.sum(0)[[0, 2]].norm().item() / weight, 0.0),
        "torque / (weight · side)": Found(torque / (weight * side), 0.0),
        "tilt [°]": Found(math.degrees(turn), 0.0),
        "speed [m/s]": Found(velocity.norm().item(), 0.0),
        "depth [cells]": Found(max(0.0, (low[1] - points[:, 1].min().item()) / h), 0.0),
    }
    if what == "cube":
        sole = points[:, 1] < low[1] + h / 8
        found["gap [cells]"] = Found((points[sole, 1].max().item() - low[1]) / h, 0.0)
    return found


def spins(cells: int, formulation: str, what: str = "disc", **settings) -> dict[str, Found]:
    """A disc or a square, so many cells from middle to side, that spins on the floor under a uniform pressure."""
    import trimesh

    radius, spin, friction = 0.1, 10.0, 0.5
    h, high = radius / cells, 0.4 * radius
    beside = cells // 2 + 3  # room for the corners of a square
    low = np.array([beside, 3.5, beside]) * h
    if what == "disc":
        disc = trimesh.creation.cylinder(radius=radius, height=high, sections=64)
        disc.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (1.0, 0.0, 0.0)))
        disc.apply_translation(low + (radius, high / 2, radius))
        shape, arm = softmpm.mesh(disc, spacing=h / 2, cut_cells=True), 2 / 3 * radius
    else:
        shape = softmpm.box(tuple(low), tuple(low + (2 * radius, high, 2 * radius)), spacing=h / 2)
        arm = (math.sqrt(2) + math.asinh(1.0)) / 6 * 2 * radius
    floor = softmpm.Wall(normal=(0.0, 1.0, 0.0), offset=low[1], friction=friction)
    one = simulation(
        shape, formulation, h, [floor], young=2e5, relaxation=1e-3, room=(0.05, 0.1, 0.05), **settings
    )
    one.run(steps(one, 0.05))
    center = motion(one)[0].to(one.model.dtype)
    C = torch.zeros_like(one.state.C)
    C[..., 0, 2], C[..., 2, 0] = spin, -spin
    turning = (C @ (one.state.x - center[:, None])[..., None])[..., 0]
    one.state = one.state._replace(v=one.state.v + turning, C=one.state.C + C, nodes=None, surface=None)
    weight = one.model.mass.double().sum().item() * GRAVITY
    stops = 10 * 0.75 * radius / (friction * GRAVITY)  # of the disc [s]
    one.run(steps(one, 0.2 * stops))
    before, torques = motion(one)[2][0, 1].item(), []
    substeps = steps(one, 0.02 * stops)
    for _ in range(20):  # each so short that the mean force belongs to the place
        one.run(substeps)
        points, force = (values[0] for values in loads(one))
        torques.append(-torch.linalg.cross(points - motion(one)[0], force).sum(0)[1].item())
    _, _, after, inertia = motion(one)
    # The mass of a particle is spread over nodes:
    of_nodes = inertia[0, 1, 1].item() + weight / GRAVITY * h**2 / 2
    slowing = (before - after[0, 1].item()) / (20 * substeps * one.model.scene.dt) * of_nodes
    one.run(steps(one, 0.8 * stops))
    want = friction * weight * arm
    return {
        "torque [N m]": Found(float(np.mean(torques)), want),
        "change of its spin [N m]": Found(slowing, want),
        "spin at rest [rad/s]": Found(motion(one)[2][0].norm().item(), 0.0),
    }
