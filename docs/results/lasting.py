"""Print the figures of "What lasts" in docs/results.md, from lasting.h200.csv and the comparisons beside this script."""

import csv
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

WALKS = -0.5
"""Best evaluation of a walker that has got under way, three episodes long."""

Row = dict[str, str]


def table(name: str) -> list[Row]:
    """Rows of a table beside this script."""
    with open(Path(__file__).parent / name, newline="") as file:
        return list(csv.DictReader(file))


def figures(rows: Iterable[Row], episodes: int = 3) -> str:
    """Cells of a table: runs, and how many walk; of these how many last, tear, slow down or tilt, and end below 0.8 of their best or
    tear there; median of the best evaluation of all.

    Args:
        episodes: Length of the evaluation.
    """
    rows = list(rows)
    walking = [row for row in rows if float(row["best"]) < WALKS * episodes / 3]
    torn = [row for row in walking if not row["later"]]
    lasting = [r for r in walking if r not in torn and float(r["later"]) >= 0.7 and float(r["tilt"]) < 30]
    lucky = [row for row in walking if not row["end"] or float(row["end"]) > 0.8 * float(row["best"])]
    rest = len(walking) - len(torn) - len(lasting)
    counts = len(rows), len(walking), len(lasting), len(torn), rest, len(lucky)
    return " | ".join([*map(str, counts), f"{np.median([float(row['best']) for row in rows]):.2f}"])


def main():
    kinds: dict[tuple[str, str, str], list[Row]] = {}
    for row in table("lasting.h200.csv"):
        kinds.setdefault((row["robot"], row["iterations"], row["choice"]), []).append(row)
    for (robot, iterations, choice), rows in kinds.items():
        print(f"{robot}, {iterations}, {choice} | {figures(rows, 1 if choice == 'slowest episode' else 3)}")
    for robot in ("biped", "elephant"):
        then, now = (table(f"{folder}comparison.{robot}.h200.csv") for folder in ("", "lasting/"))
        change = [float(b["best"]) - float(a["best"]) for a, b in zip(then, now, strict=True)]
        error = np.std(change, ddof=1) / math.sqrt(len(change))
        print(f"{robot}, comparison, farthest | {figures(then)}")
        print(f"{robot}, comparison, lasting | {figures(now)} | best {np.mean(change):+.2f} ({error:.2f})")


if __name__ == "__main__":
    main()
