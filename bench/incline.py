"""Error of both formulations at problems with exact answers: `python bench/accuracy.py [--device cpu] [--json FILE]`

**Beam**: a cantilever of length L and height H = L/8 that bends under its own weight until its tip sinks by L/5, in plane strain,
damped until it rests. Exact is the geometrically exact (Reissner) beam, integrated by shooting. The clamp is a sticking wall,
whose nodes stand still. ``error %`` is that of the tip at the end of the run, ``drift %`` how much it changed in the last
quarter; cost is in millions of particle-substeps.

**Incline**: a viscous block of 10 x 3 cells, put on an incline of the angle of friction plus some degrees, in the reference
formulation. Mean acceleration in the windows of 0.1 s from 0.2 s on, and speed at 0.6 s; a rigid block has ``exact``, or rests
below the angle of friction.
"""

import dataclasses
import math
import time

import numpy as np
import torch
from common import Table, arguments

import softmpm

YOUNG, POISSON, DENSITY = 1e5, 0.3, 1000.0
LENGTH, HEIGHT, DEFLECTION = 0.8, 0.1, 0.2
BENDING = YOUNG / (1 - POISSON**2) * HEIGHT**3 / 12  # per unit of depth [N m]
AXIAL = YOUNG / (1 - POISSON**2) * HEIGHT
SHEAR = 5 / 6 * YOUNG / (2 * (1 + POISSON)) * HEIGHT
INSIDE = 4
"""Cells of the beam inside the clamp."""
CASES = [(2, 2), (2, 3), (3, 3), (4, 2)]
"""Cells across the beam, and particles along an axis of each."""


def tip_of_beam(weight: float, steps: int = 1000) -> float:
    """Deflection of the tip [m] under a weight per length [N/m], by bisection for the moment at the clamp."""

    def slope(s: float, state: np.ndarray) -> np.ndarray:
        angle, _, _ = state
        force = weight * (LENGTH - s)  # downward, on the section at s
        cos, sin = math.cos(angle), math.sin(angle)
        stretch, shear = 1 - force * sin / AXIAL, -force * cos / SHEAR
        x, y = stretch * cos - shear * sin, stretch * sin + shear * cos
        return np.array([state[1] / BENDING, x * force, y])

    def end(moment: float) -> np.ndarray:
        state, h = np.array([0.0, moment, 0.0]), LENGTH / steps
        for k in range(steps):
            a = slope(k * h, state)
            b = slope((k + 0.5) * h, state + h / 2 * a)
            c = slope((k + 0.5) * h, state + h / 2 * b)
            d = slope((k + 1) * h, state + h * c)
            state = state + h / 6 * (a + 2 * b + 2 * c + d)
        return state

    low, high = -weight * LENGTH**2, 0.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if end(middle)[1] < 0 else (low, middle)
    return -end((low + high) / 2)[2]


def gravity_for(deflection: float) -> float:
    """Gravity [m/s²] under which the tip sinks by this part of the length."""
    low, high = 0.0, 10.0
    for _ in range(30):
        middle = (low + high) / 2
        sinks = tip_of_beam(DENSITY * HEIGHT * middle, 200) / LENGTH
        low, high = (middle, high) if sinks < deflection else (low, middle)
    return (low + high) / 2


def beam(cells: int, per_cell: int, gravity: float, frequency: float) -> softmpm.Scene:
    """The cantilever at 0.9 of its stable time step."""
    h = HEIGHT / cells
    wall, floor = (INSIDE + 3) * h, round(0.35 * LENGTH / h) * h
    shape = softmpm.box((wall - INSIDE * h, floor), (wall + LENGTH, floor + HEIGHT), spacing=h / per_cell)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(int(LENGTH / h) + INSIDE + 16, int((floor + HEIGHT) / h) + 12), spacing=h),
        bodies=[softmpm.Body(shape, softmpm.NeoHookean(density=DENSITY, young=YOUNG, poisson=POISSON))],
        walls=[softmpm.Wall(normal=(1.0, 0.0), offset=wall, contact="stick")],
        gravity=(0.0, -gravity),
        damping=1.4 * frequency,
        dt=1.0,
    )
    return dataclasses.replace(scene, dt=0.9 * softmpm.stable_dt(scene))


