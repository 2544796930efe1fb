"""Print the table of docs/results.md that compares observers of the elephant, from the csv file beside this script:
`python docs/results/observers.py`."""

import csv
from pathlib import Path

import numpy as np

from softmpm_learn.figures.intervals import interval, pairs

NAMES = {"kmeans": "k-means"}
WALKS = -0.5
"""Best evaluation of a run that has got under way."""


def main():
    with open(Path(__file__).with_name("observers.elephant.h200.csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    values: dict[str, dict[int, float]] = {}
    for row in rows:
        clock = "yes" if row["clock"] == "true" else "no"
        name = f"{clock} | {NAMES.get(row['observer'], row['observer'])}"
        values.setdefault(name, {})[int(row["seed"])] = float(row["best"])
    compared = {(pair["first"], pair["second"]): pair for pair in pairs(values, "best")}
    for name, of_seeds in values.items():
        best = list(of_seeds.values())
        low, high = interval(best, np.median)
        difference = compared.get(("yes | latent", name))
        shown = (
            ""
            if difference is None
            else f"{difference['difference']:.2f} [{difference['low']:.2f}, {difference['high']:.2f}]"
        )
        walk = sum(one < WALKS for one in best)
        print(f"| {name} | {np.median(best):.2f} [{low:.2f}, {high:.2f}] | {walk} of {len(best)} | {shown} |")
    random = compared["no | latent", "no | untrained"]
    print(
        f"latent - untrained, no clock: {random['difference']:.2f} [{random['low']:.2f}, {random['high']:.2f}]"
    )
    walking = [row for row in rows if float(row["best"]) < WALKS]
    torn = sum(row["last"] == "" for row in walking)
    fell = sum(row["last"] != "" and float(row["last"]) > 0.8 * float(row["best"]) for row in walking)
    print(
        f"of {len(walking)} under way {torn} failed in the last evaluation, {fell} were below 0.8 of their best"
    )


if __name__ == "__main__":
    main()
