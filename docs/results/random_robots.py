"""Robots drawn at random, of docs/results.md:

    python docs/results/random_robots.py draw FOLDER [SEED]      writes FOLDER/r00.npy to r11.npy, of the seed 2026 or another
    python docs/results/random_robots.py collect NAME FOLDER...  writes NAME, a row for each run in FOLDER/r00 to r11
    python docs/results/random_robots.py [NAME]                  prints the figures of NAME, random_robots.h200.csv
    python docs/results/random_robots.py picture [NAME]          draws docs/images/random_robots.png, or of another table its own

Voxels are drawn with the weights of Evolution Gym's sample_robot (0.6 for an empty one, 1 for each other kind) until the robot is
connected and has an actuator.
"""

import csv
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml
from collect import COLUMNS, EXAMINED, WALKER, number
from comparison import Row, lasts
from settling import table

NAME = "random_robots.h200.csv"
SEEDS = {NAME: 2026, "random_robots_others.h200.csv": 2027}
"""Seed with which the robots of a table were drawn."""
WALKS = -0.03
"""Best evaluation of a robot that walks, a tenth of its length [m]."""
KINDS = {
    "rigid": "#303030",
    "soft": "#b0b0b0",
    "horizontal actuator": "#ff8000",
    "vertical actuator": "#0080ff",
}
"""Kinds of voxels, from 1 on, and their colours."""
TRIALS = "random_robots_trials.h200.csv"
"""Lowest loss of an episode in shorter runs with other settings, a column for each seed."""


def drawn(seed: int) -> Iterator[tuple[str, np.ndarray]]:
    """Names and voxels of the robots."""
    from scipy.ndimage import label

    rng, weights = np.random.default_rng(seed), np.array([0.6, 1.0, 1.0, 1.0, 1.0])
    for k in range(12):
        voxels = np.zeros((5, 5), dtype=int)
        while not ((voxels >= 3).any() and label(voxels > 0)[1] == 1):
            voxels = rng.choice(5, size=(5, 5), p=weights / weights.sum())
        yield f"r{k:02d}", voxels


def draw(folder: str, seed: str = str(SEEDS[NAME])) -> None:
    """Write the robots into a folder."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for robot, voxels in drawn(int(seed)):
        np.save(Path(folder) / f"{robot}.npy", voxels)


def collect(name: str, *folders: str) -> None:
    """Write a table with a row for each seed of the runs in some folders."""
    rows = []
    for folder in map(Path, folders):
        for run in sorted(folder.glob("[rp][0-9][0-9]/sweep.csv")):
            task = yaml.safe_load((run.parent / "config.yaml").read_text())["task"]
            with open(run, newline="") as file:
                for row in csv.DictReader(file):
                    robot = {
                        "robot": run.parent.name,
                        "strength": f"{task['strength']:g}",
                        "seed": row["seed"],
                    }
                    columns = COLUMNS | EXAMINED | WALKER
                    rows.append(
                        robot | {new: number(row[old]) for new, old in columns.items()} | counts(run, row)
                    )
    with open(Path(__file__).parent / name, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(f"{len(rows)} runs")


def counts(run: Path, row: Row) -> Row:
    """Of a seed the evaluations while it learned, how many of them failed, and how often it began anew.

    The first iteration and every fifth are evaluated; a failed evaluation has no value.
    """
    with open(run.parent / f"seed_{row['seed']}" / "metrics.csv", newline="") as file:
        steps = [step for step in csv.DictReader(file) if step["loss"]]
    due = [step for step in steps if int(step["iteration"]) % 5 == 4 or step["iteration"] == "0"]
    failed = sum(step["evaluation"] in ("", "nan") for step in due)
    restarts = sum(int(step["restarts"]) for step in steps)
    return {"evaluations": str(len(due)), "failed": str(failed), "restarts": str(restarts)}


def by_robot(name: str) -> dict[str, dict[str, list[Row]]]:
    """Runs by strength and robot."""
    found: dict[str, dict[str, list[Row]]] = {}
    for row in table(name):
        found.setdefault(row["strength"], {}).setdefault(row["robot"], []).append(row)
    return found


def walking(rows: list[Row]) -> list[Row]:
    """Those of some runs that walk; one that failed has no best."""
    return [row for row in rows if row["best"] and float(row["best"]) < WALKS]


def show(name: str = NAME) -> None:
    """Print, for each strength, how many walk and last, in all and of each robot, and what the examination found."""
    for strength, robots in by_robot(name).items():
        runs = [row for rows in robots.values() for row in rows]
        walk = walking(runs)
        print(
            f"strength {strength} Pa: of {len(runs)} runs {len(walk)} walk, {sum(map(lasts, walk))} of which last;"
        )
        total = {name: sum(int(row[name]) for row in runs) for name in ("evaluations", "failed")}
        print(f"  of {total['evaluations']} evaluations {total['failed']} failed;")
        still = [int(row["restarts"]) for row in runs if row not in walk]
        print(f"  those that do not walk began anew {min(still)} to {max(still)} times")
        each = [len(walking(rows)) == len(rows) for rows in robots.values()]
        some = [bool(walking(rows)) for rows in robots.values()]
        print(f"  of {len(robots)} robots {sum(some)} walk with some seed, {sum(each)} with each")
        for column in ("later", "kicked", "friction", "finer", "tilt"):
            values = [float(row[column]) for row in walk if row[column]]
            low, median, high = np.quantile(values, [0.1, 0.5, 0.9])
            torn = len(walk) - len(values)
            print(f"  {column}: median {median:.2f}, tenths {low:.2f} and {high:.2f}, {torn} torn")
        for robot, rows in robots.items():
            best = [float(row["best"]) for row in rows if row["best"]]
            found = f"{len(walking(rows))} of {len(rows)} walk, {sum(map(lasts, walking(rows)))} last"
            print(f"  {robot}: {found}, best {np.median(best):.2f} ({min(best):.2f} to {max(best):.2f})")

    for trial in table(TRIALS) if name == NAME else ():
        moved = sum(float(trial[f"seed {seed}"]) < WALKS for seed in range(1390, 1398))
        print(f"trial of {trial['robot']}, {trial['settings']}: {moved} of 8 move")


def picture(name: str = NAME) -> None:
    """Draw the robots with the best evaluations of their runs, of the largest strength."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    runs = by_robot(name)[max(by_robot(name), key=float)]
    figure, axes = plt.subplots(2, 6, figsize=(11, 5.2), layout="constrained")
    figure.get_layout_engine().set(hspace=0.1)  # pyright: ignore
    for axis, (robot, voxels) in zip(axes.flat, drawn(SEEDS[name]), strict=True):
        colours = ListedColormap(["white", *KINDS.values()])
        axis.imshow(voxels, cmap=colours, vmin=0, vmax=len(KINDS))
        rows, best = runs[robot], np.median([float(row["best"]) for row in runs[robot]])
        axis.set_title(f"{robot}: {len(walking(rows))} of {len(rows)} walk\nmedian {best:.2f}", fontsize=9)
        axis.axis("off")
    handles = [Patch(color=colour, label=kind) for kind, colour in KINDS.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.savefig(Path(__file__).parents[1] / "images" / f"{name.split('.')[0]}.png", dpi=110)


if __name__ == "__main__":
    commands = {"draw": draw, "collect": collect, "show": show, "picture": picture}
    words = sys.argv[1:] if sys.argv[1:2] and sys.argv[1] in commands else ["show", *sys.argv[1:]]
    commands[words[0]](*words[1:])
