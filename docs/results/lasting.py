"""Print the figures of "What lasts" and "What tears" in docs/defaults.md, from lasting.csv, tears.csv and the comparisons beside this
script."""

import math
from collections.abc import Sequence

import numpy as np
from comparison import WALKS, Row, lasts
from scipy.stats import fisher_exact
from settling import table

from softmpm_learn.figures.intervals import interval

NARROW = 1.2
"""Largest distance of neighbours at rest in a motion far from tearing, which is at 1.4 [cells]."""

Count = tuple[int, int]
"""Number of walkers with a property, and of all walkers."""


def walking(rows: Sequence[Row], episodes: int = 3) -> list[Row]:
    """Runs whose robot walks.

    Args:
        episodes: Length of the evaluation.
    """
    return [row for row in rows if float(row["best"]) < WALKS * episodes / 3]


def lasting(rows: Sequence[Row]) -> Count:
    """How many walkers last."""
    return sum(map(lasts, walking(rows))), len(walking(rows))


def lucky(walkers: Sequence[Row]) -> Count:
    """How many fail, or are below 0.8 of their best, when that is simulated once more."""
    return sum(not r["end"] or float(r["end"]) > 0.8 * float(r["best"]) for r in walkers), len(walkers)


def figures(rows: Sequence[Row], episodes: int = 3) -> str:
    """Cells of a table: runs, and how many walk; of these how many last, tear, slow down or tilt, end by luck, and stop on the finer
    grid; median of the best evaluation of all."""
    walkers = walking(rows, episodes)
    good, torn = sum(map(lasts, walkers)), sum(not row["later"] for row in walkers)
    finer = sum(not row["finer"] for row in walkers)
    counts = len(rows), len(walkers), good, torn, len(walkers) - torn - good, lucky(walkers)[0], finer
    return " | ".join([*map(str, counts), f"{np.median([float(row['best']) for row in rows]):.2f}"])


def known(rows: Sequence[Row]) -> str:
    """Of the walkers that fail in the examination, how many had lasted in their evaluation."""
    failed = [row for row in walking(rows) if not lasts(row)]
    return f"{len(failed)} fail, of which {sum(row['lasts'] == '1' for row in failed)} had lasted"


def compare(what: str, now: Count, then: Count) -> None:
    """Print two shares, and by Fisher's exact test whether they differ."""
    p = fisher_exact([[good, every - good] for good, every in (now, then)]).pvalue
    print(f"{what}: {now[0]} of {now[1]} after {then[0]} of {then[1]}, p = {p:.2g}")


def both(one: Count, other: Count) -> Count:
    """Of two groups together."""
    return one[0] + other[0], one[1] + other[1]


def print_tears() -> None:
    """How many of the best bipeds of each objective tear when they are simulated six times more, three episodes long."""
    bipeds: dict[str, dict[str, list[Row]]] = {}
    for row in table("tears.csv"):
        if float(row["best"]) < WALKS:
            bipeds.setdefault(row["choice"], {}).setdefault(row["seed"], []).append(row)
    torn: dict[str, Count] = {}
    near, wide = (0, 0), (0, 0)
    for choice, of in bipeds.items():
        rows = [row for some in of.values() for row in some]
        tearing = [seed for seed, some in of.items() if any(row["torn"] == "1" for row in some)]
        gaps = {seed: [float(r["gap"]) for r in some if r["torn"] == "0"] for seed, some in of.items()}
        narrow = [seed for seed, some in gaps.items() if max(some) < NARROW]
        torn[choice] = len(tearing), len(of)
        cracked = len({*narrow} & {*tearing})
        near, wide = (
            both(near, (cracked, len(narrow))),
            both(wide, (len(tearing) - cracked, len(of) - len(narrow))),
        )
        many = sum(row["torn"] == "1" for row in rows)
        print(
            f"{choice}: {len(tearing)} of {len(of)} bipeds tear, in {many} of {len(rows)} simulations",
            end="; ",
        )
        print(
            f"gap of the others {np.median([gap for some in gaps.values() for gap in some]):.2f} cells",
            end="; ",
        )
        print(f"{len(narrow)} stay within {NARROW} cells, of which {cracked} tear")
    print(f"of all: {wide[0]} of {wide[1]} tear beyond that, {near[0]} of {near[1]} within it")
    first, *others = torn
    for choice in others:
        compare(f"bipeds that tear with {choice}", torn[choice], torn[first])
    for number, what in (("1", "tear"), ("0", "do not")):
        some = [float(r["strain"]) for rows in bipeds[first].values() for r in rows if r["torn"] == number]
        print(f"{first}: largest strains of simulations that {what}: {min(some):.2f} to {max(some):.2f}")


