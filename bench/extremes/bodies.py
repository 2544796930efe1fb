"""Scenes of the maps: blocks, bars and clouds above a frictionless floor, in units where only ratios matter.

Cells of 1 cm, 1,000 kg/m³ and 1e5 Pa give a wave speed √(E/ρ) of 10 m/s. Gravity is 1e-4 E/(ρ dx): a body bends under it by
less than 1 %, and the free fall of its centre of mass can be checked.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

import softmpm

DX, DENSITY, YOUNG = 0.01, 1000.0, 1e5
WAVE = math.sqrt(YOUNG / DENSITY)
"""√(E/ρ) [m/s]; the pressure wave is 1.16 times as fast at a Poisson's ratio of 0.3."""
FLOOR = 4
"""Height of the floor [cells]."""
NODES = {2: 96, 3: 48}
SIDE = {2: 6, 3: 4}
"""Cells along an edge of the block: 144 particles in 2D, 512 in 3D at two a cell and axis."""
BAR = {2: (12, 4), 3: (8, 3, 3)}


def box(
    low: Sequence[float],
    cells: Sequence[float],
    law: type,
    *,
    young: float = YOUNG,
    density: float = DENSITY,
    poisson: float = 0.3,
    viscosity: float = 0.0,
    per_axis: int = 2,
) -> softmpm.Body:
    """A box from the corner ``low``, both it and the edges in cells."""
    corner = DX * np.asarray(low, dtype=float)
    particles = softmpm.box(corner, corner + DX * np.asarray(cells, dtype=float), DX / per_axis)
    return softmpm.Body(particles, law(density=density, young=young, poisson=poisson, viscosity=viscosity))


def block(
    law: type, dim: int, *, height: float | None = None, side: int | None = None, **material
) -> softmpm.Body:
    """A cube in the middle of the grid, or with its bottom ``height`` cells above the floor."""
    side = SIDE[dim] if side is None else side
    low = np.full(dim, (NODES[dim] - side) // 2, dtype=float)
    if height is not None:
        low[1] = FLOOR + height
    return box(low, [side] * dim, law, **material)


def bar(law: type, dim: int) -> softmpm.Body:
    """A bar along x in the middle of the grid."""
    cells = np.array(BAR[dim])
    return box((NODES[dim] - cells) // 2, cells, law)


def halves(law: type, dim: int, height: float, lower: dict, upper: dict) -> list[softmpm.Body]:
    """A bar that stands ``height`` cells above the floor, of two halves with a material each."""
    long, *rest = BAR[dim]
    cells = np.array([rest[0], long / 2, *rest[1:]])
    low = (NODES[dim] - cells) // 2
    low[1] = FLOOR + height
    high = low + np.eye(dim)[1] * cells
    return [box(low, cells, law, **lower), box(high, cells, law, **upper)]


def cloud(law: type, dim: int, count: int = 20, viscosity: float = 0.0) -> softmpm.Body:
    """Particles that share no node, at random positions within their cells."""
    random = np.random.default_rng(0)
    lattice = np.stack(np.meshgrid(*[np.arange(FLOOR + 6, NODES[dim] - 6, 6)] * dim), -1).reshape(-1, dim)
    places = random.permutation(lattice)[:count] + random.uniform(0, 1, (min(count, len(lattice)), dim))
    material = law(density=DENSITY, young=YOUNG, poisson=0.3, viscosity=viscosity)
    return softmpm.Body(softmpm.Particles(DX * places, (DX / 2) ** dim), material)


def scene(
    *bodies: softmpm.Body,
    fraction: float = 0.5,
    gravity: bool = True,
    muscle: float = 0.0,
    pressure: float = 0.0,
    friction: float = 0.0,
    young: float = YOUNG,
    nodes: int | None = None,
) -> softmpm.Scene:
    """Bodies above the floor, at a ``fraction`` of the largest stable step.

    Args:
        muscle: Strength [Pa] of a muscle along x through all particles.
        pressure: Strength [Pa] of a pressure in all particles.
        friction: Coulomb coefficient of the floor.
        young: Young's modulus that gravity is measured by.
        nodes: Nodes along an axis of the grid.
    """
    dim = bodies[0].particles.positions.shape[1]
    count = sum(len(body.particles) for body in bodies)
    along = np.eye(dim)
    everywhere, muscles = np.arange(count), []
    if muscle:
        muscles.append(softmpm.Muscle(particles=everywhere, direction=along[0], strength=muscle))
    if pressure:
        muscles.append(softmpm.Pressure(particles=everywhere, strength=pressure))
    whole = softmpm.Scene(
        grid=softmpm.Grid(shape=(nodes or NODES[dim],) * dim, spacing=DX),
        bodies=bodies,
        muscles=muscles,
        walls=[softmpm.Wall(normal=along[1], offset=FLOOR * DX, friction=friction)],
        gravity=-1e-4 * young / (DENSITY * DX) * along[1] if gravity else None,
        dt=1.0,
    )
    return dataclasses.replace(whole, dt=fraction * float(softmpm.stable_dt(whole)))


def moving(state: softmpm.State, velocity: float, axis: int = 1) -> softmpm.State:
    """All particles at one velocity [m/s]."""
    state.v[..., axis] = velocity
    return state


def affine(state: softmpm.State, rate: np.ndarray) -> softmpm.State:
    """Velocity ``rate`` (x − centre), ``rate`` [1/s] of shape (dim, dim)."""
    C = torch.as_tensor(rate).to(state.C)
    arm = state.x - state.x.mean(dim=1, keepdim=True)
    return state._replace(v=arm @ C.T, C=C.expand_as(state.C).clone())


def deformed(state: softmpm.State, F: np.ndarray) -> softmpm.State:
    """At rest in a homogeneous deformation about the centre."""
    G = torch.as_tensor(F).to(state.F)
    middle = state.x.mean(dim=1, keepdim=True)
    return softmpm.State(middle + (state.x - middle) @ G.T, state.v, state.C, G.expand_as(state.F).clone())


def spinning(dim: int, rate: float) -> np.ndarray:
    """Velocity gradient of a turn in the x-y plane [1/s]."""
    C = np.zeros((dim, dim))
    C[1, 0], C[0, 1] = rate, -rate
    return C
