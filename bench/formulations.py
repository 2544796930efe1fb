"""Both formulations on one body: `python bench/formulations.py [--device cpu --threads 1 2] [--json FILE]`

Microseconds of a substep in calls without gradient, in calls that store their states, and of the backward pass; medians after a
warm-up, the two formulations in turn. ``kept``: bytes that a gradient keeps for each substep. A cube on a lattice, without walls;
``ratio`` is the moving formulation's time over that of the reference formulation. On a CPU the reference formulation runs with
each number of threads; ``gain`` is its time with the first over that with this number, and ``cores`` the processor time of a call
without gradient over its duration: below ``threads`` if other processes had a part of the cores.
"""

import time

import torch
from common import Table, arguments, cube, sync
from gradient import measure, substeps_of

import softmpm

CASES = [(3, 8_000, 32), (3, 64_000, 48), (3, 1_000_000, 96)]
ON_A_CPU = [(2, 3_000, 96), (2, 20_000, 192), (3, 8_000, 32)]


def forward(model: softmpm.Model, substeps: int, repeats: int) -> tuple[float, float]:
    """Median microseconds of a substep without gradient, and the cores that were used."""
    start, params, times = model.rest(), model.params(), []
    for _ in range(repeats + 1):
        sync(model.device)
        begin, used = time.perf_counter(), time.process_time()
        with torch.no_grad():
            softmpm.simulate(model, start, None, params, substeps=substeps)
        sync(model.device)
        times.append((time.perf_counter() - begin, time.process_time() - used))
    median, used = sorted(times[1:])[repeats // 2]
    return median / substeps * 1e6, used / median


def main():
    args = arguments(__doc__, threads=True)
    device = torch.device(args.device)
    table = Table("Two formulations [us/substep], float32", device, args.json)
    runs = [("moving", args.threads[0]), *(("reference", count) for count in args.threads)]
    for dim, particles, nodes in ON_A_CPU if device.type == "cpu" else CASES:
        if particles > (args.largest or particles):
            continue
        substeps, found = substeps_of(particles, device)["kept"], []
        for formulation, threads in runs:
            torch.set_num_threads(threads)
            scene = cube(dim, particles, nodes)
            model = softmpm.build(scene, device=device, formulation=formulation, memory_budget=2**62)
            ahead, back = measure(model, substeps, args.repeats)
            sizes, (alone, cores) = model.sizes(), forward(model, substeps, args.repeats)
            found.append((alone, ahead, back, int(sizes.inside + sizes.nodes)))
            add(table, dim, particles, formulation, threads, found[-1], cores)
        for k in range(1, len(runs)):
            kind, base = ("ratio", found[0]) if k == 1 else ("gain", found[1])
            ratios = tuple(one / other for one, other in zip(base, found[k], strict=True))
            add(table, dim, particles, kind, runs[k][1], ratios, 0.0)


def add(
    table: Table, dim: int, particles: int, kind: str, threads: int, found: tuple[float, ...], cores: float
) -> None:
    row = dict(zip(("forward", "stored", "backward", "kept"), found, strict=True))
    table.add(dict(dim=dim, particles=particles, formulation=kind, threads=threads) | row | dict(cores=cores))


if __name__ == "__main__":
    main()
