"""Seeds shared out over several GPUs: `python bench/gpus.py [--seeds 160] [--task biped] [--json bench/results/gpus.json]`

The same seeds learn side by side on 1, 2, 4 and 8 GPUs, as far as there are any (on a CPU in 1 and 2 processes). Each process has
seeds of its own and exchanges nothing. Seconds of the slowest process, from timing.csv:

    iteration   episode, learning and checkpoint, the median over the iterations after the first two, which compile and capture
    all         the sum of these iterations
    start       the first two

``median`` and ``faster`` compare ``iteration`` and ``all`` with those of a single process.
"""

import argparse
import csv
import statistics
import tempfile
from pathlib import Path

import torch
from common import Table, train

WARM = 2


def main():
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options.add_argument("--task", default="biped")
    options.add_argument("--seeds", type=int, default=160)
    options.add_argument("--iterations", type=int, default=12)
    options.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    args = options.parse_args()
    device = torch.device(args.device)
    most = torch.cuda.device_count() if device.type == "cuda" else 2
    words = [
        *(f"task={args.task}", f"train.seeds={args.seeds}", f"train.iterations={args.iterations}"),
        *("train.record_every=0", "train.pictures=false", "train.examine=false"),
        *(f"train.save_every={args.iterations}", f"device.name={device.type}"),
    ]
    table, first = Table("Seeds shared out over GPUs, float32", device, args.json), None
    for processes in (1, 2, 4, 8)[: most.bit_length()]:
        times = run(words, processes)
        later = [max(every) for every in zip(*(each[WARM:] for each in times), strict=True)]
        total, typical = sum(later), statistics.median(later)
        first = first or (total, typical)
        table.add(
            {
                "processes": processes,
                "seeds": args.seeds,
                "iterations": len(later),
                "iteration s": typical,
                "all s": total,
                "start s": max(sum(each[:WARM]) for each in times),
                "median": first[1] / typical,
                "faster": first[0] / total,
            }
        )


def run(words: list[str], processes: int) -> list[list[float]]:
    """Train with ``processes`` processes; the seconds of each iteration, of every seed."""
    with tempfile.TemporaryDirectory() as folder:
        train(words, processes, folder)
        return [seconds(path) for path in sorted(Path(folder).glob("**/timing.csv"))]


def seconds(path: Path) -> list[float]:
    """Of each iteration of a seed; those of one process have the same."""
    with open(path, newline="") as file:
        return [
            sum(float(row[name]) for name in ("episode", "learn", "save")) for row in csv.DictReader(file)
        ]


if __name__ == "__main__":
    main()
