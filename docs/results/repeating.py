"""Print the figures of "What repeats itself" in docs/defaults.md, from the comparisons and lasting.csv beside this script."""

import numpy as np
from comparison import WALKS, Row
from lasting import Count, both, compare, lasting, lucky, print_change, print_examined, walking
from settling import table

FOLDERS = {"farthest": "settled/", "lasting": "lasting/", "repeats itself": "repeating/"}
"""Where the comparison is whose best motions are chosen in this way."""
ROBOTS = "biped", "elephant"
LENGTHS = {"biped": 0.3, "elephant": 0.44}
"""Of the robots at rest [m]."""


def torn(rows: list[Row]) -> Count:
    """How many walkers tear within three episodes."""
    return sum(not row["later"] for row in walking(rows)), len(walking(rows))


def print_changes() -> None:
    """How many bests gave way when they were evaluated again, before settling and at the end, and how many runs had no motion left that
    is worth going on with."""
    rows = table("repeating.csv")
    walkers = [row for row in rows if row["job"] != "fresh" and float(row["learned"]) < WALKS]
    fresh = [row for row in rows if row["job"] == "fresh"]
    for what, some in (("walkers of the comparison", walkers), ("fresh seeds", fresh)):
        begin, end = (
            sum(r[a] != r[b] for r in some) for a, b in (("learned", "settling"), ("settled", "ended"))
        )
        print(f"of {len(some)} {what} the best changed before settling in {begin}, at the end in {end}")
    steps = ("learned", "settling"), ("settled", "ended")
    lost = [row for row in rows if any(worth(row, a) and not worth(row, b) for a, b in steps)]
    print(f"{len(lost)} of {len(rows)} runs went back to a motion that is not worth going on with")


def worth(row: Row, stage: str) -> bool:
    """True if the best of a run is worth going on with: a tenth of the robot's length."""
    return float(row[stage]) < -LENGTHS[row["robot"]] / 10


def print_ways() -> None:
    """How many of six further simulations of each best failed, or came less than 0.8 as far as their median."""
    ways: dict[str, list[float]] = {}
    for row in table("ways.csv"):
        if float(row["best"]) < WALKS:
            ways.setdefault(row["seed"], []).append(float(row["way"] or "nan"))
    low = sum(not way >= 0.8 * np.nanmedian(some) for some in ways.values() for way in some)
    print(
        f"{low} of {sum(map(len, ways.values()))} simulations of {len(ways)} bipeds fail or are below 0.8 of the median"
    )


def main():
    print_changes()
    print_ways()
    counts: dict[str, dict[str, Count]] = {}
    for choice, folder in FOLDERS.items():
        of = {robot: table(f"{folder}comparison.{robot}.h200.csv") for robot in ROBOTS}
        found = {
            what: both(*(count(of[robot]) for robot in ROBOTS))
            for what, count in (
                ("last", lasting),
                ("tear", torn),
                ("end by luck", lambda rows: lucky(walking(rows))),
            )
        }
        found["walk"] = found["last"][1], sum(map(len, of.values()))
        counts[choice] = found
        for robot, rows in of.items():
            last, ends, gone = lasting(rows), lucky(walking(rows)), torn(rows)
            median = np.median([float(row["best"]) for row in rows])
            print(
                f"{robot}, {choice}: {len(rows)} | {last[1]} | {last[0]} | {gone[0]} | {ends[0]} | {median:.2f}"
            )
    for before in ("farthest", "lasting"):
        for what, count in counts["repeats itself"].items():
            compare(f"{what}, before {before}", count, counts[before][what])
    for robot in ROBOTS:
        now, before = (
            table(f"{FOLDERS[c]}comparison.{robot}.h200.csv") for c in ("repeats itself", "lasting")
        )
        change = [float(a["best"]) - float(b["best"]) for a, b in zip(now, before, strict=True)]
        error = np.std(change, ddof=1) / np.sqrt(len(change))
        print(f"{robot}: best {np.mean(change):+.2f}, standard error {error:.2f}")
    rows = table("lasting.csv")
    for robot in ROBOTS:
        fresh = [r for r in rows if (r["choice"], r["robot"]) == ("a best repeats itself", robot)]
        print(
            f"{robot}, fresh seeds: {lasting(fresh)} last, {lucky(walking(fresh))} end by luck; of those that walk"
        )
        print_examined(walking(fresh))
    wide = [row for row in rows if row["choice"] == "stretch 2e5, four starts" and row["robot"] == "biped"]
    print_change("biped", wide, [row for row in rows if row["choice"] == "stretch 5e4, four starts"])


if __name__ == "__main__":
    main()
