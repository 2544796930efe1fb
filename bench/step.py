"""How long is a substep forward? `python bench/step.py [--device cuda] [--json bench/results/step.json]`

One call of `simulate` without gradient, everything in it that a user gets, divided by its substeps; the particles come in random
order, and the cube turns. Median of repeats after a warm-up. ``call`` is what a call costs besides: that of one substep.
"""

import torch
from common import arguments, cube, median_seconds, report, turning

import softmpm

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


def main():
    args = arguments(__doc__)
    device, rows = torch.device(args.device), []
    for dim, particles, nodes in CASES:
        if particles > (args.largest or (64_000 if device.type == "cpu" else particles)):
            continue
        substeps = substeps_of(particles, device)
        for name, features in VARIANTS.items():
            model = softmpm.build(cube(dim, particles, nodes, **features), device=device)
            start, params = turning(model), model.params()
            activation = torch.full((1, 1, 1), 0.2, device=device) if model.muscle_count else None

            def work(substeps, model=model, start=start, activation=activation, params=params):
                with torch.no_grad():
                    softmpm.simulate(model, start, activation, params, substeps=substeps)

            seconds = {n: median_seconds(lambda n=n: work(n), device, args.repeats) for n in (1, substeps)}
            row = {"dim": dim, "particles": model.particle_count, "nodes": nodes, "scene": name}
            figures = {"us/substep": seconds[substeps] / substeps * 1e6, "call us": seconds[1] * 1e6}
            rows.append(row | {"substeps": substeps} | figures)
    report("Forward, float32", rows, device, args.json)


if __name__ == "__main__":
    main()
