"""Print the table of docs/defaults.md on the features of k-means and of the latent, from features.csv beside this script:
`python docs/results/features.py`."""

import csv
from pathlib import Path

import numpy as np

from softmpm_learn.figures.intervals import interval, pairs


def main():
    best = dict[str, dict[int, float]]()
    with open(Path(__file__).with_name("features.csv"), newline="") as file:
        for row in csv.DictReader(file):
            if row["robot"] == "biped":
                best.setdefault(row["observer"], {})[int(row["seed"])] = float(row["best"])
    for observer in ("latent", "kmeans", "k-means, 2 clusters", "latent, posture"):
        values = list(best[observer].values())
        low, high = interval(values, np.median)
        print(f"{observer}: {np.median(values):.2f} [{low:.2f}, {high:.2f}]")
    for observer in ("k-means, 2 clusters", "latent, posture"):
        for other in ("latent", "kmeans"):
            (pair,) = pairs({observer: best[observer], other: best[other]}, "best")
            print(
                f"{observer} minus {other}: {pair['difference']:.2f} [{pair['low']:.2f}, {pair['high']:.2f}]"
            )


if __name__ == "__main__":
    main()
