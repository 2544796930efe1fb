"""Accuracy of a walk: `python bench/gait.py {walk,surface,gradient,growth,precision} --device cpu [--gait NAME] [--json FILE]`

Two open-loop gaits of the biped, learned at 80 cells per metre on the moving grid in 45 Adam steps, are replayed (``gaits.json``;
docs/gait.md has the commands): `viscous` was learned with η/μ = 1 ms, `elastic` without viscosity.

**walk**: displacement of the centre of mass after 0.5 s and 1 s [mm], mean and standard deviation over four positions of the grid,
each a quarter of a cell further; float64. Errors are those of the means, against the mean on the finest grid in the reference
formulation; ``±`` is the uncertainty of that limit: its standard error, and its change from the next finest grid.

**surface**: the same on the moving grid with contact at surface points, against the limits of `results/gait.walk.cpu.json`.

**gradient**: cosine between directional derivatives of the displacement after 1 s and central secants, for eight random directions in
the space of all activations; float64, 80 cells per metre.

**growth**: ratio of the differences, after 1 s and after 0.1 s, of two walks whose activations in the first control step differ by
1e-7; root mean square over the particles, in the reference formulation at 80 cells per metre.

**precision**: float32 against float64 after 1000 substeps at 80 cells per metre. Largest differences of the state, in units of the
largest displacement, speed, velocity gradient and deformation, and cosine of the gradients of the displacement with respect to all
activations.
"""

import argparse
import dataclasses
import itertools
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from common import Table, on_grid

import softmpm
from softmpm_learn.tasks import BipedConf, Task, biped

GAITS = json.loads(Path(__file__).with_name("gaits.json").read_text())
CELLS = {
    1e-3: {"reference": (224, 160, 112, 80, 56, 40), "moving": (160, 112, 80, 56, 40)},
    4e-3: {"reference": (160, 112, 80, 56, 40), "moving": (160, 112, 80, 56, 40)},
}
"""Cells per metre for each η/μ [s]; the first of the reference formulation is the limit."""
ON_SURFACE = {1e-3: (112, 80, 56, 40), 4e-3: (80, 56, 40)}
"""The same of the moving grid with contact at surface points."""
SHIFTS = (0.0, 0.25, 0.5, 0.75)
"""Displacements of the robot against the grid in cells."""
DIRECTIONS, STEP = 8, 1e-2
GRADIENTS = [
    (1e-3, "moving", "nodes", 0.0),
    *((1e-3, "moving", "surface", width) for width in (0.0, 0.01)),
    (1e-3, "reference", "nodes", 0.0),
    *((1e-3, "reference", "surface", width) for width in (0.0, 0.01, 0.03)),
    (4e-3, "moving", "nodes", 0.0),
    *((4e-3, "reference", "surface", width) for width in (0.0, 0.01)),
]
"""η/μ [s], formulation, contact and width."""
GROWTH = [
    *((1e-3, safety, 0.0, 0.8) for safety in (0.4, 0.2, 0.1)),
    *((4e-3, safety, 0.0, 0.8) for safety in (0.4, 0.1)),
    (1e-3, 0.1, 0.0, 0.0),
    (1e-3, 0.1, 0.03, 0.8),
]
"""η/μ [s], share of the stable step, width and friction."""


def walker(cells: int, **settings) -> Task:
    return biped(on_grid(BipedConf, cells)(**dict(safety=0.4, contact_width=0.0) | settings))


def replayed(
    task: Task, gait: np.ndarray, shift: float, device, dtype=torch.float64
) -> tuple[softmpm.Model, torch.Tensor]:
    """Model of a task whose robot is displaced by a part of a cell, and the activations for it."""
    (body,), spacing = task.scene.bodies, task.scene.grid.spacing
    moved = dataclasses.replace(body, particles=body.particles.moved((shift * spacing, 0.0)))
    scene = dataclasses.replace(task.scene, bodies=[moved])
    # The substeps were chosen for the rest state.
    settings = dict(task.build, alarms=softmpm.Alarms(step=None))
    model = softmpm.build(scene, device=device, dtype=dtype, **settings)
    return model, torch.tensor(gait, dtype=dtype, device=device)[:, None]


def run(task: Task, model: softmpm.Model, activation: torch.Tensor, start=None) -> softmpm.State:
    return softmpm.simulate(model, start or model.rest(), activation, model.params(), substeps=task.substeps)


