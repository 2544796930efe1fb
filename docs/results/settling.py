"""Print the figures of docs/decisions/0013-settling.md and of "What settling changed" in docs/defaults.md, from the tables beside this
script."""

import csv
import math
from pathlib import Path

import numpy as np

from softmpm_learn.figures.intervals import pairs


def table(name: str) -> list[dict[str, str]]:
    """Rows of a table beside this script."""
    with open(Path(__file__).parent / name, newline="") as file:
        return list(csv.DictReader(file))


def best(rows: list[dict[str, str]], **wanted: str) -> dict[int, float]:
    """Best evaluation of each seed among the rows with these values."""
    return {
        int(row["seed"]): float(row["best"])
        for row in rows
        if all(row[name] == value for name, value in wanted.items())
    }


def print_changes(robot: str) -> None:
    """Change of the best evaluation from the comparison before runs settled, paired by seed, for each observer and clock and of all;
    of the arm as a quotient of geometric means."""
    name, arm = f"comparison.{robot}.h200.csv", robot == "arm"
    now, before = (
        {(r["observer"], r["clock"], r["design"], r["seed"]): float(r["best"]) for r in table(folder + name)}
        for folder in ("settled/", "before_settling/")
    )
    changes: dict[str, list[float]] = {}
    for key, value in now.items():
        change = math.log(value / before[key]) if arm else value - before[key]
        observer, clock, design, _ = key
        for group in (f"{observer}, clock {clock}, design {design}", "all"):
            changes.setdefault(group, []).append(change)
    for group, values in changes.items():
        mean, error = np.mean(values), np.std(values, ddof=1) / math.sqrt(len(values))
        print(f"{robot}, {group}: {f'times {math.exp(mean):.2f}' if arm else f'{mean:+.2f}'} ({error:.3f})")


def main():
    for robot in ("biped", "elephant", "arm"):
        print_changes(robot)
    rows = table("settling.h200.csv")
    for halving in ("40", ""):
        for share in ("0.2", "0.4"):
            found = [
                list(best(rows, robot=robot, halving=halving, settle=share).values())
                for robot in ("biped", "elephant", "arm")
            ]
            medians = ", ".join(f"{np.median(values):.2f}" for values in found[:2])
            print(
                f"halving {halving or 'never'}, share {share}: medians {medians}, highest arm {max(found[2]):.2g}"
            )
    rows = table("refit.h200.csv")
    for robot in ("biped", "elephant"):
        for target in ("yes", "no"):
            values = {
                "refit": best(rows, robot=robot, refit="yes", target_network=target),
                "default": best(rows, robot=robot, refit="no", target_network="yes"),
            }
            (pair,) = pairs(values, "best")
            print(
                f"{robot}, refit, target network {target}, minus default: {pair['difference']:.2f} "
                f"[{pair['low']:.2f}, {pair['high']:.2f}]"
            )


if __name__ == "__main__":
    main()
