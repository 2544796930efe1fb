"""How long is a substep forward? `python bench/step.py [--device cuda] [--json bench/results/step.json]`

One call of `simulate` without gradient, checks on, divided by its substeps; median of repeats after a warm-up.
"""

import torch
from common import arguments, cube, median_seconds, report

import softmpm

CASES = [(2, 6_400, 128), (3, 8_000, 32), (3, 64_000, 48), (3, 1_000_000, 96), (3, 8_000_000, 160)]
VARIANTS = {
    "neo-Hookean": {},
    "fixed corotated": {"law": softmpm.FixedCorotated},
    "muscle": {"muscles": True},
    "friction floor": {"floor": True},
}


def main():
    args = arguments(__doc__)
    device, rows = torch.device(args.device), []
    substeps = 20 if device.type == "cpu" else 100
    for dim, particles, nodes in CASES:
        if particles > (args.largest or (64_000 if device.type == "cpu" else particles)):
            continue
        for name, features in VARIANTS.items():
            model = softmpm.build(cube(dim, particles, nodes, **features), device=device)
            start, params = model.rest(), model.params()
            activation = torch.full((1, 1, 1), 0.2, device=device) if model.muscle_count else None

            def work(model=model, start=start, activation=activation, params=params):
                with torch.no_grad():
                    softmpm.simulate(model, start, activation, params, substeps=substeps)

            us = median_seconds(work, device, args.repeats) / substeps * 1e6
            rows.append(
                {
                    "dim": dim,
                    "particles": model.particle_count,
                    "nodes": nodes,
                    "scene": name,
                    "us/substep": us,
                }
            )
    report("Forward, float32", rows, device, args.json)


if __name__ == "__main__":
    main()
