"""Threads of a CPU that share a simulation: `python bench/threads.py [--threads 1 2] [--json FILE]`

Microseconds of a substep of the learner's robots at draft and of cubes, in calls that store their states, with their gradient: medians
of rounds in which each number of threads has a turn. ``gain`` is the time with the first number over that with this one, the median of
the quotients within a round, with their quartiles: other work on the machine slows down a whole round. ``cores`` is the processor time
over the duration: below ``threads`` if other processes had a part of the cores.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from common import Table, cube

import softmpm
from softmpm_learn.tasks import BipedConf, ElephantConf, make_task

SUBSTEPS = 460
"""Of a round, at least; those of ten decisions of a robot."""


def of_robot(conf) -> tuple[softmpm.Scene, int, dict]:
    task = make_task(conf)
    return task.scene, task.substeps, task.build


def of_cube(dim: int, particles: int, nodes: int) -> tuple[softmpm.Scene, int, dict]:
    return cube(dim, particles, nodes), 46, {}


CASES: dict[str, Callable[[], tuple[softmpm.Scene, int, dict]]] = {
    "elephant": lambda: of_robot(ElephantConf()),
    "biped": lambda: of_robot(BipedConf()),
    "2D cube": lambda: of_cube(2, 20_000, 192),
    "3D cube": lambda: of_cube(3, 8_000, 32),
}


def seconds(model: softmpm.Model, substeps: int, activation: torch.Tensor | None) -> tuple[float, float]:
    """Duration of the control steps with their gradient, and the cores that were used."""
    params = softmpm.Params(*(p.clone().requires_grad_() for p in model.params()))
    begin, used = time.perf_counter(), time.process_time()
    state = model.rest()
    for _ in range(SUBSTEPS // substeps):
        state = softmpm.simulate(model, state, activation, params, substeps=substeps)
    torch.autograd.grad(state.x.sum(), params)
    duration = time.perf_counter() - begin
    return duration, (time.process_time() - used) / duration


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=21)
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    table = Table("Threads of a CPU [us/substep], float32", torch.device("cpu"), args.json)
    for name, case in CASES.items():
        for formulation in ("moving", "reference"):
            scene, substeps, build = case()
            build = build | {"formulation": formulation}
            models = [softmpm.build(scene, device="cpu", threads=count, **build) for count in args.threads]
            activation = torch.full((1, 1, len(scene.muscles)), 0.3) if scene.muscles else None
            rounds = [
                [seconds(model, substeps, activation) for model in models] for _ in range(args.rounds + 1)
            ][1:]
            for k, threads in enumerate(args.threads):
                gains = [one[0][0] / one[k][0] for one in rounds]
                low, gain, high = statistics.quantiles(gains, n=4) if k else (1.0,) * 3
                row = {"scene": name, "formulation": formulation, "particles": models[0].particle_count}
                row |= {"threads": threads, "us": 1e6 * statistics.median(one[k][0] for one in rounds)}
                row["us"] /= SUBSTEPS // substeps * substeps
                row |= {"gain": gain, "low": low, "high": high}
                table.add(row | {"cores": statistics.median(one[k][1] for one in rounds)})


if __name__ == "__main__":
    main()