def print_change(robot: str, rows: Sequence[Row], before: Sequence[Row]) -> None:
    """Mean change of the best evaluations, paired by seed, with its interval."""
    was = {row["seed"]: float(row["best"]) for row in before}
    change = [float(row["best"]) - was[row["seed"]] for row in rows]
    low, high = interval(change)
    print(f"{robot}, {rows[0]['choice']}: best {np.mean(change):+.2f} [{low:.2f}, {high:.2f}]")


def print_examined(rows: Sequence[Row]) -> None:
    """Ranges of the answers of the examination, and how many have none."""
    for name in ("best", "later", "kicked", "friction", "finer"):
        found = [float(row[name]) for row in rows if row[name]]
        middle = f"{min(found):.2f} to {max(found):.2f}, median {np.median(found):.2f}"
        print(f"  {name} {middle}; {len(rows) - len(found)} without")


def main():
    kinds: dict[tuple[str, str, str], list[Row]] = {}
    for row in table("lasting.csv"):
        kinds.setdefault((row["robot"], row["iterations"], row["choice"]), []).append(row)
    for (robot, iterations, choice), rows in kinds.items():
        print(f"{robot}, {iterations}, {choice} | {figures(rows, 1 if choice == 'slowest episode' else 3)}")
        if iterations == "100":
            print(known(rows))
    two = "lasting, two starts"
    farthest = [*kinds["biped", "60", "farthest"], *kinds["biped", "60", "farthest again"]]
    chosen = [*kinds["biped", "60", two], *kinds["biped", "60", f"{two}, again"]]
    compare("bipeds that last after 60 iterations", lasting(chosen), lasting(farthest))
    compare("of all runs", (lasting(chosen)[0], len(chosen)), (lasting(farthest)[0], len(farthest)))
    compare("with episodes that go on", lasting(kinds["biped", "60", "continued episodes"]), lasting(chosen))
    settled = [row for row in table("settled.h200.csv") if row["robot"] == "biped"]
    fresh = kinds["biped", "100", two]
    compare("bipeds 960 to 979 that last after 100", (lasting(fresh)[0], 20), (lasting(settled)[0], 20))
    stretch, both_robots = "stretch 5e4, four starts", ("biped", "elephant")
    now, then = (
        [row for robot in both_robots for row in kinds[robot, "100", choice] if 960 <= int(row["seed"]) < 980]
        for choice in (f"{stretch}, 960 to 979", two)
    )
    compare("walkers 960 to 979 that last, with stretch", lasting(now), lasting(then))
    compare("their ends by luck", lucky(walking(now)), lucky(walking(then)))
    for robot in both_robots:
        some = (kinds.get((robot, "100", choice), []) for choice in (stretch, f"{stretch}, 960 to 979"))
        others = (kinds.get((robot, "100", choice), []) for choice in ("strain 1e4, two starts", two))
        compare(
            f"{robot}s that last, of all with 100", *(lasting([*one, *more]) for one, more in (some, others))
        )
    for robot in both_robots:
        rows = [row for row in now if row["robot"] == robot]
        print_change(robot, rows, [row for row in then if row["robot"] == robot])
        print_examined(rows)
    for choice in ("strain 1e4 and stretch 5e4, two starts", stretch):
        print_change("biped", kinds["biped", "100", choice], kinds["biped", "100", "strain 1e4, two starts"])
    print_tears()
    ends = []
    for robot in ("biped", "elephant"):
        before, after = (table(f"{folder}comparison.{robot}.h200.csv") for folder in ("settled/", "lasting/"))
        change = [float(b["best"]) - float(a["best"]) for a, b in zip(before, after, strict=True)]
        error = np.std(change, ddof=1) / math.sqrt(len(change))
        print(f"{robot}, comparison, farthest | {figures(before)}")
        print(f"{robot}, comparison, lasting | {figures(after)} | best {np.mean(change):+.2f} ({error:.2f})")
        print(known(after))
        ends.append((lucky(walking(after)), lucky(walking(before))))
    compare("ends of the comparison by luck", *(both(*one) for one in zip(*ends, strict=True)))


if __name__ == "__main__":
    main()
