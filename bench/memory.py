"""Memory and time of a gradient through a thousand substeps: `python bench/memory.py [--device cuda] [--json FILE]`

Peak memory of one call, or of a closed loop of calls, with its backward pass; the prediction of the formula in docs/memory.md; and the
median time, compared with a budget for all states where these fit.
"""

import statistics
import time

import torch
from common import Table, arguments, cube, sync, turning

import softmpm
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import memory, plan

GIB = 2**30
WARM = 2
"""Warm-up calls: the first compiles kernels, the second captures graphs."""


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("Gradient with little memory, float32", device, args.json)
    cases = [(64_000, 48, 1, [32, 4, 1, 0.25]), (1_000_000, 96, 1, [60, 5, 3]), (64_000, 48, 25, [32, 4, 1])]
    substeps = 1000
    if device.type == "cpu":
        cases, substeps = [(1_000, 16, 1, [1, 0.01]), (1_000, 16, 5, [1, 0.01])], 100
    for particles, nodes, calls, budgets in cases:
        for budget in budgets:
            scene, limit = cube(3, particles, nodes), round(budget * GIB)
            model = softmpm.build(scene, device=device, memory_budget=limit, calls=calls)
            horizon = Horizon(1, substeps // calls)
            chosen = plan(horizon, model.sizes(), model.budget)
            start, params, seconds = turning(model), model.params(), []
            start.v.requires_grad_()
            for _ in range(WARM + args.repeats):
                if device.type == "cuda":
                    torch.cuda.reset_peak_memory_stats()
                sync(device)
                begin = time.perf_counter()
                end = start
                for _ in range(calls):
                    end = softmpm.simulate(model, end, None, params, substeps=horizon.total)
                torch.autograd.grad(end.x.sum(), start.v)
                sync(device)
                seconds.append(time.perf_counter() - begin)
                del end
            peak = torch.cuda.max_memory_allocated() / GIB if device.type == "cuda" else "not measured"
            table.add(
                {
                    "particles": model.particle_count,
                    "calls": calls,
                    "substeps": substeps,
                    "budget GiB": budget,
                    "chunk": chosen.longest,
                    "states kept": chosen.checkpoints or "all",
                    "peak GiB": peak,
                    "formula GiB": memory(model, horizon).backward / GIB,
                    "forward and backward s": statistics.median(seconds[WARM:]),
                }
            )
            del model, start, params
            if device.type == "cuda":
                torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
