"""The pictures of sweeps, from the rows of their tables: learning curves, values of each seed, comparisons of settings."""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softmpm_learn.figures import canvas
from softmpm_learn.figures.canvas import COLOURS
from softmpm_learn.figures.intervals import FEWEST, interval, stands_out
from softmpm_learn.figures.tables import Row, compared

LINES = "-", "--", ":"
MOST_ROWS = 60
"""Rows of a picture; more can be read in the table only."""
COLUMNS = 3
"""Panels side by side."""
TITLES = {
    "final": "training",
    "later": "continued to three times its length",
    "kicked": "kicked at the start",
    "friction": "friction ± 25 %",
    "finer": "next finer grid",
    "largest_tilt": "tilt while it continues",
    "largest_miss": "distance from the goal around the end",
    "largest_speed": "speed around the end",
}
EXTREMES = {
    "largest_tilt": "largest tilt [degrees]",
    "largest_miss": "largest distance [m]",
    "largest_speed": "largest speed [m/s]",
}
ANSWERS = {"progress": "speed over that in the episode [1]", "reach": "distance from the goal [m]"}
"""Meaning of the examination, by the first term of the objective."""
QUOTIENTS = -2.0, 3.0
"""Part of the axis of a quotient of speeds that is drawn at most; where a robot hardly moved it can be any number."""


def name_of(row: Row, settings: Sequence[str]) -> str:
    """Name of a setting in legends and in pairs.csv: short keys where they are unambiguous."""
    ends = [key.rpartition(".")[2] for key in settings]
    keys = [end if ends.count(end) == 1 else key for key, end in zip(settings, ends, strict=True)]
    words = [
        f"{key}={row[full]}" if row[full] else f"{key} by default"
        for key, full in zip(keys, settings, strict=True)
    ]
    return ", ".join(words) or "all runs"


def grouped(jobs: Sequence[Row], settings: Sequence[str]) -> dict[str, list[Row]]:
    """Rows of jobs.csv for each setting."""
    found: dict[str, list[Row]] = {}
    for row in jobs:
        found.setdefault(name_of(row, settings), []).append(row)
    return found


def values(rows: Sequence[Row], name: str) -> dict[int, float]:
    """Finite values of the finished runs of a setting, by seed."""
    known = {int(row["seed"]): row[name] for row in rows if row["status"] == "finished"}
    return {seed: value for seed, value in known.items() if math.isfinite(value)}


def shown(jobs: Sequence[Row]) -> list[str]:
    """Columns of jobs.csv that have a panel."""
    return [name for name in compared(jobs) if name in TITLES]


def label(name: str, jobs: Sequence[Row]) -> str:
    """Axis label of a column of jobs.csv, with its unit."""
    if name == "final":
        return f"{jobs[0]['quantity']} at iteration {jobs[0]['at']:.0f}"
    if name in EXTREMES:
        return EXTREMES[name]
    terms = {row["term"] for row in jobs if row["term"]}
    return ANSWERS.get(terms.pop(), "answer") if len(terms) == 1 else "answer"


