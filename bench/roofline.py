"""How far from the memory's speed is a substep? `python bench/roofline.py [--device cuda] [--json bench/results/roofline.json]`

The copy bandwidth of the device, measured here, against the bytes that a forward substep of the cases of bench/step.py must move
at least: every state read and written once, the material of a particle read once (16 B: volume, mass, μ, λ), momentum and velocity of
the nodes in memory once (a little less is enough: velocities of empty nodes are not written).
The reads of the grid by 3^dim nodes a particle, and all atomic additions, are taken to cost nothing. `floor us` is the time of these
bytes at copy speed, `times floor` how often it fits into the measured substep. A scene that fits into the caches may beat its floor.
"""

import torch
from common import Table, arguments, cube, median_seconds
from step import CASES, run, substeps_of

import softmpm

MATERIAL_BYTES = 16
"""Volume, mass, μ and λ of a particle in float32 [B]."""


def copy_bandwidth(device: torch.device, repeats: int) -> float:
    """Bytes read and written per second by a copy far larger than any cache."""
    size = 2**31 if device.type == "cuda" else 2**28
    source = torch.zeros(size, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    return 2 * size / median_seconds(lambda: target.copy_(source), device, max(repeats, 5))


def least_bytes(model: softmpm.Model) -> int:
    """What a forward substep has to move [B]."""
    particles, sizes = model.worlds * model.particle_count, model.sizes()
    return 2 * sizes.inside + MATERIAL_BYTES * particles + 2 * sizes.nodes


def seconds(model: softmpm.Model, repeats: int) -> float:
    """Of one forward substep more, everything in it that a user gets."""
    given, substeps = (model, model.rest(), model.params()), substeps_of(model.particle_count, model.device)
    one, all_of_them = (
        median_seconds(lambda n=n: run(*given, n), model.device, repeats) for n in (1, substeps)
    )
    return (all_of_them - one) / (substeps - 1)


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    bandwidth = copy_bandwidth(device, args.repeats)
    table = Table(f"Forward against a copy at {bandwidth / 1e9:.0f} GB/s, float32", device, args.json)
    for dim, particles, nodes in CASES:
        if particles > (args.largest or (8_000 if device.type == "cpu" else particles)):
            continue
        model = softmpm.build(cube(dim, particles, nodes), device=device)
        least = least_bytes(model)
        floor, taken = least / bandwidth, seconds(model, args.repeats)
        row = {"dim": dim, "particles": model.particle_count, "nodes": nodes, "MB": least / 1e6}
        row |= {"floor us": floor * 1e6, "us/substep": taken * 1e6, "copy GB/s": bandwidth / 1e9}
        table.add(row | {"times floor": taken / floor})


if __name__ == "__main__":
    main()
