"""Depth of surface points under a wall, over the way of a pressure wave in a substep: `python bench/contact_depth.py`

Blocks of 8 x 8 cells that hit a floor, and blocks whose weight is put down at once, at several steps; float64, reference formulation.
"""

import dataclasses

import torch

import softmpm

CELL, YOUNG, POISSON = 1 / 32, 1e3, 0.3
WAVE = (
    YOUNG * (1 - POISSON) / ((1 + POISSON) * (1 - 2 * POISSON))
) ** 0.5  # √((λ + 2μ)/ρ) for a density of 1
FLOOR = 3.9 * CELL


def depth(part: float, speed: float = 0.0, weight: float = 0.0) -> tuple[float, str]:
    """Largest depth at ``part`` of the stable step; speed over that of the wave, weight over E; and the end of the run."""
    shape = softmpm.box((6 * CELL, 4 * CELL), (14 * CELL, 12 * CELL), spacing=CELL / 2)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(24, 40), spacing=CELL),
        bodies=[softmpm.Body(shape, softmpm.NeoHookean(density=1.0, young=YOUNG, poisson=POISSON))],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=FLOOR, friction=0.5)],
        gravity=(0.0, -weight * YOUNG / (8 * CELL)),
        dt=1.0,
    )
    scene = dataclasses.replace(scene, dt=part * softmpm.stable_dt(scene))
    settings = dict(device="cpu", dtype=torch.float64, formulation="reference")
    model = softmpm.build(scene, alarms=softmpm.Alarms(depth=None), **settings)
    state, deepest = model.rest(), 0.0
    state.v[..., 1] = -speed * WAVE
    for _ in range(int(80 / part)):
        try:
            state = softmpm.simulate(model, state, None, model.params(), substeps=1)
        except softmpm.UnstableError as error:
            return deepest, error.kind
        height = softmpm.contact_forces(model, state).points[..., 1] - FLOOR
        deepest = max(deepest, -height.min().item() / (scene.dt * WAVE))
    return deepest, "right"


def main() -> None:
    print("load            dt over stable   depth   end")
    for name, loads in (("speed", (0.05, 0.2, 0.5)), ("weight", (0.025, 0.25, 0.75))):
        for load in loads:
            for part in (0.9, 0.5, 0.1):
                found, end = depth(part, **{name: load})
                print(f"{name:7}{load:5g}{part:12g}{found:12.3f}   {end}", flush=True)


if __name__ == "__main__":
    main()
