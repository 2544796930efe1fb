"""Time of a deterministic substep: `python bench/deterministic.py [--device cuda] [--json FILE]`

Microseconds of a substep, forward and backward with all states retained, of an ordinary and of a deterministic model, and the ratios.
"""

import torch
from common import Table, arguments, cube
from gradient import measure
from step import CASES

import softmpm


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("Determinism, neo-Hookean, float32", device, args.json)
    gpu = device.type == "cuda"
    for dim, particles, nodes in CASES[:-1]:
        if particles > (args.largest or (particles if gpu else 8_000)):
            continue
        substeps = 10 if not gpu else 256 if particles < 500_000 else 32
        row = {"dim": dim, "particles": particles, "substeps": substeps}
        for name, deterministic in (("ordinary", False), ("deterministic", True)):
            settings = {"deterministic": deterministic, "memory_budget": 2**62 if gpu else None}
            model = softmpm.build(cube(dim, particles, nodes), device=device, **settings)
            row[f"{name} forward"], row[f"{name} backward"] = measure(model, substeps, args.repeats)
            del model
            if gpu:
                torch.cuda.empty_cache()
        for way in ("forward", "backward"):
            row[f"{way} ratio"] = row[f"deterministic {way}"] / row[f"ordinary {way}"]
        table.add(row)


if __name__ == "__main__":
    main()
