"""Time of each feature of a scene: `python bench/features.py [--device cuda] [--json FILE]`

Microseconds of a substep, forward and backward with all states retained, and their ratio to a scene that consists of a neo-Hookean cube
only. Features that a scene lacks are not compiled (tests/softmpm/test_model.py), so an absent feature costs nothing. The last rows
place the same cube in grids that are mostly empty.
"""

import torch
from common import Table, arguments, cube
from gradient import measure

import softmpm

BARE = {"gravity": None}
FLOOR = {"normal": (0.0, 1.0, 0.0), "offset": 0.3}
FEATURES = {
    "nothing": BARE,
    "gravity": {},
    "damping": BARE | {"damping": 0.1},
    "wall": BARE | {"walls": [softmpm.Wall(**FLOOR, contact="slip")]},
    "wall with friction": BARE | {"walls": [softmpm.Wall(**FLOOR, friction=0.5)]},
    "six walls with friction": BARE
    | {
        "walls": [
            softmpm.Wall(normal=tuple(s * (a == axis) for a in range(3)), offset=s * 0.5 - 0.4, friction=0.5)
            for axis in range(3)
            for s in (1.0, -1.0)
        ]
    },
    "muscle": BARE | {"muscles": True},
    "fixed corotated": BARE | {"law": softmpm.FixedCorotated},
    "grid of 256³": BARE | {"domain": 256},
    "grid of 1024³": BARE | {"domain": 1024},
}


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    gpu = device.type == "cuda"
    particles, nodes, substeps = (64_000, 48, 512) if gpu else (1_000, 16, 20)
    table = Table(f"Features, 3D, {particles} particles, float32", device, args.json)
    for name, features in FEATURES.items():
        model = softmpm.build(
            cube(3, particles, nodes, **features), device=device, memory_budget=2**62 if gpu else None
        )
        ahead, back = measure(model, substeps, args.repeats)
        row = {"scene": name, "forward us": ahead, "backward us": back}
        first = table.rows[0] if table.rows else row
        for way in ("forward", "backward"):
            row[f"{way} ratio"] = row[f"{way} us"] / first[f"{way} us"]
        table.add(row)
        del model
        if gpu:
            torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
