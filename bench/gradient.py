"""Time of a substep and of its adjoint: `python bench/gradient.py [--device cuda] [--json bench/results/gradient.json]`

Forward pass with gradient and backward pass of one call, each divided by the number of substeps; medians after a warm-up. ``kept``:
the budget suffices for all states, so nothing is recomputed. ``again``: a call with more substeps, as in a long gradient, and a budget
of a fifth of all states, so that the backward pass recomputes the substeps; its time includes the recomputation. The cube falls.
Gradients: of the activation where the scene has muscles, of the materials only in the rows named accordingly.
"""

import time

import torch
from common import Table, arguments, cube, sync, turning
from step import CASES, ON_A_CPU, VARIANTS

import softmpm
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import plan

GRADIENTS = VARIANTS | {"neo-Hookean, materials": {}, "neo-Hookean, turning": {}}


def substeps_of(particles: int, device: torch.device) -> dict[str, int]:
    """Substeps of each measurement; all retained states must fit into the memory of the device."""
    if device.type == "cpu":
        return {"kept": 50, "again": 50}
    kept = 512 if particles < 500_000 else 64 if particles < 5_000_000 else 32
    return {"kept": kept, "again": 256 if particles > 5_000_000 else 512}


def seconds(
    model: softmpm.Model,
    start: softmpm.State,
    activation: torch.Tensor | None,
    params: softmpm.Params,
    substeps: int,
) -> tuple[float, float]:
    """Of a call that stores its states, and of its backward pass."""
    sync(model.device)
    begin = time.perf_counter()
    end = softmpm.simulate(model, start, activation, params, substeps=substeps)
    sync(model.device)
    middle = time.perf_counter()
    end.x.sum().backward()
    sync(model.device)
    return middle - begin, time.perf_counter() - middle


def measure(
    model, substeps: int, repeats: int, *, materials: bool = False, turns: bool = False
) -> tuple[float, float]:
    """Median microseconds of a substep, forward and backward."""
    device, start = model.device, turning(model) if turns else model.rest()
    start.v.requires_grad_()
    params = softmpm.Params(*(p.requires_grad_(materials) for p in model.params()))
    shape = (1, model.worlds, model.muscle_count)
    activation = torch.full(shape, 0.2, device=device, requires_grad=True) if model.muscle_count else None
    times = [seconds(model, start, activation, params, substeps) for _ in range(repeats + 1)]
    ahead, back = (sorted(way)[repeats // 2] / substeps * 1e6 for way in zip(*times[1:], strict=True))
    return ahead, back


def main():
    args = arguments(__doc__, scenes=GRADIENTS)
    device = torch.device(args.device)
    table = Table("Forward and backward [us/substep], float32", device, args.json)
    for dim, particles, nodes in ON_A_CPU if device.type == "cpu" else CASES:
        if particles > (args.largest or particles):
            continue
        for name, features in GRADIENTS.items():
            if name not in args.scenes:
                continue
            scene = cube(dim, particles, nodes, **features)
            row, sizes = {"dim": dim, "particles": None, "nodes": nodes, "scene": name}, None
            for kind, substeps in substeps_of(particles, device).items():
                budget = 2**62 if kind == "kept" else plan(Horizon(1, substeps), sizes, 2**62).kept // 5
                model = softmpm.build(scene, device=device, memory_budget=budget, scheme=args.scheme)
                row["particles"], sizes = model.particle_count, model.sizes()
                figures = measure(
                    model, substeps, args.repeats, materials="materials" in name, turns="turning" in name
                )
                row |= {
                    f"{kind}, substeps": substeps,
                    f"forward, {kind}": figures[0],
                    f"backward, {kind}": figures[1],
                }
                del model
                if device.type == "cuda":
                    torch.cuda.empty_cache()
            table.add(row)


if __name__ == "__main__":
    main()
