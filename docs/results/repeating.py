"""Print the figures of "What repeats itself" in docs/results.md, from the comparisons and lasting.csv beside this script."""

import numpy as np
from comparison import Row
from lasting import Count, both, compare, lasting, lucky, print_change, print_examined, walking
from settling import table

FOLDERS = {"farthest": "settled/", "lasting": "lasting/", "repeats itself": ""}
"""Where the comparison is whose best motions are chosen in this way."""
ROBOTS = "biped", "elephant"


def torn(rows: list[Row]) -> Count:
    """How many walkers tear within three episodes."""
    return sum(not row["later"] for row in walking(rows)), len(walking(rows))


def main():
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
