"""Speed-up of a training run on several GPUs: `python bench/scale.py [--device cuda] [--json bench/results/scale.json]`

In each world an arm reaches for a different goal. The same run is started by torchrun with 1, 2, 4 and 8 processes that share its
worlds, as far as there are GPUs (1 and 2 on a CPU). Seconds of an iteration, from timing.csv without its first rows:

    episode     simulation, gradient and its mean over the processes, which is the shared work; the median
    alone       `learn` and `save`, during which all processes wait for the first: velocity images, autoencoder, checkpoint; the mean,
                since one iteration in five has a learning phase. With `centroids` there are no images and no autoencoder

``shared`` is the speed-up of the episode over one process, ``speed-up`` and ``efficiency`` are those of both columns together. No
recording is written. ``loss apart`` is the largest relative difference of an iteration's loss from that of one process. In float64 it
must not exceed rounding, or the benchmark fails. In float32 the sums of a GPU differ from run to run, and autoencoder training
amplifies the difference: two runs of a single process differ as much.
"""

import csv
import statistics
import sys
import tempfile
from pathlib import Path

import torch
from common import Table, arguments, train

from softmpm_learn.tasks.arm import ArmConf, arm
from softmpm_learn.tasks.task import Resolution

CASES = [
    ("centroids", "float32", 64, 0.5),
    ("latent", "float32", 64, 0.5),
    ("latent", "float64", 64, 0.05),
    ("centroids", "float32", 256, 0.1),
]
"""Observer, precision, worlds, and seconds of an episode."""
ON_A_CPU = [("centroids", "float64", 16, 0.025), ("latent", "float64", 16, 0.025)]
WARM, ITERATIONS = 3, 13
"""Warm-up iterations, which compile and capture, and all iterations; the ten that count contain two learning phases."""
SAME = 1e-5
"""Tolerance in float64: far above rounding after a few iterations, far below the difference of a wrong result."""


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    gpu = device.type == "cuda"
    most = torch.cuda.device_count() if gpu else 2
    table = Table("Learning on several processes", device, args.json)
    resolution = Resolution.fine if gpu else Resolution.draft
    size = len(arm(ArmConf(resolution=resolution)).scene.bodies[0].particles.positions)
    for observer, precision, worlds, seconds in CASES if gpu else ON_A_CPU:
        if worlds * size > (args.largest or worlds * size):
            continue
        words = [
            *("task=arm", f"task.resolution={resolution.name}", f"task.seconds={seconds}"),
            *(f"observer={observer}", f"train.worlds={worlds}", "train.goal_spread=[0.05,0.05]"),
            *(f"train.iterations={ITERATIONS}", "train.record_every=0"),
            *(f"device.name={device.type}", f"device.dtype={precision}"),
        ]
        first = None
        for processes in (1, 2, 4, 8)[: most.bit_length()]:
            losses, episode, alone = run(words, processes)
            first = first or (losses, episode, alone)
            faster = (first[1] + first[2]) / (episode + alone)
            apart = max(abs(now - then) / abs(then) for now, then in zip(losses, first[0], strict=True))
            row = {"observer": observer, "precision": precision, "processes": processes}
            row |= {"worlds": worlds, "particles": worlds * size, "seconds": seconds}
            times = {"episode s": episode, "alone s": alone, "shared": first[1] / episode}
            table.add(
                row | times | {"speed-up": faster, "efficiency": faster / processes, "loss apart": apart}
            )
            if precision == "float64" and not apart <= SAME:
                sys.exit(f"{processes} processes differ from one: {apart:.2g} > {SAME:g}.")


def run(words: list[str], processes: int) -> tuple[list[float], float, float]:
    """Train with ``processes`` processes; returns the loss of each iteration, and the seconds of ``episode`` and ``alone``."""
    with tempfile.TemporaryDirectory() as folder:
        train(words, processes, folder)
        timing, metrics = (read(Path(folder) / name) for name in ("timing.csv", "metrics.csv"))
    episode = statistics.median(row["episode"] for row in timing[WARM:])
    alone = statistics.mean(row["learn"] + row["save"] for row in timing[WARM:])
    return [row["loss"] for row in metrics], episode, alone


def read(path: Path) -> list[dict[str, float]]:
    with open(path, newline="") as file:
        return [{name: float(cell or "nan") for name, cell in row.items()} for row in csv.DictReader(file)]


if __name__ == "__main__":
    main()
