"""What does a gradient through a thousand substeps cost with little memory? `python bench/memory.py [--device cuda] [--json FILE]`

Peak memory of one call and its backward pass, what the formula of docs/memory.md says of it, and the median time of both, against
memory for everything where that fits.
"""

import statistics
import time

import torch
from common import Table, arguments, cube, sync, turning

import softmpm
from softmpm.horizon import Horizon
from softmpm.memory import memory, plan

GIB = 2**30
WARM = 2
"""Calls that do not count: one compiles, the next records graphs."""


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("Gradient with little memory, float32", device, args.json)
    cases = [(64_000, 48, [32, 4, 1, 0.25]), (1_000_000, 96, [60, 5, 3])]
    substeps = 1000
    if device.type == "cpu":
        cases, substeps = [(1_000, 16, [1, 0.01])], 100
    for particles, nodes, budgets in cases:
        for budget in budgets:
            model = softmpm.build(cube(3, particles, nodes), device=device, memory_budget=round(budget * GIB))
            horizon = Horizon(1, substeps)
            chosen = plan(horizon, model.sizes(), model.budget)
            start, params, seconds = turning(model), model.params(), []
            start.v.requires_grad_()
            for _ in range(WARM + args.repeats):
                if device.type == "cuda":
                    torch.cuda.reset_peak_memory_stats()
                sync(device)
                begin = time.perf_counter()
                end = softmpm.simulate(model, start, None, params, substeps=substeps)
                torch.autograd.grad(end.x.sum(), start.v)
                sync(device)
                seconds.append(time.perf_counter() - begin)
                del end
            peak = torch.cuda.max_memory_allocated() if device.type == "cuda" else 0
            table.add(
                {
                    "particles": model.particle_count,
                    "substeps": substeps,
                    "budget GiB": budget,
                    "chunk": chosen.longest,
                    "states kept": chosen.slots or "all",
                    "peak GiB": peak / GIB,
                    "formula GiB": memory(model, horizon).backward / GIB,
                    "forward and backward s": statistics.median(seconds[WARM:]),
                }
            )
            del model, start, params
            if device.type == "cuda":
                torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
