"""Forward substep relative to memory bandwidth: `python bench/roofline.py [--device cuda] [--json bench/results/roofline.json]`

Compares a forward substep of the cases of bench/step.py with the time to move the least number of bytes, at the measured copy bandwidth
of the device: every state is read and written once, the material of a particle is read once (16 B: volume, mass, μ, λ), and momentum
and velocity of the allocated nodes are moved once (slightly too much, since velocities of empty nodes are not written). Reads of 3^dim
nodes per particle and all atomic additions are neglected. `floor us` is the time of these bytes at copy speed, `times floor` the ratio
of the measured time to it. A scene that fits into the caches may be faster than its floor.
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
    """Least number of bytes that a forward substep moves."""
    particles, sizes = model.worlds * model.particle_count, model.sizes()
    return 2 * sizes.inside + MATERIAL_BYTES * particles + 2 * sizes.nodes


def seconds(model: softmpm.Model, repeats: int) -> float:
    """Marginal time of a forward substep, including checks and re-sorting [s]."""
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
