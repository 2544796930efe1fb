"""Restitution of two blocks that meet head-on on the moving grid: `python bench/collisions.py [--device cpu] [--json FILE]`

Two blocks of 0.1 x 0.05 m, cells of 10 mm, E 0.1 MPa (waves of 10 m/s), 30 Pa s, float64, approach each other from a gap of 2.5 cells.
For each relative speed, as a part of the speed of waves, the velocity at which they part over that at which they met:

    symmetric     both move; the answer for every frame of reference, if the grid did not matter
    one moving    the other is at rest, with the contact at four places between two layers of nodes
"""

import dataclasses
import math

import torch
from common import Table, arguments

import softmpm

H, WAVES, GAP = 0.01, 10.0, 2.5
SPEEDS, PLACES = (0.02, 0.05, 0.1, 0.2), (0.0, 0.25, 0.5, 0.75)


def blocks(place: float) -> softmpm.Scene:
    """Two blocks, shifted by ``place`` cells."""
    material = softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3, viscosity=30.0)
    shift = place * H
    bodies = [
        softmpm.Body(softmpm.box((x + shift, 0.1), (x + shift + 0.1, 0.15), spacing=H / 2), material)
        for x in (0.2, 0.3 + GAP * H)
    ]
    scene = softmpm.Scene(grid=softmpm.Grid(shape=(70, 26), spacing=H), bodies=bodies, dt=1e-6)
    return dataclasses.replace(scene, dt=0.5 * float(softmpm.stable_dt(scene)))


def restitution(speed: float, share: float, place: float, device: torch.device) -> float:
    """Relative velocity after three times the approach over that before, where the first block has ``share`` of it."""
    model = softmpm.build(blocks(place), device=device, dtype=torch.float64, formulation="moving")
    params, state, v = model.params(), model.rest(), speed * WAVES
    first = model.body == 0
    state.v[:, first, 0], state.v[:, ~first, 0] = share * v, (share - 1.0) * v
    with torch.no_grad():
        substeps = math.ceil(9 * GAP * H / v / model.scene.dt)
        state = softmpm.simulate(model, state, None, params, substeps=substeps)
    end = softmpm.mean_velocity(model, state, params, per_body=True)[0, :, 0]
    return float(end[1] - end[0]) / v


def main() -> None:
    args = arguments(__doc__ or "")
    device = torch.device(args.device)
    table = Table("Restitution of two blocks on the moving grid", device, args.json)
    for speed in SPEEDS:
        row = {"speed / waves": speed, "symmetric": restitution(speed, 0.5, 0.0, device)}
        table.add(
            row | {f"one moving, {place:g}": restitution(speed, 1.0, place, device) for place in PLACES}
        )


if __name__ == "__main__":
    main()
