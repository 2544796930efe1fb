"""Throughput of many small robots in one launch: `python bench/worlds.py [--device cuda] [--json FILE]`

Millions of particles and substeps per second, forward and backward, with all states retained; ``share`` is the throughput relative to
that of the first row, one scene with as many particles as 64 worlds.
"""

import torch
from common import Table, arguments, cube
from gradient import measure

import softmpm


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("Worlds in one launch, 3D neo-Hookean, float32", device, args.json)
    gpu = device.type == "cuda"
    small, large = (8_000, 512_000) if gpu else (1_000, 8_000)
    cases = [(1, large, 96 if gpu else 32)] + [(n, small, 32) for n in ((1, 8, 64, 256) if gpu else (1, 8))]
    substeps = 64 if gpu else 10
    for worlds, particles, nodes in cases:
        model = softmpm.build(
            cube(3, particles, nodes), device=device, worlds=worlds, memory_budget=2**62 if gpu else None
        )
        total = worlds * model.particle_count
        ahead, back = measure(model, substeps, args.repeats)
        speed = {"forward M/s": total / ahead, "backward M/s": total / back}
        first = table.rows[0] if table.rows else speed
        share = {f"{way} share": speed[f"{way} M/s"] / first[f"{way} M/s"] for way in ("forward", "backward")}
        table.add({"worlds": worlds, "particles": model.particle_count} | speed | share)
        del model
        if gpu:
            torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
