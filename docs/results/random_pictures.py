"""Robots drawn at random as pictures, of docs/results.md; ``random_robots.py`` collects their runs and prints the figures:

    python docs/results/random_pictures.py draw FOLDER [SEED]   writes FOLDER/p00.png to p11.png, of the seed 2028 or another
    python docs/results/random_pictures.py picture [NAME]       draws docs/images/random_pictures.png with the figures of a table

A trunk 0.3 m long and a quarter to two fifths as high, on two to four legs below it, each of one muscle or of two side by side.
"""

import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from random_robots import by_robot, walking

NAME, SEED = "random_pictures.h200.csv", 2028
DEFAULT = "6000"
"""Strength of the muscles of a picture, of the two in the table [Pa]."""
WIDTH = 300
"""Pixels along the trunk, one for each millimetre."""
COLOURS = ("#ff0000", "#00c000", "#0000ff", "#ffff00", "#00ffff", "#ff00ff", "#ff8000", "#8000ff")
"""Muscles of the legend of ``task=image``."""
TRUNK = "#808080"


def drawn(seed: int) -> Iterator[tuple[str, Image.Image]]:
    """Names and pictures of the robots."""
    rng = np.random.default_rng(seed)
    for k in range(12):
        height, leg = int(rng.integers(75, 121)), int(rng.integers(60, 121))
        count, width = int(rng.integers(2, 5)), int(rng.integers(36, 61))
        room = WIDTH / count  # for each leg, so that the robot stands on the first and the last
        lefts = room * np.arange(count) + rng.uniform(0.0, room - width, count)
        picture = Image.new("RGB", (WIDTH + 20, height + leg + 20), "white")
        pen, below, colours = ImageDraw.Draw(picture), 10 + height, iter(COLOURS)
        for left in 10 + lefts.astype(int):
            parts = int(rng.integers(1, 3))
            edges = np.linspace(left, left + width, parts + 1).astype(int)
            for begin, end in itertools.pairwise(edges):
                pen.rectangle((begin, below - 10, end - 1, below + leg - 1), fill=next(colours))
        pen.rounded_rectangle((10, 10, 9 + WIDTH, below - 1), radius=20, fill=TRUNK)
        yield f"p{k:02d}", picture


def draw(folder: str, seed: str = str(SEED)) -> None:
    """Write the robots into a folder."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for robot, picture in drawn(int(seed)):
        picture.save(Path(folder) / f"{robot}.png")


def picture(name: str = NAME) -> None:
    """Draw the robots with the best evaluations of their runs."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    runs = by_robot(name)[DEFAULT]
    figure, axes = plt.subplots(3, 4, figsize=(11, 7), layout="constrained")
    for axis, (robot, drawing) in zip(axes.flat, drawn(SEED), strict=True):
        axis.imshow(np.asarray(drawing))
        rows, best = runs[robot], np.median([float(row["best"]) for row in runs[robot]])
        axis.set_title(f"{robot}: {len(walking(rows))} of {len(rows)} walk, median {best:.2f}", fontsize=9)
        axis.axis("off")
    figure.savefig(Path(__file__).parents[1] / "images" / "random_pictures.png", dpi=110)


if __name__ == "__main__":
    {"draw": draw, "picture": picture}[sys.argv[1]](*sys.argv[2:])
