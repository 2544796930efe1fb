"""Bodies that come to rest: a cantilever in 2D and 3D, a twisted bar, and a column under its own weight.

In ``"reference"`` a clamp holds the body, which begins at it. In ``"moving"`` and ``"reference, stick"`` a sticking wall does, and the
body reaches some cells into it.
"""

import math

import numpy as np
import torch

import softmpm

from . import exact
from .running import Simulation, result, scene_of

YOUNG, POISSON, DENSITY = 1e5, 0.3, 1000.0
LENGTH, HEIGHT = 0.8, 0.1
MU = YOUNG / (2 * (1 + POISSON))
LAME = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
INSIDE = 4
"""Cells of a body in a sticking wall."""
ON_KNOTS = 0.5
"""Cells from a node to the next knot of the splines."""


def held(kind: str, axis: int, h: float, dim: int) -> tuple[float, float, softmpm.Wall]:
    """Where the free body begins along an axis, where its particles do, and the wall there."""
    normal = tuple(float(k == axis) for k in range(dim))
    if kind == "reference":
        return 3 * h, 3 * h, softmpm.Wall(normal=normal, offset=3 * h, contact="clamp")
    plane = (INSIDE + 3) * h
    return plane, plane - INSIDE * h, softmpm.Wall(normal=normal, offset=plane, contact="stick")


def rod(
    kind: str, dim: int, cells: int, per_cell: int, below: float = 0.0, beyond: float = ON_KNOTS, **settings
):
    """Scene of a rod that begins at a wall, with so many cells across; its sides are so many cells beyond nodes."""
    h = HEIGHT / cells
    plane, begin, wall = held(kind, 0, h, dim)
    floor, side = (math.ceil(below / h + 3) + beyond) * h, (3 + beyond) * h
    lower, upper = (begin, floor, side)[:dim], (plane + LENGTH, floor + HEIGHT, side + HEIGHT)[:dim]
    shape = softmpm.box(lower, upper, spacing=h / per_cell)
    material = softmpm.NeoHookean(density=DENSITY, young=YOUNG, poisson=POISSON)
    return scene_of(h, shape, material, walls=[wall], **settings)


def at_end(values: np.ndarray, along: np.ndarray, spacing: float) -> float:
    """Mean over the end of a rod, extrapolated from its last two sections of particles."""
    last, before = (values[np.isclose(along, along.max() - k * spacing)].mean() for k in (0, 1))
    return float(last + 0.5 * (last - before))


def beam(
    kind: str,
    cells: int,
    per_cell: int,
    *,
    sinks: float,
    dim: int,
    step: float = 1.0,
    periods: float = 7.2,
    softens: bool = False,
) -> dict:
    """Sinking of the tip of a cantilever, in plane strain or of a square section, that is put on its weight.

    Args:
        sinks: Of the tip over the length, for a section that is linear.
        step: Over the stable one.
        periods: Length of the run, times the angular frequency.
        softens: Compare with a section that softens as the material does, in plane strain.
    """
    width = None if dim == 2 else HEIGHT
    section, area = exact.section(YOUNG, POISSON, HEIGHT, width), HEIGHT * (width or 1.0)

    def tip(gravity: float) -> float:
        return exact.tip_of_beam(DENSITY * area * gravity, LENGTH, section, 200)

    gravity = exact.root(lambda g: tip(g) - sinks * LENGTH, 0.0, 20.0, 30)
    frequency = 3.516 * math.sqrt(section.bending / (DENSITY * area * LENGTH**4))
    settings = dict(gravity=(0.0, -gravity, 0.0)[:dim], damping=1.8 * frequency, step=step)
    scene = rod(kind, dim, cells, per_cell, below=(sinks + 0.1) * LENGTH, **settings)
    one = Simulation(scene, kind)
    along, across = one.model.exact_positions[:, 0], one.model.exact_positions[:, 1]

    def sunk(state: softmpm.State) -> float:
        moved = across - state.x[0, :, 1].cpu().numpy()
        return at_end(moved, along, HEIGHT / cells / per_cell)

    softening = exact.softening_of_section(POISSON, HEIGHT) if softens else 0.0
    want = exact.tip_of_beam(DENSITY * area * gravity, LENGTH, section, softening=softening)
    return result(one, one.settled(periods / frequency, sunk), want)


