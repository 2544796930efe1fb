"""Print the figures of "How often the encoder learns" in docs/results.md from the tables phases.ROBOT.h200.csv beside this script."""

import math

import numpy as np
from comparison import Row, of_arms, of_walkers, shown
from settling import table

from softmpm_learn.figures.intervals import interval, pairs


def main():
    for robot in ("arm", "biped", "elephant"):
        arm, jobs = robot == "arm", dict[str, list[Row]]()
        for row in table(f"phases.{robot}.h200.csv"):
            jobs.setdefault(f"every {row['every']}, rate {row['target_rate']}", []).append(row)
        values = {
            job: {
                int(row["seed"]): math.log(float(row["best"])) if arm else float(row["best"]) for row in rows
            }
            for job, rows in jobs.items()
        }
        print(robot)
        for job, rows in jobs.items():
            best = [(1e5 if arm else 1.0) * float(row["best"]) for row in rows]
            low, high = interval(best, np.median)
            counts = of_arms(rows) if arm else of_walkers(rows)
            print(
                f"  {job}: {np.median(best):.2f} [{low:.2f}, {high:.2f}], {' '.join(counts)} of {len(rows)}"
            )
        for pair in pairs(values, "best"):
            print(f"  {pair['first']} {'/' if arm else '-'} {pair['second']}: {shown(pair, is_log=arm)}")


if __name__ == "__main__":
    main()