def travelled(model: softmpm.Model, state: softmpm.State) -> torch.Tensor:
    """Displacement of the centre of mass along x [m]."""
    share = model.mass / model.mass.sum()
    return share @ (state.x[0, :, 0] - model.positions[:, 0])


@torch.no_grad()
def walk(
    cells: int, formulation: str, retardation: float, gait: np.ndarray, device, contact: str
) -> tuple[np.ndarray, float]:
    """Displacements after each half of the gait, shape (shift, 2), NaN where a simulation stopped; and seconds of one run."""
    task = walker(cells, formulation=formulation, retardation=retardation, contact=contact)
    found, begin = np.full((len(SHIFTS), 2), math.nan), time.perf_counter()
    for row, shift in zip(found, SHIFTS, strict=True):
        model, activation = replayed(task, gait, shift, device)
        try:
            half = len(gait) // 2
            middle = run(task, model, activation[:half])
            row[0] = travelled(model, middle).item()
            row[1] = travelled(model, run(task, model, activation[half:], middle)).item()
        except softmpm.UnstableError as error:
            print(f"{formulation}, {cells} cells/m, shift {shift}: {error}")
    return found, (time.perf_counter() - begin) / len(SHIFTS)


def walks(table: Table, gaits: dict, device) -> None:
    for (name, gait), (retardation, grids) in itertools.product(gaits.items(), CELLS.items()):
        finest, next_finest = (
            walk(cells, "reference", retardation, np.array(gait), device, "surface")
            for cells in grids["reference"][:2]
        )
        limit = finest[0].mean(axis=0)
        doubt = np.hypot(
            finest[0].std(axis=0, ddof=1) / math.sqrt(len(SHIFTS)), limit - next_finest[0].mean(axis=0)
        )
        done = dict(zip(grids["reference"], (finest, next_finest), strict=False))
        for formulation in grids:
            for cells in grids[formulation]:
                known = done.get(cells) if formulation == "reference" else None
                contact = {"reference": "surface", "moving": "nodes"}[formulation]
                found, seconds = known or walk(
                    cells, formulation, retardation, np.array(gait), device, contact
                )
                row = {
                    "gait": name,
                    "η/μ ms": 1e3 * retardation,
                    "formulation": formulation,
                    "cells/m": cells,
                }
                for k, when in enumerate(("0.5 s", "1 s")):
                    mean = found[:, k].mean()
                    row |= {f"{when} mm": 1e3 * mean, f"{when} std": 1e3 * found[:, k].std(ddof=1)}
                    row |= {
                        f"{when} error %": 100 * (mean / limit[k] - 1),
                        f"{when} ± %": 100 * doubt[k] / limit[k],
                    }
                table.add({k: None if v != v else v for k, v in row.items()} | {"s": seconds})


def surface_walks(table: Table, gaits: dict, device) -> None:
    known = json.loads(Path(__file__).with_name("results").joinpath("gait.walk.cpu.json").read_text())["rows"]
    for (name, gait), (retardation, grids) in itertools.product(gaits.items(), ON_SURFACE.items()):
        (limit,) = (
            row
            for row in known
            if (row["gait"], row["formulation"]) == (name, "reference")
            and math.isclose(row["η/μ ms"], 1e3 * retardation)
            and row["0.5 s error %"] == row["1 s error %"] == 0.0
        )
        for cells in grids:
            found, seconds = walk(cells, "moving", retardation, np.array(gait), device, "surface")
            row = {"gait": name, "η/μ ms": 1e3 * retardation, "contact": "surface", "cells/m": cells}
            for k, when in enumerate(("0.5 s", "1 s")):
                mean = 1e3 * found[:, k].mean()
                row |= {f"{when} mm": mean, f"{when} std": 1e3 * found[:, k].std(ddof=1)}
                row |= {f"{when} error %": 100 * (mean / limit[f"{when} mm"] - 1)}
            table.add({k: None if v != v else v for k, v in row.items()} | {"s": seconds})


