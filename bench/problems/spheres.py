"""Spheres and walls that act on their surface points, as in solids.py: pressed between plates, and rolling down an incline."""

import math

import numpy as np
import torch

import softmpm

from . import exact
from .solids import DENSITY, GRAVITY, POISSON, Found, Place, loads, motion, simulation, steps


def pressed(
    cells: int,
    formulation: str,
    place: Place = (0.0, 0.0, 0.0),
    axis: int = 1,
    ratio: float = 0.25,
    relaxation: float = 0.0,
    **settings,
) -> dict[str, Found]:
    """A weightless sphere of so many cells in its radius, pressed by two smooth plates to a contact of ``ratio`` radii by Hertz.

    The pressure is that of Hertz' distribution fitted within 0.7 of the contact's radius to the tractions, which are per area at rest.
    """
    radius, young, damping = 0.1, 1e5, 1.8 * math.sqrt(1e5 / DENSITY) / 0.1
    h = radius / cells
    want = exact.sphere(radius, young, POISSON, ratio * radius)
    center = (cells + 3) * h + np.array(place) * h
    shape = softmpm.ball(tuple(center), radius, spacing=h / 2, cut_cells=True)
    normal = np.eye(3)[axis]
    plates = [
        softmpm.Wall(normal=tuple(sign * normal), offset=sign * center[axis] - radius) for sign in (1.0, -1.0)
    ]
    names = ("wall_offset", "gravity", "damping")
    one = simulation(
        shape, formulation, h, plates, young=young, relaxation=relaxation, inputs=names, **settings
    )
    rest = torch.tensor([wall.offset for wall in plates], dtype=torch.float64)
    still = dict(
        gravity=torch.zeros(3, dtype=one.model.dtype), damping=torch.tensor(damping, dtype=one.model.dtype)
    )
    way = want.approach * (1 - np.cos(np.linspace(0.0, math.pi, 41))) / 2
    poses = rest + torch.from_numpy(way)[:, None]
    for begin in range(40):
        moving = softmpm.Inputs(wall_offset=poses[begin : begin + 2, None], **still)
        one.run(steps(one, 10 / damping / 40), moving)
    held, found = softmpm.Inputs(wall_offset=poses[-1:, None], **still), []
    # Damping acts on the forces, but not on the contact that balances them:
    decay = math.exp(-damping * one.model.scene.dt)
    largest = 1.5 * want.force / (math.pi * (ratio * radius) ** 2)
    assert one.model.surface is not None
    areas = one.model.surface.areas.numpy()
    for _ in range(8):
        one.run(steps(one, 2 / damping), held)
        points, force = (values[0].numpy() for values in loads(one))
        square = (np.delete(points - center, axis, 1) ** 2).sum(1)
        normal_force = force[:, axis] / decay
        # Σ f r² = 2/5 a² F by Hertz
        width = math.sqrt(2.5 * (normal_force * square).sum() / normal_force.sum())
        profile = np.sqrt(np.maximum(1 - square / (ratio * radius) ** 2, 0.0)) * (normal_force > 0)
        contraction = (1 + POISSON) * (1 - 2 * POISSON) * largest / young * profile  # of the area
        profile = profile * (1 - contraction)
        inner = square < 0.5 * (ratio * radius) ** 2
        peak = (profile * normal_force)[inner].sum() / (profile**2 * areas)[inner].sum()
        found.append((normal_force.sum(), width, peak))
    force, width, peak = np.mean(found[-4:], axis=0)
    return {
        "force [N]": Found(force, want.force),
        "radius of the contact [m]": Found(width, ratio * radius),
        "largest pressure [Pa]": Found(peak, largest),
    }


ROLLS = ((15.0, 0.5, 0.0), (15.0, 0.5, 45.0), (15.0, 0.5, 90.0), (24.0, 0.1, 0.0), (24.0, 0.1, 45.0))
"""Incline [°], friction, and heading [°] of the spheres that roll: without slip below tan = 7/2 μ, slipping above."""


