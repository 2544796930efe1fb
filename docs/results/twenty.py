"""Print the figures of "Twenty seeds" in docs/results.md from the tables twenty.ROBOT.h200.csv beside this script."""

from collections.abc import Sequence

import numpy as np
from comparison import Row, of_arms, of_walkers
from settling import table


def spread(rows: Sequence[Row], name: str) -> str:
    """Smallest, median and largest value of a column, and how many rows have none."""
    values = [float(row[name]) for row in rows if row[name]]
    low, median, high = np.quantile(values, [0.0, 0.5, 1.0])
    return f"{name} {low:.3g}, {median:.3g}, {high:.3g}; {len(rows) - len(values)} without"


def main():
    for robot in ("biped", "elephant", "arm"):
        rows = table(f"twenty.{robot}.h200.csv")
        counts = of_arms(rows) if robot == "arm" else of_walkers(rows)
        print(f"{robot}, {len(rows)} seeds: {' '.join(counts)}")
        for name in [name for name in rows[0] if name not in ("seed", "iteration")]:
            print(f"  {spread(rows, name)}")
        ends = [float(row["end"]) / float(row["best"]) for row in rows if row["end"]]
        print(f"  end / best from {min(ends):.2f}")


if __name__ == "__main__":
    main()
