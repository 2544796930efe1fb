"""A soft block that should rest on a slope: `python bench/slope.py [--device cpu] [--json FILE]`

A square block of 0.2 m (E 5e4 Pa, 1,000 kg/m³, ν 0.3, η/μ 4 ms, friction 0.6) is put on a slope of 20°; the angle of friction is 31°.
It shears and then rests: the way of its centre down the slope after 1 and 1.5 s, and its mean rotation.
"""

import itertools
import math

import torch
from common import Table, arguments

import softmpm

LONG, YOUNG, FRICTION, SLOPE = 0.2, 5e4, 0.6, math.radians(20.0)
CORNERS = ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.25, 0.25), (0.1, 0.1))
"""Lower left corner in the cell of the grid [cells]."""
BLOCKS = [
    *itertools.product((6, 7, 8, 9, 12, 16, 32), CORNERS[:1], ("reference", "moving")),
    *itertools.product((6, 8), CORNERS[1:], ("reference", "moving")),
]
"""Cells across the block, corner, formulation."""


def slope(cells: int, corner: tuple[float, float], formulation: str, device: torch.device) -> dict:
    """Way and rotation of a block on a slope."""
    h = LONG / cells
    low = (8 + corner[0]) * h, (3 + corner[1]) * h
    shape = softmpm.box(low, (low[0] + LONG, low[1] + LONG), spacing=h / 2)
    material = softmpm.NeoHookean(density=1000.0, young=YOUNG, poisson=0.3, viscosity=4e-3 * YOUNG / 2.6)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(5 * cells, 3 * cells), spacing=h),
        bodies=[softmpm.Body(shape, material)],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=low[1], friction=FRICTION)],
        gravity=(9.81 * math.sin(SLOPE), -9.81 * math.cos(SLOPE)),
        dt=2e-4 if cells <= 16 else 5e-5,
    )
    model = softmpm.build(scene, device=device, formulation=formulation)
    rest, ends = model.rest(), []
    for seconds in (1.0, 0.5):
        start, substeps = ends[-1] if ends else rest, round(seconds / scene.dt)
        ends.append(softmpm.simulate(model, start, None, model.params(), substeps=substeps))
    F = ends[-1].F.double()
    turned = torch.atan2(F[..., 1, 0] - F[..., 0, 1], F[..., 0, 0] + F[..., 1, 1]).mean()
    ways = [1e3 * (end.x - rest.x)[..., 0].double().mean().item() for end in ends]
    row = {"cells": cells, "corner": f"{corner[0]:g}, {corner[1]:g}", "formulation": formulation}
    return row | {"1 s, mm": ways[0], "1.5 s, mm": ways[1], "rotation °": math.degrees(turned)}


def main():
    args = arguments(__doc__)
    table = Table("A soft block that should rest on a slope of 20°", torch.device(args.device), args.json)
    for block in BLOCKS:
        table.add(slope(*block, torch.device(args.device)))


if __name__ == "__main__":
    main()
