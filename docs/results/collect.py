"""Write the tables comparison.ROBOT.h200.csv from a sweep: `python docs/results/collect.py outputs/sweep/experiment=comparison`. A row
for each run; `comparison.py` prints what docs/results.md has of them."""

import csv
import json
import math
import sys
from pathlib import Path

FOUND = ["later", "kicked", "friction", "finer"]
"""What the examination of every robot has, see docs/learning.md."""
EXTREMES = {"arm": ["miss", "speed"]}
"""What it has besides; of walkers the tilt."""
Row = dict[str, str | int]


def number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.4g}"


def row_of(folder: Path) -> tuple[str, Row]:
    """Robot and row of a run that has finished."""
    outcome = json.loads((folder / "outcome.json").read_text())
    if outcome["status"] != "finished":
        raise ValueError(f"{folder} is {outcome['status']}: {outcome['error']}")
    settings = dict(word.split("=", 1) for word in outcome["settings"].split())
    with open(folder / "metrics.csv", newline="") as file:
        restarts = sum(int(row["restarts"] or 0) for row in csv.DictReader(file))
    robot = settings["task"]
    row: Row = {
        "design": settings["design"],
        "clock": settings["policy.clock"].lower(),
        "observer": settings["observer"],
        "seed": outcome["seed"],
        "best": number(outcome["loss"]),
        "iteration": outcome["iteration"],
        "end": number(outcome["end"]),
        "restarts": restarts,
    }
    return robot, row | {name: number(outcome[name]) for name in FOUND + EXTREMES.get(robot, ["tilt"])}


def main(sweep: str, out: str = str(Path(__file__).parent)):
    jobs = sorted(Path(sweep).glob("[0-9]*"), key=lambda job: int(job.name))
    tables: dict[str, list[Row]] = {}
    for folder in (one for job in jobs for one in sorted(job.glob("seed_*"))):
        robot, row = row_of(folder)
        tables.setdefault(robot, []).append(row)
    for robot, rows in tables.items():
        with open(Path(out) / f"comparison.{robot}.h200.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        print(f"{robot}: {len(rows)} runs")


if __name__ == "__main__":
    main(*sys.argv[1:])
