"""Print the figures of tables NAME.ROBOT.h200.csv beside this script: `python docs/results/jobs.py NAME [SEEDS]`.

Of each set of twenty seeds, or of as many as are given, its jobs, and the differences between every two of them, paired by seed.
"""

import math
import sys
from pathlib import Path

import numpy as np
from comparison import Row, of_arms, of_walkers, shown
from settling import table

from softmpm_learn.figures.intervals import interval, pairs

Sets = dict[int, dict[str, list[Row]]]


def sets_of(rows: list[Row], seeds: int) -> Sets:
    """Rows by the first seed of their set and by their job, the settings in the columns before the seed."""
    sets: Sets = {}
    for row in rows:
        job = ", ".join(f"{name} {row[name]}" for name in list(row)[: list(row).index("seed")])
        first = int(row["seed"]) // seeds * seeds
        sets.setdefault(first, {}).setdefault(job, []).append(row)
    return sets


def print_jobs(jobs: dict[str, list[Row]], arm: bool) -> None:
    """Of each job the median of its best evaluations with its interval, and how many runs rest, or walk and last."""
    for job, rows in jobs.items():
        best = [(1e5 if arm else 1.0) * float(row["best"]) for row in rows]
        low, high = interval(best, np.median)
        counts = of_arms(rows) if arm else of_walkers(rows)
        print(f"  {job}: {np.median(best):.2f} [{low:.2f}, {high:.2f}], {' '.join(counts)} of {len(rows)}")


def print_differences(jobs: dict[str, list[Row]], arm: bool) -> None:
    """Mean differences of the best evaluation; of arms, whose losses lie decades apart, quotients of geometric means."""
    value = (lambda text: math.log(float(text))) if arm else float
    values = {job: {int(row["seed"]): value(row["best"]) for row in rows} for job, rows in jobs.items()}
    for pair in pairs(values, "best"):
        print(f"  {pair['first']} {'/' if arm else '-'} {pair['second']}: {shown(pair, is_log=arm)}")


def main(name: str, seeds: str = "20"):
    robots = [
        r for r in ("elephant", "biped", "arm") if Path(__file__).with_name(f"{name}.{r}.h200.csv").exists()
    ]
    if not robots:
        raise SystemExit(f"there is no table {name}.ROBOT.h200.csv beside this script.")
    for robot in robots:
        for first, jobs in sets_of(table(f"{name}.{robot}.h200.csv"), int(seeds)).items():
            print(f"{robot}, seeds from {first}")
            print_jobs(jobs, robot == "arm")
            print_differences(jobs, robot == "arm")


if __name__ == "__main__":
    main(*sys.argv[1:])
