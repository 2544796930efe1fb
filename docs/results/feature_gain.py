"""Print the table of docs/defaults.md on the first weights of features, from the csv file beside this script:
`python docs/results/feature_gain.py`."""

import csv
from pathlib import Path

import numpy as np

from softmpm_learn.figures.intervals import interval, pairs

WALKS = -0.5
"""Best evaluation of a run that has got under way."""
KINDS = [("elephant", "best_50"), ("biped", "best_20")]
"""Robots, and the columns that are compared."""


def main():
    with open(Path(__file__).with_name("feature_gain.h200.csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    for robot, column in KINDS:
        groups: dict[str, dict[int, dict[str, str]]] = {}
        for row in rows:
            if row["robot"] == robot:
                groups.setdefault(f"{row['observer']} | {row['feature_gain']}", {})[int(row["seed"])] = row
        best = {name: {seed: float(row[column]) for seed, row in of.items()} for name, of in groups.items()}
        compared = {(pair["first"], pair["second"]): pair for pair in pairs(best, column)}
        for name, of_seeds in groups.items():
            values = list(best[name].values())
            low, high = interval(values, np.median)
            pair = compared.get((name, f"{name.split(' | ')[0]} | 1"))
            shown = f"{pair['difference']:.2f} [{pair['low']:.2f}, {pair['high']:.2f}]" if pair else ""
            walk = sum(value < WALKS for value in values)
            last = sum(lasts(row) and best[name][seed] < WALKS for seed, row in of_seeds.items())
            torn = sum(best[name][seed] < WALKS and not row["later"] for seed, row in of_seeds.items())
            print(
                f"| {robot} | {name} | {np.median(values):.2f} [{low:.2f}, {high:.2f}] | {walk} | {last} | {torn} | {shown} |"
            )
        for other in ("latent | 0.3", "latent | 1"):
            pair = compared[other, f"kmeans | {other.split(' | ')[1]}"]
            print(
                f"{robot}, {other} minus kmeans: {pair['difference']:.2f} [{pair['low']:.2f}, {pair['high']:.2f}]"
            )


def lasts(row: dict[str, str]) -> bool:
    """Whether the gait goes on after the episode, upright."""
    return bool(row["later"]) and float(row["later"]) >= 0.7 and float(row["tilt"] or "inf") < 30


if __name__ == "__main__":
    main()
