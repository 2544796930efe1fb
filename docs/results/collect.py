"""Write tables NAME.ROBOT.h200.csv from folders of sweeps and of runs of several seeds.

    python docs/results/collect.py NAME FOLDER...

A row for each run. `comparison.py`, `twenty.py` and `jobs.py` print what docs/results.md has of them, `draw.py` draws it.
"""

import csv
import math
import sys
from pathlib import Path

JOBS = {
    "design": "design",
    "clock": "policy.clock",
    "observer": "observer",
    "every": "learning.every",
    "target_rate": "learning.target_rate",
    "restart_after": "optimizer.restart_after",
}
"""Settings that tell apart the jobs of a sweep."""
COLUMNS = {"best": "loss", "iteration": "iteration", "end": "end"}
"""Columns of every table, and those of sweep.csv that they are."""
EXAMINED = {name: name for name in ("later", "kicked", "friction", "finer")}
EXTREMES = {"arm": {"miss": "largest_miss", "speed": "largest_speed"}}
WALKER = {"tilt": "largest_tilt"}
Row = dict[str, str]


def number(text: str) -> str:
    """Four digits of a number; nothing of one that is missing or not finite."""
    return f"{float(text):.4g}" if text and math.isfinite(float(text)) else ""


def row_of(run: Row) -> tuple[str, Row]:
    """Robot and row of a run that has finished."""
    if run["status"] != "finished":
        raise ValueError(f"{run['folder']} is {run['status']}: {run['error']}")
    settings = dict(word.split("=", 1) for word in run["settings"].split())
    robot = settings["task"]
    job = {name: settings[setting].lower() for name, setting in JOBS.items() if setting in settings}
    return robot, {**job, "seed": run["seed"]} | {
        name: number(run[column])
        for name, column in (COLUMNS | EXAMINED | EXTREMES.get(robot, WALKER)).items()
    }


def main(table: str, *folders: str):
    tables: dict[str, list[Row]] = {}
    for folder in folders:
        with open(Path(folder) / "sweep.csv", newline="") as file:
            for robot, row in map(row_of, csv.DictReader(file)):
                tables.setdefault(robot, []).append(row)
    for robot, rows in tables.items():
        with open(Path(__file__).parent / f"{table}.{robot}.h200.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        print(f"{robot}: {len(rows)} runs")


if __name__ == "__main__":
    main(*sys.argv[1:])
