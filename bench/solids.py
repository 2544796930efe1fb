"""Contact of 3D bodies with walls against exact answers: `python bench/solids.py [--formulation reference] [--json FILE]`

The problems are in bench/problems, solids.py and spheres.py, and docs/accuracy.md explains them. ``place`` is where the body lies in
the cells of the grid, and ``turned`` its angle to it; an exact answer of 0 has no relative error. Float64 on one CPU thread.
"""

import time
from collections.abc import Iterator

import torch
from common import Table, arguments
from problems import solids, spheres

PLACES = ((0.5, 0.5, 0.5), (0.0, 0.0, 0.0), (0.25, 0.1, 0.4))
"""Displacements of a body against the grid [cells]."""


def problems(formulation: str) -> Iterator[tuple[str, int, dict, dict[str, solids.Found]]]:
    """Name, cells, further settings, and what was found."""
    for cells, places in ((4, PLACES), (8, PLACES[1:])):
        for place in places:
            yield (
                "sphere between plates",
                cells,
                dict(place=place),
                spheres.pressed(cells, formulation, place),
            )
    on_z = spheres.pressed(4, formulation, PLACES[1], axis=2)
    yield "the same, plates across z", 4, dict(place=PLACES[1]), on_z
    for cells, place, turned in (
        *((4, place, 0.0) for place in PLACES),
        (4, PLACES[0], 30.0),
        (6, PLACES[0], 30.0),
    ):
        found = solids.slid(cells, formulation, place, turned)
        yield "block on inclines", cells, dict(place=place, turned=turned), found
    for what, cells, places in (
        ("cube", 4, PLACES),
        ("cube", 6, PLACES[2:]),
        ("sphere", 6, PLACES),
        ("sphere", 9, PLACES[2:]),
    ):
        for place in places:
            yield f"{what} at rest", cells, dict(place=place), solids.rests(cells, formulation, what, place)
    for what, cells in (("disc", 4), ("square", 4), ("square", 8)):
        yield f"{what} that spins", cells, {}, solids.spins(cells, formulation, what)
    for cells, place, rows in (
        (4, PLACES[1], spheres.ROLLS),
        (4, PLACES[2], spheres.ROLLS),
        (6, PLACES[2], spheres.ROLLS[1::3]),
    ):
        yield "sphere that rolls", cells, dict(place=place), spheres.rolls(cells, formulation, place, rows)


def main():
    args = arguments(__doc__, formulations=True)
    table = Table(f"Contact in 3D, {args.formulation}, float64", torch.device("cpu"), args.json)
    begin = time.perf_counter()
    for problem, cells, settings, found in problems(args.formulation):
        seconds, begin = time.perf_counter() - begin, time.perf_counter()
        for quantity, (measured, exact) in found.items():
            row = {"problem": problem, "cells": cells, "place": None, "turned": 0.0} | settings
            error = 100 * (measured / exact - 1) if exact else None
            table.add(
                row
                | {"quantity": quantity, "measured": measured, "exact": exact, "error %": error, "s": seconds}
            )


if __name__ == "__main__":
    main()
