"""Time of a forward substep: `python bench/step.py [--device cuda] [--json bench/results/step.json]`

The marginal time of one substep in a call of `simulate` without gradient. It includes all checks, re-sorting and the work between
chunks. Particles are given in random order. In the first column the cube falls; in the second it also turns at 2 rad/s, so that its
particles change cells continually. ``call`` is the time of a call with a single substep, that is the overhead of a call. Medians of
repeats after a warm-up.
"""

import torch
from common import Table, arguments, cube, median_seconds, turning

import softmpm

ON_A_CPU = [(2, 3_025, 96), (2, 6_400, 128), (3, 8_000, 32)]
CASES = [(2, 6_400, 128), (3, 8_000, 32), (3, 64_000, 48), (3, 1_000_000, 96), (3, 8_000_000, 160)]
VARIANTS = {
    "neo-Hookean": {},
    "fixed corotated": {"law": softmpm.FixedCorotated},
    "muscle": {"muscles": True},
    "friction floor": {"floor": True},
}


def substeps_of(particles: int, device: torch.device) -> int:
    if device.type == "cpu":
        return 50
    return 1000 if particles < 500_000 else 200 if particles < 5_000_000 else 60


@torch.no_grad()
def run(model: softmpm.Model, start: softmpm.State, params: softmpm.Params, substeps: int) -> None:
    activation = (
        torch.full((1, model.worlds, model.muscle_count), 0.2, device=model.device)
        if model.muscle_count
        else None
    )
    softmpm.simulate(model, start, activation, params, substeps=substeps)


def main():
    args = arguments(__doc__, scenes=VARIANTS)
    device = torch.device(args.device)
    table = Table("Forward, float32", device, args.json)
    for dim, particles, nodes in ON_A_CPU if device.type == "cpu" else CASES:
        if particles > (args.largest or particles):
            continue
        substeps = substeps_of(particles, device)
        for name, features in VARIANTS.items():
            if name not in args.scenes:
                continue
            model = softmpm.build(cube(dim, particles, nodes, **features), device=device, scheme=args.scheme)
            params = model.params()
            row = {"dim": dim, "particles": model.particle_count, "nodes": nodes, "scene": name}
            row["substeps"] = substeps
            for motion, start in (("falling us", model.rest()), ("turning us", turning(model))):
                given = model, start, params
                call = median_seconds(lambda g=given: run(*g, 1), device, args.repeats)
                whole = median_seconds(lambda g=given, n=substeps: run(*g, n), device, args.repeats)
                row[motion], row["call us"] = (whole - call) / (substeps - 1) * 1e6, call * 1e6
            table.add(row)
            del model, start, params, given


if __name__ == "__main__":
    main()