def rolls(
    cells: int, formulation: str, place: Place = (0.0, 0.0, 0.0), rows=ROLLS, young: float = 2e5, **settings
) -> dict[str, Found]:
    """Spheres of so many cells in their radius, at rest on a floor that then inclines.

    Exact is the rigid sphere; friction that slides has the arm R − a²/R of a sphere that has sunk as Hertz says.
    """
    radius, seconds = 0.1, 0.3
    h = radius / cells
    center = (cells + 3) * h + np.array(place) * h
    shape = softmpm.ball(tuple(center), radius, spacing=h / 2, cut_cells=True)
    floor = softmpm.Wall(normal=(0.0, 1.0, 0.0), offset=center[1] - radius)
    one = simulation(
        shape,
        formulation,
        h,
        [floor],
        young=young,
        relaxation=2e-4,
        room=(0.25, 0.0, 0.25),
        worlds=len(rows),
        inputs=("gravity", "friction", "damping"),
        **settings,
    )
    slope, friction, heading = torch.tensor(rows, dtype=torch.float64).T
    slope, heading = slope.deg2rad(), heading.deg2rad()
    along = torch.stack([heading.cos(), 0 * heading, heading.sin()], 1)
    axis = torch.stack([heading.sin(), 0 * heading, -heading.cos()], 1)
    across = torch.stack([-heading.sin(), 0 * heading, heading.cos()], 1)
    normal = -(GRAVITY * slope.cos())[:, None] * torch.tensor([0.0, 1.0, 0.0])
    dtype, down = one.model.dtype, GRAVITY * slope.sin()
    level = dict(friction=friction[:, None].to(dtype), gravity=normal.to(dtype))
    one.run(steps(one, 0.3), softmpm.Inputs(damping=torch.tensor(90.0, dtype=dtype), **level))
    tilted = level | dict(gravity=(normal + down[:, None] * along).to(dtype))
    given, states = softmpm.Inputs(**tilted), []
    for _ in range(3):
        one.run(steps(one, seconds / 3), given)
        states.append(motion(one))
    (center, velocity, spin, inertia), (end, final, fast, _) = states[0], states[2]
    time, mass = 2 * steps(one, seconds / 3) * one.model.scene.dt, one.model.mass.double().sum()
    of_nodes = inertia[:, 1, 1] + mass * h**2 / 2  # each particle's mass is spread over nodes
    energy = mass * (final.square() - velocity.square()).sum(1) + of_nodes * (
        fast.square() - spin.square()
    ).sum(1)
    work = mass * down * ((end - center) * along).sum(1)
    gained = ((final - velocity) * along).sum(1) / time
    turned = ((fast - spin) * axis).sum(1) / time * radius
    beside = (final * across).sum(1) / final.norm(dim=1)
    # a²/R² by Hertz
    sunk = (0.75 * mass.item() * GRAVITY * (1 - POISSON**2) / (young * radius**2)) ** (2 / 3)
    found = {}
    for k, (degrees, mu, way) in enumerate(rows):
        name, normal_part = f"{degrees:g}°, μ {mu:g}, {way:g}°: ", GRAVITY * math.cos(slope[k])
        if math.tan(slope[k]) < 3.5 * mu:
            found[name + "acceleration [m/s²]"] = Found(gained[k].item(), 5 / 7 * down[k].item())
            found[name + "energy / work"] = Found((energy[k] / work[k] / 2).item(), 1.0)
        else:
            found[name + "acceleration [m/s²]"] = Found(gained[k].item(), down[k].item() - mu * normal_part)
            found[name + "that of the spin · R [m/s²]"] = Found(
                turned[k].item(), 2.5 * mu * normal_part * (1 - sunk)
            )
        found[name + "velocity across / along"] = Found(beside[k].item(), 0.0)
    return found
