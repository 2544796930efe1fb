"""Print the tables of docs/decisions/0013-settling.md, from settling.h200.csv and refit.h200.csv beside this script."""

import csv
from pathlib import Path

import numpy as np

from softmpm_learn.figures.intervals import pairs


def table(name: str) -> list[dict[str, str]]:
    """Rows of a table beside this script."""
    with open(Path(__file__).with_name(name), newline="") as file:
        return list(csv.DictReader(file))


def best(rows: list[dict[str, str]], **wanted: str) -> dict[int, float]:
    """Best evaluation of each seed among the rows with these values."""
    return {
        int(row["seed"]): float(row["best"])
        for row in rows
        if all(row[name] == value for name, value in wanted.items())
    }


def main():
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
