"""Print the figures of "Earlier twenties" and "A more viscous material" in docs/defaults.md, from lasting.csv and
failed_evaluations.csv."""

import numpy as np
from comparison import Row
from lasting import both, compare, figures, lasting, lucky, print_examined, walking
from scipy.stats import bootstrap, mannwhitneyu
from settling import table

BEFORE, NOW = "a best repeats itself", "2 ms"
"""Choices of lasting.csv: the defaults with η/μ = 1 ms and with 2 ms. Seeds of both with 100 iterations are fresh."""
FINE = "standard, 1 ms", "standard, 2 ms"
ROBOTS = "biped", "elephant"
FRESH = 1150
"""First seed of the elephants of 128 cells per metre that are fresh."""

Kinds = dict[tuple[str, str, str], list[Row]]


def print_differences(kinds: Kinds) -> None:
    """Mean differences of the best evaluation and of ``finer`` between 2 ms and 1 ms, of unpaired seeds, with their intervals."""
    for robot in ROBOTS:
        for name in ("best", "finer"):
            now, before = (
                [float(row[name]) for row in kinds[robot, "100", choice] if row[name]]
                for choice in (NOW, BEFORE)
            )
            low, high = bootstrap(
                (now, before), lambda a, b, axis: a.mean(axis) - b.mean(axis), rng=0, method="percentile"
            ).confidence_interval
            p = mannwhitneyu(now, before).pvalue
            print(
                f"{robot}, {name}: {np.mean(now) - np.mean(before):+.2f} [{low:.2f}, {high:.2f}], p = {p:.2g}"
            )


def print_failed() -> None:
    """Evaluations that failed, of how many; and whether the share of a seed differs between 1 ms and 2 ms."""
    shares: dict[str, list[float]] = {}
    counts: dict[tuple[str, str, str, str], list[int]] = {}
    for row in table("failed_evaluations.csv"):
        of = counts.setdefault((row["robot"], row["choice"], row["iterations"], row["card"]), [0, 0])
        found = int(row["failed"]), int(row["evaluations"])
        of[:] = of[0] + found[0], of[1] + found[1]
        fresh = " fresh" if row["choice"] == FINE[1] and int(row["seed"]) >= FRESH else ""
        for name in {row["choice"], row["choice"] + fresh}:
            shares.setdefault(name, []).append(found[0] / found[1])
    for kind, (failed, every) in counts.items():
        print(f"{', '.join(kind)}: {failed} of {every} evaluations failed")
    for name in (FINE[1], f"{FINE[1]} fresh"):
        print(
            f"shares of {name} after {FINE[0]}: p = {mannwhitneyu(shares[name], shares[FINE[0]]).pvalue:.2g}"
        )


def main():
    kinds: Kinds = {}
    for row in table("lasting.csv"):
        kinds.setdefault((row["robot"], row["iterations"], row["choice"]), []).append(row)
    for (robot, iterations, choice), rows in kinds.items():
        if choice == BEFORE or " ms" in choice:
            best = [float(row["best"]) for row in rows]
            print(f"{robot}, {iterations}, {choice} | {figures(rows)} | {lucky(walking(rows))[0]}")
            print(f"  of all: best {min(best):.2f} to {max(best):.2f}")
            if walking(rows):
                print_examined(walking(rows))
    print_differences(kinds)
    now, before = (
        both(*(lasting(kinds[robot, "100", choice]) for robot in ROBOTS)) for choice in (NOW, BEFORE)
    )
    compare("walkers that last, of those that walk", now, before)
    old, new = (
        kinds["elephant", iterations, choice] for iterations, choice in zip(("100", "60"), FINE, strict=True)
    )
    fresh = [row for row in new if int(row["seed"]) >= FRESH]
    for what, rows in (("all", new), ("fresh", fresh)):
        compare(
            f"{what} elephants, standard, that walk",
            (len(walking(rows)), len(rows)),
            (len(walking(old)), len(old)),
        )
        compare("  and last", (lasting(rows)[0], len(rows)), (lasting(old)[0], len(old)))
    print_failed()


if __name__ == "__main__":
    main()
