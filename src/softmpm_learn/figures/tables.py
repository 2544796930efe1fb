"""The tidy tables of sweeps, from which all figures are drawn: a row per run and iteration, and a row per run."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from softmpm_learn.figures.sweeps import SweptRun
from softmpm_learn.storage.files import replace
from softmpm_learn.storage.sweep import EXAMINED

RUNS, JOBS, PAIRS = "runs.csv", "jobs.csv", "pairs.csv"
Row = dict[str, Any]
FIXED = 10, 20, 40
"""Iterations whose values are compared besides the last."""
TEXTS = "sweep", "status", "quantity", "term", "folder", "error"
"""Columns of words; of the others, those of settings are words and all else are numbers."""


def last_iteration(runs: Sequence[SweptRun]) -> int:
    """The last iteration that all finished runs have."""
    return min(max(run.rows, default=0) for run in runs if run.status == "finished")


def by_iteration(runs: Sequence[SweptRun]) -> list[Row]:
    """A row for each run and iteration: run, seed, settings that differ, and all columns of metrics.csv."""
    return [
        _named(number, run) | {"iteration": k} | run.rows[k]
        for number, run in enumerate(runs)
        for k in sorted(run.rows)
    ]


def by_run(runs: Sequence[SweptRun], quantity: str, at: int) -> list[Row]:
    """A row for each run: ``final`` is the value of a column of metrics.csv at one iteration, and ``at_10`` that at an earlier one of
    :data:`FIXED`; then the lowest loss and the examination.

    Raises:
        ValueError: No run has the column, or a value at this iteration.
    """
    known = dict.fromkeys(name for run in runs for name in run.columns)
    if quantity not in known:
        raise ValueError(f"metrics.csv has no column {quantity}; it has {', '.join(known)}.")
    rows = []
    for number, run in enumerate(runs):
        losses = {k: row["loss"] for k, row in run.rows.items()}
        best = min(losses, key=lambda k: losses[k], default=None)
        rows.append(
            _named(number, run)
            | {
                "status": run.status,
                "iterations": len(run.rows),
                "quantity": quantity,
                "at": at,
                "final": run.rows.get(at, {}).get(quantity, math.nan),
            }
            | {f"at_{k}": run.rows.get(k, {}).get(quantity, math.nan) for k in FIXED if k < at}
            | {
                "best": math.nan if best is None else losses[best],
                "best_iteration": math.nan if best is None else best,
                "term": run.columns[1] if len(run.columns) > 1 else "",
            }
            | {name: run.examination.get(name, math.nan) for name in EXAMINED}
            | {"folder": str(run.folder), "error": run.error}
        )
    if not any(math.isfinite(row["final"]) for row in rows):
        raise ValueError(f"no run has a value of {quantity} at iteration {at}; choose another one with --at.")
    return rows


def compared(jobs: Sequence[Row]) -> list[str]:
    """Columns of jobs.csv in which settings are compared: those with a number, of the values at fixed iterations and the answers."""
    columns = [*(f"at_{k}" for k in FIXED), "final", *EXAMINED]
    return [name for name in columns if any(math.isfinite(row.get(name, math.nan)) for row in jobs)]


def iteration_of(name: str, row: Row) -> int:
    """The iteration of a column of jobs.csv that has values at one."""
    return int(row["at"] if name == "final" else name.removeprefix("at_"))


def _named(number: int, run: SweptRun) -> Row:
    settings = {key: value for key, value in run.settings.items() if key != "sweep"}
    return {"run": number, "sweep": run.sweep, "job": run.job, "seed": run.seed} | settings


def write(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a table; its columns are all that occur, and what a row lacks, or is nan, is an empty cell."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    table.writeheader()
    table.writerows(
        {name: "" if isinstance(v, float) and math.isnan(v) else v for name, v in row.items()} for row in rows
    )
    replace(path, text.getvalue().encode())


def load(path: Path, texts: Sequence[str] = ()) -> list[Row]:
    """Read a table; an empty cell of a number is nan.

    Args:
        texts: Further columns of words: the settings.
    """
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    words = {*TEXTS, *texts}
    return [
        {name: v if name in words else float(v) if v else math.nan for name, v in row.items()} for row in rows
    ]
