"""Kernels that begin before the previous one has ended, against kernels that do not: `python bench/dependent.py [--json FILE]`

Microseconds of one more substep in a call that stores its states, and of one more together with its adjoint: from the difference
between a long and a short call, medians. ``ratio``: with kernels that begin early over without, which take turns.
"""

import statistics
from unittest.mock import patch

import torch
from common import Table, arguments, cube
from episode import NODES, SURFACE, VISCOUS, task_of
from gradient import seconds

import softmpm
from softmpm.schemes import launch

SHORT, LONG = 128, 256
"""Substeps of the two calls."""
CONTACTS = {"moving, nodes": NODES, "moving, surface points": SURFACE}
REFERENCE = "reference, surface points"
CUBES = {8_000: 32, 1_000_000: 96}
"""Particles, and nodes along an axis."""


def cases():
    """Name, formulation and contact, scene, and settings of its model."""
    for robot in ("biped", "elephant"):
        for name, settings in (CONTACTS | {REFERENCE: SURFACE | {"formulation": "reference"}}).items():
            task = task_of(robot, 128, 0.0125, LONG, VISCOUS | settings)
            yield robot, name, task.scene, task.build
    for particles, nodes in CUBES.items():
        for formulation in ("moving", "reference"):
            settings = {"formulation": formulation, "memory_budget": 2**62}
            yield f"cube, {particles:,}", formulation, cube(3, particles, nodes, on_knots=True), settings


def durations(model: softmpm.Model, substeps: int) -> tuple[float, float]:
    """Seconds of a call, and of one with its backward pass."""
    params = softmpm.Params(*(value.clone().requires_grad_() for value in model.params()))
    activation = torch.full((1, model.worlds, model.muscle_count), 0.2, device=model.device)
    ahead, back = seconds(model, model.rest(), activation, params, substeps)
    return ahead, ahead + back


def microseconds(model: softmpm.Model) -> list[float]:
    """Of one more substep, without and with its adjoint."""
    pairs = zip(*(durations(model, substeps) for substeps in (SHORT, LONG)), strict=True)
    return [1e6 * (long - short) / (LONG - SHORT) for short, long in pairs]


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    if device.type != "cuda":
        raise SystemExit(
            "kernels that begin early need a GPU: bench/dependent.py has nothing to compare here."
        )
    table = Table("Kernels that begin before the previous one has ended, float32", device, args.json)
    for name, form, scene, settings in cases():
        early, late = (softmpm.build(scene, device=device, **settings) for _ in range(2))
        microseconds(early)  # captures its graphs
        with patch.object(launch, "begin_early", lambda graph, waiting: 0):
            microseconds(late)
        rounds = [[microseconds(model) for model in (early, late)] for _ in range(3 * args.repeats)]
        row = {"scene": name, "form": form, "particles": early.particle_count}
        for k, what in enumerate(("forward", "both")):
            found = [statistics.median(times[k] for times in one) for one in zip(*rounds, strict=True)]
            row |= {what: found[0], f"{what}, late": found[1], f"{what}, ratio": found[0] / found[1]}
        table.add(row)


if __name__ == "__main__":
    main()
