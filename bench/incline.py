"""Motion of a viscous block on an incline: `python bench/incline.py [--device cpu] [--json FILE]`

A block, three tenths as high as it is long, is put on an incline of the angle of friction plus some degrees. Mean acceleration in
the windows of 0.1 s from 0.2 s on, speed at 0.6 s, and the largest distance of the sole's points from the incline in cells; a rigid
block has ``exact``, or rests below the angle of friction.
"""

import dataclasses
import math

import numpy as np
import torch
from common import Table, arguments

import softmpm

CONTACTS = [("reference", "surface"), ("reference", "nodes"), ("moving", "surface"), ("moving", "nodes")]
LONG = 10 / 32
"""Length of the larger block [m]."""
BLOCKS = [
    *((LONG, degrees, 32, 4e-3, *contact) for degrees in (3.0, 0.5, -0.5) for contact in CONTACTS),
    *((LONG, degrees, 32, 1e-3, *contact) for degrees in (3.0, -0.5) for contact in CONTACTS),
    *(
        (long, degrees, cells, relaxation, formulation, "surface")
        for long, cells, relaxation in (
            *((LONG, 64, 4e-3), (LONG, 64, 1e-3), (LONG, 128, 4e-3), (LONG, 128, 1e-3)),
            *((LONG / 2, 32, 1e-3), (LONG / 2, 64, 1e-3), (LONG / 2, 128, 1e-3)),
        )
        for degrees in (3.0, 0.5, -0.5)
        for formulation in ("reference", "moving")
    ),
]
"""Length of the block [m], degrees above the angle of friction, cells per metre, relaxation time η/μ [s], formulation and contact."""


def incline(
    long: float,
    degrees: float,
    cells: int,
    relaxation: float,
    formulation: str,
    contact: str,
    device: torch.device,
) -> dict:
    """Motion of the block along the incline."""
    h, friction, young = 1 / cells, 0.5, 2e5
    angle, corner = math.atan(friction) + math.radians(degrees), (math.floor(0.1 * cells) + 0.5) * h
    shape = softmpm.box((corner, 3.5 * h), (corner + long, 3.5 * h + 0.3 * long), spacing=h / 2)
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
    settings = dict(device=device, dtype=torch.float64, formulation=formulation, contact=contact)
    model = softmpm.build(scene, **settings)
    substeps, state, speeds = int(0.1 / scene.dt), model.rest(), []
    for _ in range(6):
        state = softmpm.simulate(model, state, None, model.params(), substeps=substeps)
        speeds.append(state.v[..., 0].mean().item())
    found = np.diff(speeds)[1:] / (substeps * scene.dt)
    exact = 9.81 * (math.sin(angle) - friction * math.cos(angle))
    row = {"long m": long, "degrees": degrees, "cells": cells, "tau ms": 1e3 * relaxation}
    row |= {"formulation": formulation, "contact": contact}
    row |= {f"a {k / 10} s": a for k, a in enumerate(found, 2)} | {"exact": exact, "speed": speeds[-1]}
    row["gap"] = None
    if model.surface is not None:
        sole = model.surface.points[:, 1] <= 3.5 * h + 1e-9
        heights = softmpm.contact_forces(model, state).points[0, sole, 1] - 3.5 * h
        row["gap"] = (heights.abs().max() / h).item()
    return row


def main():
    args = arguments(__doc__)
    table = Table("Block on an incline, m/s² and m/s, float64", torch.device(args.device), args.json)
    for block in BLOCKS:
        table.add(incline(*block, torch.device(args.device)))


if __name__ == "__main__":
    main()
