"""Maps of the limits and of the named failures: `python bench/stability.py [--device cuda] [--processes 16]`

Each row varies one quantity up to its extremes, for the laws of bench/extremes/laws.py, in 2D and 3D. Each cell has one of four
outcomes: *right* by criteria that do not use the library's alarms, *refused* by name (ValueError), *stopped* by name (UnstableError;
the kind is shown), or *silent*: a returned state is wrong. Prints a table and writes it to ``--json FILE``; ``--draw FILE`` draws such
a file, and the results of bench/running_limit.py beside it, as docs/images/limits_*.png without measuring.

``--longest`` bounds the rows that vary the length of a run. ``--needless`` repeats refused and stopped cells without alarms and counts
those that are right then. ``--processes`` runs laws and rows in so many processes at once; set
OMP_NUM_THREADS=1, so that each has one thread.
"""

import argparse
import dataclasses
import functools
import json
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import torch
from common import machine
from extremes.cells import How, Outcome, verdict
from extremes.laws import LAWS
from extremes.pages import PAGES
from extremes.picture import draw, draw_limit

IMAGES = Path(__file__).parents[1] / "docs" / "images"
ROWS = {row.name: row for rows in PAGES.values() for row in rows}


def main():
    args = arguments()
    if args.draw:
        draw(PAGES, json.loads(args.draw.read_text())["cells"], IMAGES)
        draw_limit(
            json.loads(args.draw.with_name(args.draw.name.replace(".", ".running.", 1)).read_text())["rows"],
            IMAGES,
        )
        return
    how = How(args.device, args.formulation, longest=int(args.longest))
    print(f"Maps of the extremes ({machine(torch.device(args.device))})")
    rows = [row.name for rows in PAGES.values() for row in rows if args.row in (None, row.name)]
    parts = [Part(row, law.__name__, args.short, args.needless, how) for row in rows for law in LAWS]
    cells: list[dict] = []
    for part, (lines, found) in zip(parts, measured(parts, args.processes), strict=True):
        if part.law == LAWS[0].__name__:
            print(f"\n{part.row}: {ROWS[part.row].title}\n    right: {ROWS[part.row].right}")
        print("\n".join(lines), flush=True)
        cells += found
        if args.json:
            save(args.json, args.device, cells)
    count = Counter(cell["outcome"] for cell in cells)
    print(", ".join(f"{count[outcome]} {outcome}" for outcome in Outcome), f"of {len(cells)} cells")
    if args.needless:
        right = sum(cell.get("without alarms") == Outcome.RIGHT for cell in cells)
        print(f"{right} that were refused or stopped are right without alarms")
    sys.exit(1 if count[Outcome.SILENT] and args.strict else 0)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--formulation", default="moving", choices=["moving", "reference"])
    parser.add_argument("--short", action="store_true", help="a few cells of each row")
    parser.add_argument("--row", choices=list(ROWS), help="one row only")
    parser.add_argument("--processes", type=int, default=1, help="number of processes")
    parser.add_argument("--longest", type=float, default=1e4, help="largest number of substeps of a run")
    parser.add_argument("--needless", action="store_true", help="repeat what was stopped without alarms")
    parser.add_argument("--strict", action="store_true", help="exit with 1 if a cell is silent")
    parser.add_argument("--json", type=Path, help="write the cells to this file")
    parser.add_argument("--draw", type=Path, help="draw the cells of this file")
    return parser.parse_args()


class Part(NamedTuple):
    """Part of the maps: one law in one row, both by their names, which another process looks up."""

    row: str
    law: str
    short: bool
    needless: bool
    how: How


def measured(parts: list[Part], processes: int) -> Iterator[tuple[list[str], list[dict]]]:
    """:func:`measure` of each part, in their order."""
    if processes == 1:
        yield from map(measure, parts)
        return
    # A process that has used CUDA cannot be forked:
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(measure, parts)


def measure(part: Part) -> tuple[list[str], list[dict]]:
    """Lines to print, one for each dimension, and the cells."""
    row, how = ROWS[part.row], part.how
    page = next(page for page, rows in PAGES.items() if row in rows)
    law = next(law for law in LAWS if law.__name__ == part.law)
    lines, found = [], []
    for dim in (2, 3):
        line = []
        for value in row.few if part.short else row.values:
            if dim not in row.dims(value) or (row.counts_substeps and value > how.longest):
                continue
            begin = time.perf_counter()
            given = verdict(functools.partial(row.cell, law, dim, value, how))
            cell = {"page": page, "row": row.name, "law": part.law, "dim": dim, "value": value}
            cell |= dataclasses.asdict(given) | {"seconds": round(time.perf_counter() - begin, 2)}
            if part.needless and given.outcome in (Outcome.REFUSED, Outcome.STOPPED):
                bold = dataclasses.replace(how, alarms=False)
                cell["without alarms"] = verdict(functools.partial(row.cell, law, dim, value, bold)).outcome
            found.append(cell)
            mark = "" if given.outcome is Outcome.RIGHT else given.outcome + " "
            line.append(f"{row.label(value)}: {mark if given.note != given.outcome else ''}{given.note}")
        lines.append(f"    {part.law:16} {dim}D  " + " | ".join(line))
    return lines, found


def save(path: Path, device: str, cells: list[dict]) -> None:
    content = {"title": "Maps of the extremes", "machine": machine(torch.device(device)), "cells": cells}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