def curves_figure(
    path: Path, runs: Sequence[Row], groups: Mapping[str, Sequence[Row]], settings: Sequence[str]
) -> None:
    """Median and interquartile range over the seeds of each setting, at each iteration up to the last that all have.

    Args:
        runs: Rows of runs.csv.
        groups: Rows of jobs.csv for each setting; runs that failed are counted in the legend and not drawn. Values outside of an axis
            that they would flatten are marked at its edge.
        settings: Columns of jobs.csv in which runs differ.
    """
    first = next(iter(groups.values()))[0]
    quantity, last = first["quantity"], first["at"]
    series: dict[int, dict[int, float]] = {}
    for row in runs:
        if row["iteration"] <= last and math.isfinite(row[quantity]):
            series.setdefault(int(row["run"]), {})[int(row["iteration"])] = row[quantity]
    panels, styles = curve_panels(groups, settings), _styles(groups, settings)
    widest = max(len(_count(name, members)) for lines in panels.values() for name, members in lines.items())
    columns = 2 if widest <= 42 else 1
    figure, grid = _curve_axes(len(panels), -(-len(groups) // columns))
    scale = canvas.scale([value for line in series.values() for value in line.values()])
    quartiles = {
        (title, name): _quartiles(members, series)
        for title, lines in panels.items()
        for name, members in lines.items()
    }
    ends = canvas.limits(np.concatenate([table.ravel() for _, table in quartiles.values()]), scale)
    for axes, (title, lines) in zip(grid, panels.items(), strict=False):
        for name, members in lines.items():
            _curve(axes, *quartiles[title, name], styles[name], _count(name, members))
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_yscale(scale)
        of_panel = [(*quartiles[title, name], styles[name][0]) for name in lines]
        canvas.limit(axes, ends, [(x, y, colour) for x, table, colour in of_panel for y in table])
        axes.spines[["top", "right"]].set_visible(False)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.margins(x=0.01)
        if len(panels) > 1:
            axes.legend(frameon=False, fontsize=7)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    if len(panels) == 1:  # the layout sets the label of a figure into a legend outside of its axes
        grid[0].set_xlabel("iteration", fontsize=10)
    else:
        figure.supxlabel("iteration", fontsize=10)
    figure.supylabel(f"{quantity}, median and quartiles over seeds", fontsize=10)
    if len(panels) == 1:
        figure.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize=min(9, 800 / widest))
    canvas.save(figure, path, dpi=130)


def curve_panels(
    groups: Mapping[str, Sequence[Row]], settings: Sequence[str]
) -> dict[str, dict[str, Sequence[Row]]]:
    """Settings of each panel of curves.png: all in one, or where colours do not suffice a panel for each combination of all but the one
    with the most values."""
    coloured = _coloured(groups, settings)
    if coloured == list(settings):
        return {"": dict(groups)}
    others, found = [key for key in settings if key not in coloured], {}
    for members in groups.values():
        found.setdefault(name_of(members[0], others), {})[name_of(members[0], coloured)] = members
    return found


def _coloured(groups: Mapping[str, Sequence[Row]], settings: Sequence[str]) -> list[str]:
    """Settings that have colours: all, or where colours do not suffice the one with the most values."""
    if len(groups) <= len(COLOURS) or len(settings) < 2:
        return list(settings)
    firsts = [members[0] for members in groups.values()]
    return [max(reversed(settings), key=lambda key: len({row[key] for row in firsts}))]


def _styles(groups: Mapping[str, Sequence[Row]], settings: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and dashes of each value of the settings that have colours, the same in all pictures."""
    names = (name_of(members[0], _coloured(groups, settings)) for members in groups.values())
    looks = ((colour, dashes) for dashes in itertools.cycle(LINES) for colour in COLOURS)
    return dict(zip(dict.fromkeys(names), looks, strict=False))


def _curve_axes(panels: int, rows: int) -> tuple[Any, np.ndarray]:
    """A figure with so many panels, or with one and room for a legend of so many rows below."""
    if panels == 1:
        figure = canvas.figure(7.2, 3.6 + 0.22 * rows)
        return figure, figure.subplots(1, 1, squeeze=False).ravel()
    high = -(-panels // 2)
    figure = canvas.figure(9.0, 0.4 + 3.0 * high)
    return figure, figure.subplots(high, 2, squeeze=False, sharex=True, sharey=True).ravel()


def _quartiles(
    members: Sequence[Row], series: Mapping[int, dict[int, float]]
) -> tuple[list[int], np.ndarray]:
    """Iterations of the runs of one setting, and quartiles and median over them, shape (3, iteration)."""
    finished = [int(row["run"]) for row in members if row["status"] == "finished"]
    lines = [series.get(number, {}) for number in finished]
    iterations = sorted({k for line in lines for k in line})
    table = np.array([[line.get(k, math.nan) for k in iterations] for line in lines])
    return iterations, np.nanquantile(table, [0.25, 0.5, 0.75], axis=0) if table.size else np.empty((3, 0))


def _curve(axes, iterations: Sequence[int], quartiles: np.ndarray, style, text: str) -> None:
    """The curve of one setting; of a single run there is no band."""
    (low, middle, high), (colour, dashes) = quartiles, style
    marker = "o" if len(iterations) < 3 else None
    axes.plot(iterations, middle, dashes, color=colour, marker=marker, linewidth=2, label=text)
    axes.fill_between(iterations, low, high, color=colour, alpha=0.18, linewidth=0)


def _count(name: str, members: Sequence[Row]) -> str:
    failed = sum(row["status"] != "finished" for row in members)
    words = f"{len(members) - failed} of {len(members)} seeds, {failed} failed"
    return f"{name} ({words if failed else f'{len(members)} seed' + 's' * (len(members) > 1)})"


def values_figure(
    path: Path, jobs: Sequence[Row], groups: Mapping[str, Sequence[Row]], settings: Sequence[str]
) -> None:
    """Each seed as a point, for each setting and quantity, and the median with its bootstrap interval of 95 %."""
    names = [_count(name, members) for name, members in groups.items()]
    panels = {name: label(name, jobs) for name in shown(jobs)}
    styles, coloured = _styles(groups, settings), _coloured(groups, settings)

    def draw(axes, name: str) -> list[float]:
        drawn = []
        for place, members in enumerate(groups.values()):
            colour, _ = styles[name_of(members[0], coloured)]
            found = list(values(members, name).values())
            drawn += found
            if not found:
                continue
            beside = place - 0.28 + 0.16 * np.arange(len(found)) / max(1, len(found) - 1)
            axes.scatter(found, beside, s=14, color=colour, alpha=0.7, linewidths=0)
            low, high = interval(found, np.median)
            axes.plot([low, high], [place + 0.1] * 2, color=colour, linewidth=2)
            axes.plot(np.median(found), place + 0.1, "D", color=colour, markersize=5)
        return drawn

    _panels(
        path, names, panels, draw, "points: seeds; diamonds: their median with a bootstrap interval of 95 %"
    )


def pairs_figure(path: Path, pairs: Sequence[Mapping[str, Any]], jobs: Sequence[Row]) -> bool:
    """Difference of every two settings, paired by seed, with its interval, or of the first and every other one if that would be
    too many; False if there is nothing to draw, or still too much."""
    if len({(row["first"], row["second"]) for row in pairs}) > MOST_ROWS:
        pairs = [row for row in pairs if row["first"] == pairs[0]["first"]]
    names = list(dict.fromkeys(f"{row['first']}  −  {row['second']}" for row in pairs))
    panels = {name: f"difference of {label(name, jobs)}" for name in shown(jobs)}
    if not any(row["pairs"] for row in pairs) or len(names) > MOST_ROWS:
        return False

    def draw(axes, name: str) -> list[float]:
        axes.axvline(0.0, color="0.6", linewidth=0.8)
        drawn = [row for row in pairs if row["quantity"] == name]
        for place, row in enumerate(drawn):
            colour = COLOURS[0] if stands_out(row) else "0.45"
            axes.plot([row["low"], row["high"]], [place] * 2, color=colour, linewidth=2)
            axes.plot(row["difference"], place, "o", color=colour, markersize=5)
        return [row["difference"] for row in drawn]

    _panels(
        path,
        names,
        panels,
        draw,
        "mean over pairs of seeds, of the examination the median; bootstrap interval of 95 %; blue: without zero, of "
        f"{FEWEST} pairs or more",
    )
    return True


def _limit(axes, drawn: Sequence[float], low: float, high: float) -> None:
    """Show no more of the horizontal axis than this, unless everything lies outside, and count above the axes what does."""
    left, right = axes.get_xlim()
    if left < high and right > low:
        axes.set_xlim(max(left, low), min(right, high))
        outside = sum(value < low or value > high for value in drawn)
        axes.set_title(f"{outside} outside" if outside else "", fontsize=7, loc="right")


def _panels(path: Path, names: Sequence[str], panels: Mapping[str, str], draw, note: str) -> None:
    """Panels with one row for each name, from top to bottom; ``draw`` returns the values of its points."""
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    figure = canvas.figure(
        2.7 * columns + 0.075 * max(map(len, names)) + 0.3, rows * (0.34 * len(names) + 1.15) + 0.3
    )
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes, (name, text) in zip(grid.ravel(), panels.items(), strict=False):
        drawn = draw(axes, name)
        axes.set_xlabel(text, fontsize=8)
        axes.set_title(TITLES[name], fontsize=9, loc="left")
        if ANSWERS["progress"] in text:
            _limit(axes, drawn, *QUOTIENTS)
        axes.xaxis.get_major_locator().set_params(nbins=5)
        axes.tick_params(labelsize=8)
        axes.xaxis.get_offset_text().set_fontsize(8)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid.ravel()[len(panels) :]:
        axes.set_axis_off()
    grid[0, 0].set_yticks(range(len(names)), names)
    grid[0, 0].set_ylim(len(names) - 0.5, -0.5)
    figure.supxlabel(note, fontsize=7, wrap=True)
    canvas.save(figure, path, dpi=130)
