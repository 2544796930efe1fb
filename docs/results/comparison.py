"""Print a table of docs/results.md that compares observers, from comparison.ROBOT.h200.csv beside this script:
`python docs/results/comparison.py elephant`, or an earlier one: `... elephant before_settling`; `settled`, whose best motions were the
farthest; `lasting`, whose best motions had lasted; or `aliased`, whose statistics of the latent were those of every fourth picture."""

import csv
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softmpm_learn.figures.intervals import interval, pairs

WALKS = -0.5
"""Best evaluation of a walker that has got under way."""
MISS, SPEED = 5e-3, 0.05
"""Largest distance [m] and speed [m/s] of an arm's tip that is at rest at its goal."""
FIRST = "particle true latent"
"""The job that the others are compared with."""

Row = dict[str, str]
Jobs = dict[tuple[str, str, str], list[Row]]


def shown(pair: dict | None, is_log: bool) -> str:
    """Mean difference with its interval, of logarithms the quotient of geometric means; nothing of a job with itself. Bold where the
    interval leaves out that there is no difference."""
    if pair is None:
        return ""
    mean, low, high = (
        math.exp(pair[name]) if is_log else pair[name] for name in ("difference", "low", "high")
    )
    text, same = f"{mean:.2f} [{low:.2f}, {high:.2f}]", 1.0 if is_log else 0.0
    return text if low <= same <= high else f"**{text}**"


def lasts(row: Row) -> bool:
    """True if the gait goes on after the episode, upright; False also where the robot tore."""
    return row["later"] != "" and float(row["later"]) >= 0.7 and float(row["tilt"]) < 30


def of_walkers(runs: Sequence[Row]) -> list[str]:
    """How many walk, last, and tore within 6 s."""
    walk = [row for row in runs if float(row["best"]) < WALKS]
    return [str(len(some)) for some in (walk, [*filter(lasts, walk)], [r for r in walk if r["later"] == ""])]


def of_arms(runs: Sequence[Row]) -> list[str]:
    """How many rest at their goal; medians of the largest distance [mm] and speed [m/s] from 0.3 s before the end until 0.5 s after."""
    miss, speed = (np.array([float(row[name]) for row in runs]) for name in ("miss", "speed"))
    rest = int(np.sum((miss <= MISS) & (speed <= SPEED)))
    return [str(rest), f"{1e3 * np.median(miss):.1f}", f"{np.median(speed):.3f}"]


def print_ends(rows: Sequence[Row]) -> None:
    """How the runs of walkers ended: their best evaluated once more, of runs that did not settle their last evaluation."""
    walking = [row for row in rows if float(row["best"]) < WALKS]
    ends = [(row.get("end", row.get("last")), float(row["best"])) for row in walking]
    torn = sum(not end for end, _ in ends)
    fell = sum(float(end) > 0.8 * best for end, best in ends if end)
    gone = sum(row["later"] == "" for row in walking)
    print(f"{len(walking)} walk, {sum(map(lasts, walking))} of which last, and {gone} tear within 6 s")
    print(f"at their end {torn} of those that walk tear, and {fell} are below 0.8 of their best")


def read(robot: str, folder: str = ".") -> Jobs:
    """Rows of a comparison by job: co-design, clock, observer."""
    jobs: Jobs = {}
    with open(Path(__file__).parent / folder / f"comparison.{robot}.h200.csv", newline="") as file:
        for row in csv.DictReader(file):
            jobs.setdefault((row["design"], row["clock"], row["observer"]), []).append(row)
    return jobs


def differences_of(jobs: Jobs, is_log: bool) -> dict[tuple[str, str], str]:
    """Mean difference of the best evaluation between every two jobs, paired by seed, with its interval; of logarithms the quotient."""
    value = (lambda text: math.log(float(text))) if is_log else float
    values = {
        " ".join(job): {int(row["seed"]): value(row["best"]) for row in runs} for job, runs in jobs.items()
    }
    return {(pair["first"], pair["second"]): shown(pair, is_log) for pair in pairs(values, "best")}


def print_differences(jobs: Jobs, *found: dict[tuple[str, str], str], sign: str) -> None:
    """Differences between jobs that differ in the observer, in co-design or in the clock alone, one column for each comparison."""
    print(f"The latent {sign} another observer, with the same design and clock:")
    for design, clock, observer in jobs:
        pair = f"{design} {clock} latent", f"{design} {clock} {observer}"
        if pair in found[0]:
            print(
                f"design={design} clock={clock} {observer}: {', before '.join(each[pair] for each in found)}"
            )
    print(f"With co-design {sign} without, and with the clock {sign} without, of each observer:")
    for pair in found[0]:
        (design, clock, observer), (other_design, other_clock, other_observer) = map(str.split, pair)
        if observer == other_observer and (design == other_design) != (clock == other_clock):
            print(f"{', '.join(pair)}: {', before '.join(each[pair] for each in found)}")


def main(robot: str, folder: str = "."):
    jobs, arm = read(robot, folder), robot == "arm"  # losses of arms, mean squares, lie decades apart
    differences = differences_of(jobs, is_log=arm)
    for job, runs in jobs.items():
        best = [(1e5 if arm else 1.0) * float(row["best"]) for row in runs]
        low, high = interval(best, np.median)
        design, clock, observer = job
        cells = [
            "yes" if design == "particle" else "no",
            "yes" if clock == "true" else "no",
            observer.replace("kmeans", "k-means"),
            f"{np.median(best):.2f} [{low:.2f}, {high:.2f}]",
            *(of_arms(runs) if arm else of_walkers(runs)),
            differences.get((FIRST, " ".join(job)), ""),
        ]
        print(f"| {' | '.join(cells)} |".replace("-", "−").replace("k−means", "k-means"))
    before = [differences_of(read(robot, "aliased"), is_log=arm)] if folder == "." else []
    print_differences(jobs, differences, *before, sign="divided by" if arm else "minus")
    if not arm:
        print_ends([row for runs in jobs.values() for row in runs])


if __name__ == "__main__":
    main(*sys.argv[1:])
