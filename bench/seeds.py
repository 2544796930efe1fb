"""Time of several seeds side by side in one simulation, against that of one seed.

    python bench/seeds.py [--seeds 1 2 5 10] [--iterations 21] [--save-every 1] [--device cuda] [--json bench/results/seeds.json]

The elephant learns with the default settings, on a GPU at standard resolution, on a CPU at draft for 0.4 s; without recording and
examination. ``whole`` is the time of all iterations but the first, which compiles and captures: episodes, learning, checkpoints.
``ratio`` is that over the whole of the first row; ``episode`` is a median, ``learn`` and ``save`` are sums. Early stopping gives seeds
phases of different lengths: ``epochs`` counts the epochs of all of them.
"""

import argparse
import csv
import statistics
import tempfile
from pathlib import Path

import torch
from common import Table

import softmpm
from softmpm_learn.command.seeds import split
from softmpm_learn.design import declared_inputs
from softmpm_learn.settings import Settings, TrainConf
from softmpm_learn.tasks import ElephantConf, Resolution, Task, make_task
from softmpm_learn.train import Plan, train_side_by_side


def columns(path: Path, names: list[str]) -> dict[str, list[float]]:
    """Columns of a table without its first row."""
    with open(path, newline="") as file:
        _, *rows = csv.DictReader(file)
    return {name: [float(row[name] or 0.0) for row in rows] for name in names}


def seconds(task: Task, settings: Settings, device: torch.device, out: Path) -> dict[str, float]:
    """Times of the seeds of these settings [s]."""
    conf = split(settings)
    inputs, worlds = declared_inputs(settings.design), len(conf) * settings.train.worlds
    built = dict(worlds=worlds, inputs=inputs, calls=task.control_steps)
    model = softmpm.build(task.scene, device=device, **built, **task.build)
    plans = [Plan(settings=one, out=out / str(one.train.seed)) for one in conf]
    train_side_by_side(task, model, plans)
    times = columns(plans[0].out / "timing.csv", ["episode", "learn", "save"])
    epochs = sum(sum(columns(plan.out / "metrics.csv", ["epochs"])["epochs"]) for plan in plans)
    return {
        "whole s": sum(map(sum, times.values())),
        "episode ms": 1e3 * statistics.median(times["episode"]),
        "learn s": sum(times["learn"]),
        "save s": sum(times["save"]),
        "epochs": int(epochs),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 5, 10])
    parser.add_argument("--iterations", type=int, default=21)
    parser.add_argument("--save-every", type=int, default=1, help="iterations between two checkpoints")
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    args = parser.parse_args()
    device = torch.device(args.device)
    if device.type == "cuda":
        task = make_task(ElephantConf(resolution=Resolution.standard))
    else:
        task = make_task(ElephantConf(resolution=Resolution.draft, seconds=0.4))
    table, first = Table("Seeds side by side, float32", device, args.json), None
    for count in args.seeds:
        train = TrainConf(
            iterations=args.iterations,
            seeds=count,
            save_every=args.save_every,
            record_every=0,
            examine=False,
        )
        settings = Settings(train=train)
        with tempfile.TemporaryDirectory() as folder:
            found = seconds(task, settings, device, Path(folder))
        first = first or found["whole s"]
        table.add({"seeds": count, **found, "ratio": found["whole s"] / first})


if __name__ == "__main__":
    main()
