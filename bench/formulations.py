"""Both formulations on one body: `python bench/formulations.py [--device cuda] [--json bench/results/formulations.h200.json]`

Microseconds of a substep in calls without gradient, in calls that store their states, and of the backward pass; medians after a
warm-up, the two formulations in turn. ``kept``: bytes that a gradient keeps for each substep. A cube on a lattice, without walls;
``ratio`` is the moving formulation's time over that of the reference formulation.
"""

import time

import torch
from common import Table, arguments, cube, sync
from gradient import measure, substeps_of

import softmpm

CASES = [(3, 8_000, 32), (3, 64_000, 48), (3, 1_000_000, 96)]
ON_A_CPU = [(2, 3_000, 96), (2, 20_000, 192), (3, 8_000, 32)]


def forward(model: softmpm.Model, substeps: int, repeats: int) -> float:
    """Median microseconds of a substep without gradient."""
    start, params, times = model.rest(), model.params(), []
    for _ in range(repeats + 1):
        sync(model.device)
        begin = time.perf_counter()
        with torch.no_grad():
            softmpm.simulate(model, start, None, params, substeps=substeps)
        sync(model.device)
        times.append(time.perf_counter() - begin)
    return sorted(times[1:])[repeats // 2] / substeps * 1e6


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("Two formulations [us/substep], float32", device, args.json)
    for dim, particles, nodes in ON_A_CPU if device.type == "cpu" else CASES:
        if particles > (args.largest or particles):
            continue
        substeps, found = substeps_of(particles, device)["kept"], {}
        for formulation in ("moving", "reference"):
            scene = cube(dim, particles, nodes)
            model = softmpm.build(scene, device=device, formulation=formulation, memory_budget=2**62)
            ahead, back = measure(model, substeps, args.repeats)
            sizes = model.sizes()
            kept = sizes.inside + sizes.nodes
            found[formulation] = forward(model, substeps, args.repeats), ahead, back, kept
            row = dict(zip(("forward", "stored", "backward", "kept"), found[formulation], strict=True))
            row["kept"] = int(kept)
            table.add(dict(dim=dim, particles=particles, formulation=formulation) | row)
        ratios = [one / other for one, other in zip(*found.values(), strict=True)]
        row = dict(zip(("forward", "stored", "backward", "kept"), ratios, strict=True))
        table.add(dict(dim=dim, particles=particles, formulation="ratio") | row)


if __name__ == "__main__":
    main()
