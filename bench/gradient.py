"""How long is a substep backward? `python bench/gradient.py [--device cuda] [--json bench/results/gradient.json]`

Forward with gradient and backward of one call, divided by its substeps, recomputation included; medians after a warm-up.
Activation and material get gradients where the scene has them.
"""

import time

import torch
from common import arguments, cube, median_seconds, report, sync
from step import CASES, VARIANTS

import softmpm


def main():
    args = arguments(__doc__)
    device, rows = torch.device(args.device), []
    substeps = 20 if device.type == "cpu" else 100
    for dim, particles, nodes in CASES[:-1]:
        if particles > (args.largest or (8_000 if device.type == "cpu" else particles)):
            continue
        for name, features in VARIANTS.items():
            model = softmpm.build(cube(dim, particles, nodes, **features), device=device)
            start, params = model.rest(), softmpm.Params(*(p.requires_grad_() for p in model.params()))
            activation = (
                torch.full((1, 1, 1), 0.2, device=device, requires_grad=True) if model.muscle_count else None
            )
            forward = []

            def work(model=model, start=start, activation=activation, params=params, forward=forward):
                begin = time.perf_counter()
                end = softmpm.simulate(model, start, activation, params, substeps=substeps)
                sync(device)
                forward.append(time.perf_counter() - begin)
                end.x.sum().backward()

            both = median_seconds(work, device, args.repeats)
            ahead = sorted(forward[1:])[len(forward[1:]) // 2]
            us = [t / substeps * 1e6 for t in (ahead, both - ahead)]
            row = {"dim": dim, "particles": model.particle_count, "nodes": nodes, "scene": name}
            rows.append(row | {"forward us/substep": us[0], "backward us/substep": us[1]})
    report("Forward and backward, float32", rows, device, args.json)


if __name__ == "__main__":
    main()