def sunk(model: softmpm.Model, state: softmpm.State, spacing: float) -> float:
    """Deflection of the end of the beam [m], extrapolated from its last two columns of particles."""
    across, along = model.exact_positions[:, 1], model.exact_positions[:, 0]
    moved = across - state.x[0, :, 1].double().cpu().numpy()
    last, before = (moved[np.isclose(along, along.max() - k * spacing)].mean() for k in (0, 1))
    return last + 0.5 * (last - before)


BLOCKS = [
    *((degrees, 32, 4e-3, contact) for degrees in (3.0, 0.5, -0.5) for contact in ("surface", "nodes")),
    *((degrees, 32, 1e-3, contact) for degrees in (3.0, -0.5) for contact in ("surface", "nodes")),
    (-0.5, 64, 1e-3, "surface"),
]
"""Degrees above the angle of friction, cells per metre, relaxation time η/μ [s] and contact."""


def incline(degrees: float, cells: int, relaxation: float, contact: str, device: torch.device) -> dict:
    """Motion of the block along the incline."""
    h, friction, young = 1 / cells, 0.5, 2e5
    angle, corner = math.atan(friction) + math.radians(degrees), (math.floor(0.1 * cells) + 0.5) * h
    shape = softmpm.box((corner, 3.5 * h), (corner + 10 / 32, 3.5 * h + 3 / 32), spacing=h / 2)
    material = softmpm.NeoHookean(
        density=1000.0, young=young, poisson=0.3, viscosity=relaxation * young / 2.6
    )
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(int(0.8 * cells), int(0.2 * cells) + 8), spacing=h),
        bodies=[softmpm.Body(shape, material)],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=3.5 * h, friction=friction)],
        gravity=(9.81 * math.sin(angle), -9.81 * math.cos(angle)),
        dt=1.0,
    )
    scene = dataclasses.replace(scene, dt=0.4 * softmpm.stable_dt(scene))
    settings = dict(device=device, dtype=torch.float64, formulation="reference", contact=contact)
    model = softmpm.build(scene, **settings)
    substeps, state, speeds = int(0.1 / scene.dt), model.rest(), []
    for _ in range(6):
        state = softmpm.simulate(model, state, None, model.params(), substeps=substeps)
        speeds.append(state.v[..., 0].mean().item())
    found = np.diff(speeds)[1:] / (substeps * scene.dt)
    exact = 9.81 * (math.sin(angle) - friction * math.cos(angle))
    row = {"degrees": degrees, "cells": cells, "tau ms": 1e3 * relaxation, "contact": contact}
    return row | {f"a {k / 10} s": a for k, a in enumerate(found, 2)} | {"exact": exact, "speed": speeds[-1]}


def main():
    args = arguments(__doc__)
    blocks = Table("Block on an incline, m/s² and m/s, float64", torch.device(args.device), None)
    for block in BLOCKS:
        blocks.add(incline(*block, torch.device(args.device)))
    device, gravity = torch.device(args.device), gravity_for(DEFLECTION)
    exact = tip_of_beam(DENSITY * HEIGHT * gravity)
    frequency = 3.516 * math.sqrt(BENDING / (DENSITY * HEIGHT * LENGTH**4))
    table = Table(f"Beam, tip sinks by {exact / LENGTH:.3f} of the length, float64", device, args.json)
    for cells, per_cell in CASES:
        scene = beam(cells, per_cell, gravity, frequency)
        for formulation in ("moving", "reference"):
            model = softmpm.build(
                scene,
                device=device,
                dtype=torch.float64,
                formulation=formulation,
                alarms=softmpm.Alarms(step=None),
            )
            substeps, state, tips = int(4 / frequency / scene.dt), model.rest(), []
            start = time.perf_counter()
            for _ in range(4):
                state = softmpm.simulate(model, state, None, model.params(), substeps=substeps)
                tips.append(sunk(model, state, HEIGHT / cells / per_cell))
            row = {"formulation": formulation, "cells across": cells, "per cell": per_cell}
            row |= {"cost M": 4 * substeps * model.particle_count / 1e6, "s": time.perf_counter() - start}
            row |= {"error %": 100 * (tips[-1] / exact - 1), "drift %": 100 * (tips[-1] - tips[-2]) / exact}
            table.add(row)


if __name__ == "__main__":
    main()