def twisted(kind: str, cells: int, per_cell: int, beyond: float = ON_KNOTS) -> dict:
    """Twist of the end of a square bar under a uniform torque per length, by forces on its particles."""
    exact_twist = 0.05
    polar = HEIGHT**4 / 6
    torque = exact_twist / exact.twist_of_bar(1.0, LENGTH, HEIGHT, MU)
    stiffness = torque * LENGTH**2 / (2 * exact_twist)
    lumped = polar * (
        1 + 3 / cells**2
    )  # mass that is gathered on nodes turns with an arm of its own, h²/2 in the mean
    frequency = math.pi / 2 / LENGTH * math.sqrt(stiffness / (DENSITY * lumped))
    scene = rod(kind, 3, cells, per_cell, damping=1.8 * frequency, beyond=beyond, step=1.0)
    one = Simulation(scene, kind, inputs=("force",))
    model = one.model
    arms = (
        model.exact_positions[:, 1:]
        - (model.exact_positions[:, 1:].min(0) + model.exact_positions[:, 1:].max(0)) / 2
    )
    force = np.zeros_like(model.exact_positions)
    force[:, 1:] = (
        np.stack([-arms[:, 1], arms[:, 0]], -1) * torque / polar * model.volume.cpu().numpy()[:, None]
    )
    inputs = softmpm.Inputs(force=torch.from_numpy(force)[None, None])
    along, lever = model.exact_positions[:, 0], (arms**2).sum(1)

    def turned(state: softmpm.State) -> float:
        moved = (state.x[0].cpu().numpy() - model.exact_positions)[:, 1:]
        turn = arms[:, 0] * moved[:, 1] - arms[:, 1] * moved[:, 0]
        return at_end(turn, along, HEIGHT / cells / per_cell) / lever[np.isclose(along, along.max())].mean()

    return result(one, one.settled(10 / frequency, turned, inputs), exact_twist)


def column(kind: str, cells: int, per_cell: int) -> dict:
    """Sinking of the upper end of a column in uniaxial strain, under a weight of 5 % of (λ + 2μ)/L; two cells wide."""
    length, h = 1.0, 1.0 / cells
    plane, begin, wall = held(kind, 1, h, 2)
    shape = softmpm.box((3 * h, begin), (5 * h, plane + length), spacing=h / per_cell)
    beside = "symmetry" if kind == "reference" else "slip"
    reach = 0.0 if kind == "reference" else 2 * h  # a slipping wall acts on all the nodes of its half
    sides = [
        softmpm.Wall(normal=(side, 0.0), offset=side * place + reach, contact=beside)
        for side, place in ((1.0, 3 * h), (-1.0, 5 * h))
    ]
    weight = 0.05 * (LAME + 2 * MU) / length
    frequency = math.pi / 2 / length * math.sqrt((LAME + 2 * MU) / DENSITY)
    settings = dict(gravity=(0.0, -weight / DENSITY), damping=1.8 * frequency, step=0.8)
    material = softmpm.NeoHookean(density=DENSITY, young=YOUNG, poisson=POISSON)
    one = Simulation(scene_of(h, shape, material, walls=[wall, *sides], **settings), kind)
    height = one.model.exact_positions[:, 1] - plane
    top = height == height.max()
    want = exact.column(height[top][:1], length, weight, MU, LAME)[0]

    def sunk(state: softmpm.State) -> float:
        return float((state.x[0, :, 1].cpu().numpy() - plane - height)[top].mean())

    return result(one, one.settled(16 / frequency, sunk), want)
