"""``python -m softmpm_learn.figures FOLDER``: tables and figures of one or more sweeps."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softmpm_learn.figures import sweeps, tables
from softmpm_learn.figures.intervals import pairs
from softmpm_learn.figures.of_sweep import curves_figure, grouped, pairs_figure, values, values_figure
from softmpm_learn.figures.summary import summary, with_interval
from softmpm_learn.figures.sweeps import SweptRun
from softmpm_learn.storage import files
from softmpm_learn.storage.sweep import EXAMINED

CURVES, VALUES, PAIRS, SUMMARY = "curves.png", "values.png", "pairs.png", "summary.md"
HELP = """Tables and figures of sweeps.

  runs.csv     a row for each run and iteration: seed, settings that differ, all columns of metrics.csv
  jobs.csv     a row for each run: values at fixed iterations, lowest loss, examination, status
  pairs.csv    every two settings, paired by seed: mean difference, of the examination the median, with its bootstrap interval of 95 %
  summary.md   a row for each setting: medians, examination, failures, differences from the first setting
  curves.png   median and quartiles over seeds at each iteration
  values.png   values of each seed, with the bootstrap interval of 95 % of their median
  pairs.png    the differences of pairs.csv, those from the first setting if there are many

Sweeps over several tasks leave that in a folder for each task. The first setting is that of the first job.
Runs that failed are in the tables and counted in the figures, and have no part in medians and differences."""


def main(words: Sequence[str] | None = None) -> None:
    """Exit code 0, or 1 after one sentence on what went wrong."""
    parser = argparse.ArgumentParser(
        "python -m softmpm_learn.figures", description=HELP, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", nargs="+", type=Path, help="folder of a sweep, with sweep.csv")
    parser.add_argument("--value", default="loss", help="column of metrics.csv to compare (loss)")
    parser.add_argument(
        "--at", type=int, help="iteration to compare at (the last that all finished runs have)"
    )
    parser.add_argument(
        "--out", type=Path, help="folder of the results (figures in the first sweep's folder)"
    )
    asked = parser.parse_args(words)
    try:
        out = asked.out or asked.folder[0] / "figures"
        print(make(asked.folder, out, asked.value, asked.at))
    except (ValueError, OSError) as error:
        print(f"softmpm_learn.figures: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def make(folders: Sequence[Path], out: Path, quantity: str = "loss", at: int | None = None) -> str:
    """Write the tables, then draw the figures from what they have; gives a summary.

    Raises:
        ValueError: A folder is no sweep, or there is nothing to compare.
    """
    found = sweeps.by_task(sweeps.read(folders))
    texts = []
    for name, runs in found.items():
        if any(run.status == "finished" for run in runs):
            text = _make_task(runs, out / name, quantity, at)
        else:
            text = f"None of {len(runs)} runs has finished."
        texts.append(f"{name}:\n{text}" if name else text)
    return "\n".join(texts)


def _make_task(runs: Sequence[SweptRun], out: Path, quantity: str, at: int | None) -> str:
    """Tables and figures of runs of one task."""
    settings = list(runs[0].settings)
    at = tables.last_iteration(runs) if at is None else at
    rows = tables.by_iteration(runs), tables.by_run(runs, quantity, at)
    with files.named("make the folder", out):
        out.mkdir(parents=True, exist_ok=True)
    for name, table in zip((tables.RUNS, tables.JOBS), rows, strict=True):
        tables.write(out / name, table)
    return draw(out, settings)


def draw(out: Path, settings: Sequence[str]) -> str:
    """Draw the figures from runs.csv and jobs.csv, write pairs.csv; gives a summary."""
    runs, jobs = (tables.load(out / name, settings) for name in (tables.RUNS, tables.JOBS))
    groups = grouped(jobs, settings)
    compared = [
        row
        for name in tables.compared(jobs)
        for row in pairs(
            {setting: values(members, name) for setting, members in groups.items()},
            name,
            np.median if name in EXAMINED else np.mean,  # quotients of small speeds know no bounds
        )
    ]
    curves_figure(out / CURVES, runs, groups, settings)
    values_figure(out / VALUES, jobs, groups, settings)
    names = [tables.RUNS, tables.JOBS, CURVES, VALUES]
    for name in (tables.PAIRS, PAIRS):
        (out / name).unlink(missing_ok=True)  # of other sweeps
    if compared:
        tables.write(out / tables.PAIRS, compared)
        names.append(tables.PAIRS)
    if pairs_figure(out / PAIRS, compared, jobs):
        names.append(PAIRS)
    files.replace(out / SUMMARY, summary(settings, groups, compared).encode())
    names.append(SUMMARY)
    lines = [f"Median of {jobs[0]['quantity']} at iteration {jobs[0]['at']:.0f}, with its interval of 95 %:"]
    for setting, members in groups.items():
        found = list(values(members, "final").values())
        middle = with_interval(found, 4) if found else "none"
        lines.append(f"  {setting}: {middle}, {len(found)} of {len(members)} seeds")
    return "\n".join([*lines, f"{', '.join(names)} are in {out}."])


if __name__ == "__main__":
    main()
