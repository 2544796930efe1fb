"""Maps of the limits and of the named failures: `python bench/stability.py [--device cuda] [--short] [--row NAME]`

Each row varies one quantity up to its extremes, for the laws of bench/extremes/laws.py, in 2D and 3D. Each cell has one of four
outcomes: *right* by criteria that do not use the library's alarms, *refused* by name (ValueError), *stopped* by name (UnstableError;
the kind is shown), or *silent*: a returned state is wrong. Prints a table and writes it to ``--json FILE``; ``--draw FILE`` draws such
a file, and the results of bench/running_limit.py beside it, as docs/images/limits_*.png without measuring.

``--longest`` bounds the rows that vary the length of a run. ``--needless`` repeats refused and stopped cells without alarms and counts
those that are right then.
"""

import argparse
import dataclasses
import functools
import json
import sys
import time
from collections import Counter
from pathlib import Path

import torch
from common import machine
from extremes.cells import How, Outcome, verdict
from extremes.laws import LAWS
from extremes.pages import PAGES
from extremes.picture import draw, draw_limit
from extremes.rows import Row

IMAGES = Path(__file__).parents[1] / "docs" / "images"


def main():
    args = arguments()
    if args.draw:
        draw(PAGES, json.loads(args.draw.read_text())["cells"], IMAGES)
        draw_limit(
            json.loads(args.draw.with_name(args.draw.name.replace(".", ".running.", 1)).read_text())["rows"],
            IMAGES,
        )
        return
    how = How(args.device, longest=int(args.longest))
    print(f"Maps of the extremes ({machine(torch.device(args.device))})")
    cells: list[dict] = []
    for page, rows in PAGES.items():
        for row in rows:
            if args.row in (None, row.name):
                cells += measure(page, row, row.few if args.short else row.values, how, args.needless)
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
    parser.add_argument("--short", action="store_true", help="a few cells of each row")
    names = [row.name for rows in PAGES.values() for row in rows]
    parser.add_argument("--row", choices=names, help="one row only")
    parser.add_argument("--longest", type=float, default=1e4, help="largest number of substeps of a run")
    parser.add_argument("--needless", action="store_true", help="repeat what was stopped without alarms")
    parser.add_argument("--strict", action="store_true", help="exit with 1 if a cell is silent")
    parser.add_argument("--json", type=Path, help="write the cells to this file")
    parser.add_argument("--draw", type=Path, help="draw the cells of this file")
    return parser.parse_args()


def measure(page: str, row: Row, values: tuple, how: How, needless: bool) -> list[dict]:
    """Cells of a row, printed law by law."""
    print(f"\n{row.name}: {row.title}\n    right: {row.right}")
    found = []
    for law in LAWS:
        for dim in (2, 3):
            line = []
            for value in values:
                if dim not in row.dims(value) or (row.counts_substeps and value > how.longest):
                    continue
                begin = time.perf_counter()
                given = verdict(functools.partial(row.cell, law, dim, value, how))
                cell = {"page": page, "row": row.name, "law": law.__name__, "dim": dim, "value": value}
                cell |= dataclasses.asdict(given) | {"seconds": round(time.perf_counter() - begin, 2)}
                if needless and given.outcome in (Outcome.REFUSED, Outcome.STOPPED):
                    bold = dataclasses.replace(how, alarms=False)
                    other = verdict(functools.partial(row.cell, law, dim, value, bold))
                    cell["without alarms"] = other.outcome
                found.append(cell)
                mark = "" if given.outcome is Outcome.RIGHT else given.outcome + " "
                line.append(f"{row.label(value)}: {mark if given.note != given.outcome else ''}{given.note}")
            print(f"    {law.__name__:16} {dim}D  " + " | ".join(line), flush=True)
    return found


def save(path: Path, device: str, cells: list[dict]) -> None:
    content = {"title": "Maps of the extremes", "machine": machine(torch.device(device)), "cells": cells}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
