"""Angular momentum and energy of a spinning body in float32: `python bench/spin.py [--device cuda] [--json FILE]`

A disc (2D) and a cube (3D) turn freely at π/2 rad/s for 10,000 substeps at half the largest stable step, in each law of
bench/extremes/laws.py and in both schemes. ``momentum`` is the relative change of the angular momentum since the start, ``energy`` the
relative difference of the total energy from a run in float64 (which loses a little to the dissipation of the transfers, as expected);
``float64`` is the change of the momentum in that run. The last line is the maximum over all rows.
"""

import dataclasses
import math

import numpy as np
import torch
from common import Table, arguments
from extremes.judges import Exact, Matter, exact
from extremes.laws import LAWS

import softmpm

SUBSTEPS = 10_000
SPACING = 0.04
YOUNGS = (1e4, 1e5, 1e6, 1e7, 1e8)


def main():
    args = arguments(__doc__)
    table = Table("Spin in float32 against float64", torch.device(args.device), args.json)
    worst = {"momentum": 0.0, "energy": 0.0}
    for law in LAWS:
        for dim in (2, 3):
            for young in YOUNGS:
                case = scene(law, dim, young)
                matter = Matter(case)
                start, precise = turn(case, "plain", torch.float64, args.device)
                for scheme in ("plain", "fast"):
                    _, end = turn(case, scheme, torch.float32, args.device)
                    want, got = matter.energy(precise).total, matter.energy(end).total
                    change = {"momentum": spun(matter, start, end), "energy": abs(got - want) / want}
                    row = {"law": law.__name__, "dim": dim, "particles": len(start.x), "young": young}
                    table.add(row | {"scheme": scheme} | change | {"float64": spun(matter, start, precise)})
                    worst = {name: max(worst[name], change[name]) for name in worst}
    print(f"worst: angular momentum {worst['momentum']:.2g}, energy {worst['energy']:.2g}")


def scene(law: type, dim: int, young: float) -> softmpm.Scene:
    """A free disc of 316 or cube of 512 particles, two a cell along each axis."""
    middle = np.full(dim, 6.5 * SPACING)
    if dim == 2:
        particles = softmpm.ball(middle, 5 * SPACING, SPACING / 2)
    else:
        particles = softmpm.box(middle - 2 * SPACING, middle + 2 * SPACING, SPACING / 2)
    body = softmpm.Body(particles, law(density=1000.0, young=young))
    free = softmpm.Scene(grid=softmpm.Grid(shape=(14,) * dim, spacing=SPACING), bodies=[body], dt=1.0)
    return dataclasses.replace(free, dt=0.5 * softmpm.stable_dt(free))


def turn(case: softmpm.Scene, scheme: str, dtype: torch.dtype, device: str) -> tuple[Exact, Exact]:
    """The start, turning rigidly, and the end."""
    model = softmpm.build(case, device=device, dtype=dtype, scheme=scheme)
    start = model.rest()
    start.C[..., 0, 1], start.C[..., 1, 0] = -math.pi / 2, math.pi / 2
    arm = start.x - start.x.mean(dim=1, keepdim=True)
    start.v[:] = (start.C @ arm[..., None])[..., 0]
    end = softmpm.simulate(model, start, None, model.params(), substeps=SUBSTEPS)
    return exact(start), exact(end)


def spun(matter: Matter, start: Exact, end: Exact) -> float:
    """Relative change of the angular momentum."""
    before, after = matter.angular_momentum(start), matter.angular_momentum(end)
    return float(np.linalg.norm(after - before) / np.linalg.norm(before))


if __name__ == "__main__":
    main()
