"""Print a table of docs/results.md that compares observers, from comparison.ROBOT.h200.csv beside this script:
`python docs/results/comparison.py elephant`."""

import csv
import sys
from pathlib import Path

import numpy as np

from softmpm_learn.figures.intervals import interval, pairs

WALKS = -0.5
"""Best evaluation of a run that has got under way."""
FIRST = ("particle", "true", "latent")


def shown(pair: dict | None) -> str:
    """Mean difference with its interval; nothing of a job with itself."""
    return "" if pair is None else f"{pair['difference']:.2f} [{pair['low']:.2f}, {pair['high']:.2f}]"


def lasts(row: dict[str, str]) -> bool:
    """True if the gait goes on after the episode, upright; False also where the robot tore."""
    return row["later"] != "" and float(row["later"]) >= 0.7 and float(row["tilt"]) < 30


def main(robot: str):
    with open(Path(__file__).with_name(f"comparison.{robot}.h200.csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    jobs: dict[tuple[str, str, str], list[dict[str, str]]] = {}
    for row in rows:
        jobs.setdefault((row["design"], row["clock"], row["observer"]), []).append(row)
    values = {
        " ".join(job): {int(row["seed"]): float(row["best"]) for row in runs} for job, runs in jobs.items()
    }
    differences = {(pair["first"], pair["second"]): pair for pair in pairs(values, "best")}
    for job, runs in jobs.items():
        best = [float(row["best"]) for row in runs]
        low, high = interval(best, np.median)
        walk = [row for row in runs if float(row["best"]) < WALKS]
        last = [row for row in walk if lasts(row)]
        torn = [row for row in walk if row["later"] == ""]
        anew = [row for row in runs if row["restarts"] != "0"]
        difference = shown(differences.get((" ".join(FIRST), " ".join(job))))
        design, clock, observer = job
        print(
            f"| {'yes' if design == 'particle' else 'no'} | {'yes' if clock == 'true' else 'no'} | {observer} | "
            f"{np.median(best):.2f} [{low:.2f}, {high:.2f}] | {len(walk)} | {len(last)} | {len(torn)} | {len(anew)} | {difference} |"
        )
    print("The latent minus another observer, with the same design and clock:")
    for design, clock, observer in jobs:
        pair = differences.get((f"{design} {clock} latent", f"{design} {clock} {observer}"))
        if pair is not None:
            print(f"design={design} clock={clock} {observer}: {shown(pair)}")
    print("With co-design minus without, and with the clock minus without, of each observer:")
    for (first, second), pair in differences.items():
        (design, clock, observer), (other_design, other_clock, other) = first.split(), second.split()
        if observer == other and (design == other_design) != (clock == other_clock):
            print(f"{first} - {second}: {shown(pair)}")
    walking = [row for row in rows if float(row["best"]) < WALKS]
    torn = sum(row["last"] == "" for row in walking)
    fell = sum(row["last"] != "" and float(row["last"]) > 0.8 * float(row["best"]) for row in walking)
    anew = [row for row in rows if row["restarts"] != "0"]
    print(
        f"{len(walking)} walk; the last evaluation of {torn} failed, that of {fell} is below 0.8 of their best"
    )
    print(f"{len(anew)} began anew, {sum(row in walking for row in anew)} of which walk")


if __name__ == "__main__":
    main(sys.argv[1])
