"""The tables of a comparison in Markdown: values at fixed iterations, examination, and differences from the first setting."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from softmpm_learn.figures.intervals import FEWEST, interval, stands_out
from softmpm_learn.figures.of_sweep import values
from softmpm_learn.figures.tables import Row, compared, iteration_of
from softmpm_learn.lasting import LEVEL, SHARE
from softmpm_learn.storage.sweep import EXAMINED

NEAR = 0.005
"""Distance from the goal in which what reaches for it stays to pass [m], from 0.3 s before the end of the episode to 0.5 s after it."""
RESTING = 0.05
"""Speed that it does not exceed in that time [m/s]."""

NOTE = (
    "Medians over the finished runs, in brackets with their bootstrap interval of 95 %; in parentheses the number of runs with an "
    "answer, where some have none. Passed: a walker goes forward (`end`, the loss of its best motion, is below 0), then keeps at "
    f"least {SHARE:g} of its speed and tilts by less than {LEVEL:g}°; what reaches for a goal stays within {1000 * NEAR:g} mm of it "
    f"from 0.3 s before the end of the episode to 0.5 s after it, and below {RESTING:g} m/s where it should come to rest. Other "
    "objectives have no such rule, and without an examination there is no verdict: –."
)
DIFFERENCES = (
    "The first setting minus this one, paired by seed: the mean, of the examination the median, with its bootstrap interval of 95 %; "
    f"bold where that does not contain zero, of {FEWEST} pairs or more. In parentheses the number of pairs, where it is not that of "
    "all seeds."
)


JUDGED = "progress", "reach"
"""First terms of an objective by which a motion passes or not."""


def passes(row: Row) -> bool:
    """True if the best motion of a run stood the examination; a row of jobs.csv."""
    if row["status"] != "finished":
        return False
    if row["term"] == "reach":  # it need not come to rest where the objective does not say so
        return row["largest_miss"] <= NEAR and not row["largest_speed"] > RESTING
    forward = row["term"] == "progress" and row["end"] < 0  # a quotient of two ways back is positive too
    return forward and row["later"] >= SHARE and row["largest_tilt"] < LEVEL


def summary(
    settings: Sequence[str], groups: Mapping[str, Sequence[Row]], pairs: Sequence[Mapping[str, Any]]
) -> str:
    """Both tables.

    Args:
        settings: Columns of jobs.csv in which runs differ.
        groups: Rows of jobs.csv for each setting.
        pairs: Rows of pairs.csv.
    """
    first, *others = groups.values()
    jobs = [row for members in groups.values() for row in members]
    quantities = compared(jobs)
    examined = [name for name in quantities if name in EXAMINED]
    heads = [*settings, *(_head(name, first[0]) for name in quantities)]
    rows = [
        [*_named(members, settings), *(_median(members, name, name not in examined) for name in quantities)]
        + [_count(members, lambda row: row["status"] != "finished"), _passed(members) if examined else "–"]
        for members in groups.values()
    ]
    text = f"{_table([*heads, 'failed', 'passed'], rows)}\n{NOTE}\n"
    if not others:
        return text
    base = next(iter(groups))
    known = {(row["second"], row["quantity"]): row for row in pairs if row["first"] == base}
    rows = [
        [*_named(members, settings), *(_difference(known[name, one], members) for one in quantities)]
        for name, members in groups.items()
        if name != base
    ]
    return f"{text}\n{_table(heads, rows)}\n{DIFFERENCES}\n"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _head(name: str, row: Row) -> str:
    return f"{row['quantity']} at {iteration_of(name, row)}" if name not in EXAMINED else name


def _named(members: Sequence[Row], settings: Sequence[str]) -> list[str]:
    return [members[0][key] or "default" for key in settings]


def with_interval(found: Sequence[float], digits: int) -> str:
    """Median, and in brackets its bootstrap interval of 95 %, which a single value does not have."""
    low, high = interval(found, np.median)
    text = f"{np.median(found):.{digits}g}"
    return text if math.isnan(low) else f"{text} [{low:.{digits}g}, {high:.{digits}g}]"


def _median(members: Sequence[Row], name: str, bracketed: bool) -> str:
    found = list(values(members, name).values())
    if not found:
        return "none"
    text = with_interval(found, 3) if bracketed else f"{np.median(found):.3g}"
    finished = sum(row["status"] == "finished" for row in members)
    return text if len(found) == finished else f"{text} ({len(found)})"


def _difference(row: Mapping[str, Any], members: Sequence[Row]) -> str:
    if not row["pairs"]:
        return "none"
    text = f"{row['difference']:.3g} [{row['low']:.3g}, {row['high']:.3g}]"
    if stands_out(row):
        text = f"**{text}**"
    return text if row["pairs"] == len(members) else f"{text} ({row['pairs']})"


def _passed(members: Sequence[Row]) -> str:
    return _count(members, passes) if any(row["term"] in JUDGED for row in members) else "–"


def _count(members: Sequence[Row], condition) -> str:
    return f"{sum(map(condition, members))} of {len(members)}"
