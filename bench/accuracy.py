"""Error and cost of both formulations at problems with exact answers: `python bench/accuracy.py [--json FILE]`

The problems are in bench/problems, and docs/accuracy.md explains them. ``error %`` is that of a mean over a window, ``drift %`` its
change since the window before, ``order`` the exponent of the spacing by which the error fell from the row with half as many cells; the
cost is in millions of particle-substeps. Float64 on one CPU thread.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import torch
from common import Table
from problems import contact, statics, waves

KINDS = ("reference", "reference, stick", "moving")


def measured() -> Iterator[tuple[dict, dict]]:
    """Name and settings of each problem, and what was found."""
    for kind in KINDS:
        for size in ((2, 2), (2, 3), (3, 3), (4, 2)):
            yield named("beam, tip sinks by 0.2 L", kind, size), statics.beam(kind, *size, sinks=0.2, dim=2)
    for kind in ("reference", "moving"):
        for size in ((2, 3), (3, 3), (4, 3)):
            found = statics.beam(kind, *size, sinks=0.2, dim=2, periods=20.0)
            yield named("the same, at rest", kind, size), found
        for size in ((2, 3), (3, 3)):
            large = dict(sinks=0.65, dim=2, step=0.8, periods=14.0)
            yield named("beam, tip sinks by 0.65 L", kind, size), statics.beam(kind, *size, **large)
            found = statics.beam(kind, *size, **large, softens=True)
            yield named("the same, softening section", kind, size), found
        for size in ((2, 2), (2, 3)):
            yield named("beam in 3D, 0.2 L", kind, size), statics.beam(kind, *size, sinks=0.2, dim=3)
        for size in ((2, 2), (4, 2), (2, 3), (4, 3)):
            yield named("twisted bar in 3D", kind, size), statics.twisted(kind, *size)
        for size in ((2, 2), (4, 2), (2, 3), (4, 3)):
            yield named("the same, sides on nodes", kind, size), statics.twisted(kind, *size, beyond=0.0)
    for kind in KINDS:
        for cells in (8, 16, 32):
            yield named("column under its weight", kind, (cells, 2)), statics.column(kind, cells, 2)
        for cells in (8, 16, 32):
            yield named("clamped bar, frequency", kind, (cells, 2)), waves.bar(kind, cells, 2, clamped=True)
    for kind in ("reference", "moving"):
        for cells in (8, 16, 32):
            yield named("free bar, frequency", kind, (cells, 2)), waves.bar(kind, cells, 2, clamped=False)
        for cells in (16, 32, 64):
            yield named("breathing disc, frequency", kind, (cells, 2)), waves.disc(kind, cells, 2)
    for kind in ("reference", "moving"):
        for size in ((32, 2), (32, 3), (64, 3)):
            for quantity, found in contact.hertz(*size, kind).items():
                yield named(f"disc on a floor, {quantity}", kind, size), found
        for size in ((2, 2), (4, 2)):
            yield named("block on a floor, gap / h", kind, size), contact.gap(*size, kind)


def named(problem: str, kind: str, size: tuple[int, int]) -> dict:
    cells, per_cell = size
    return {"problem": problem, "formulation": kind, "cells": cells, "per cell": per_cell}


def order(row: dict, above: list[dict]) -> float | None:
    """Exponent of the spacing by which the error fell from the row with half as many cells; None without one."""
    for coarse in above:
        same = all(coarse[k] == row[k] for k in ("problem", "formulation", "per cell"))
        if same and row["cells"] == 2 * coarse["cells"]:
            return math.log2(abs(coarse["error %"] / row["error %"]))
    return None


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    table = Table("Problems with exact answers, float64", torch.device("cpu"), parser.parse_args().json)
    for name, found in measured():
        row = name | found
        table.add(row | {"order": order(row, table.rows)})


if __name__ == "__main__":
    main()