def gradients(table: Table, gaits: dict, device) -> None:
    for (name, gait), (retardation, formulation, contact, width) in itertools.product(
        gaits.items(), GRADIENTS
    ):
        settings = dict(formulation=formulation, contact=contact, contact_width=width)
        task = walker(80, retardation=retardation, **settings)
        model, activation = replayed(task, np.array(gait), 0.0, device)
        activation.requires_grad_()
        (gradient,) = torch.autograd.grad(travelled(model, run(task, model, activation)), activation)
        generator = torch.Generator().manual_seed(1)
        ways = torch.randn(DIRECTIONS, *activation.shape, generator=generator, dtype=activation.dtype).to(
            device
        )
        slopes = (ways * gradient).flatten(1).sum(dim=1)
        with torch.no_grad():
            ends = [
                [travelled(model, run(task, model, activation + sign * STEP * way)) for sign in (1, -1)]
                for way in ways
            ]
        secants = torch.tensor([(a - b).item() / (2 * STEP) for a, b in ends], device=device)
        ratio = secants / slopes
        row = {"gait": name, "η/μ ms": 1e3 * retardation, "formulation": formulation}
        row |= {"contact": contact, "width": width}
        row |= {"cosine": torch.cosine_similarity(secants.double(), slopes.double(), dim=0).item()}
        row |= {"slope": float(secants.double() @ slopes / (slopes @ slopes))}
        row |= {"within 2x": int(((ratio > 0.5) & (ratio < 2)).sum()), "norm m": gradient.norm().item()}
        table.add(row)


def precision(table: Table, gaits: dict, device) -> None:
    cases = [("moving", "nodes", 0.0), ("reference", "surface", 0.0), ("reference", "surface", 0.01)]
    for (name, gait), (formulation, contact, width) in itertools.product(gaits.items(), cases):
        task = walker(80, formulation=formulation, contact=contact, contact_width=width, retardation=1e-3)
        steps, found = math.ceil(1000 / task.substeps), []
        for dtype in (torch.float64, torch.float32):
            model, activation = replayed(task, np.array(gait)[:steps], 0.0, device, dtype)
            activation.requires_grad_()
            end = run(task, model, activation)
            (gradient,) = torch.autograd.grad(travelled(model, end), activation)
            moved = end.x.detach().double() - torch.as_tensor(model.exact_positions, device=device)
            turned = end.F.detach().double() - torch.eye(model.dim, dtype=torch.float64, device=device)
            found.append((moved, end.v.detach().double(), end.C.detach().double(), turned, gradient.double()))
        row = {"gait": name, "formulation": formulation, "contact": contact, "width": width}
        row |= {"substeps": steps * task.substeps}
        for part, exact, rounded in zip(("x", "v", "C", "F"), *found, strict=False):
            row[part] = float((rounded - exact).abs().max() / exact.abs().max())
        exact, rounded = (parts[-1].flatten() for parts in found)
        row["1 - cosine"] = 1 - torch.cosine_similarity(exact, rounded, dim=0).item()
        table.add(row)


@torch.no_grad()
def growth(table: Table, gaits: dict, device) -> None:
    for (name, gait), (retardation, safety, width, friction) in itertools.product(gaits.items(), GROWTH):
        settings = dict(formulation="reference", contact_width=width, friction=friction, safety=safety)
        task = walker(80, retardation=retardation, **settings)
        model, activation = replayed(task, np.array(gait), 0.0, device)
        generator = torch.Generator().manual_seed(1)
        change = torch.randn(activation.shape, generator=generator, dtype=activation.dtype).to(device)
        change[1:] = 0.0
        first, last = math.ceil(0.1 * len(gait)), len(gait)
        ends = {}
        for sign in (0.0, 1e-7):
            middle = run(task, model, (activation + sign * change)[:first])
            ends[sign] = (middle.x, run(task, model, (activation + sign * change)[first:last], middle).x)
        early, late = ((b - a).norm().item() for a, b in zip(ends[0.0], ends[1e-7], strict=True))
        row = {"gait": name, "η/μ ms": 1e3 * retardation, "safety": safety}
        table.add(row | {"width": width, "friction": friction, "growth": late / early})


PARTS = {
    "walk": (walks, "Displacement of a walk, float64"),
    "surface": (
        surface_walks,
        "Displacement of a walk on the moving grid with contact at surface points, float64",
    ),
    "gradient": (gradients, "Gradient of 1 s of walking against secants, float64"),
    "growth": (growth, "Growth of a small change of the activations from 0.1 s to 1 s, reference, float64"),
    "precision": (precision, "1000 substeps of walking, float32 against float64"),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    parser.add_argument("--gait", choices=GAITS, default=None, help="only this one")
    args = parser.parse_args()
    measure, title = PARTS[args.part]
    device = torch.device(args.device)
    gaits = GAITS if args.gait is None else {args.gait: GAITS[args.gait]}
    measure(Table(title, device, args.json), gaits, device)


if __name__ == "__main__":
    main()
