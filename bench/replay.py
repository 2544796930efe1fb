"""Truth of a learned gait: `python bench/replay.py FOLDER … [--device cpu] [--json FILE]`; FOLDER is that of a run of a walker

The activations of the best episode are replayed on other grids, with nodes or the surface on the floor, and in the formulations that
are named, where limbs may pass through each other in the reference formulation: displacement of the centre of mass at the end [mm],
mean and standard deviation over four positions of the grid, each a quarter of a cell further, but for those that ``stopped``. All
rows of a run have the same material; a designed one is that of the nearest particle.

``later`` is the displacement from T to 3T over twice that until T, T the length of the episode: the policy goes on, in closed loop. A
leap has 0, a walk that is under way from the start 1. ``stretch`` is the largest of a particle, ``dt / limit`` the ratio of dt and
the stable step of such a particle if it were alone on the grid and its muscles fully active.
"""

import argparse
import dataclasses
import itertools
import math
import tempfile
from pathlib import Path

import numpy as np
import torch
from common import Table
from gait import SHIFTS
from scipy.spatial import cKDTree

import softmpm
from softmpm_learn.command.experiment import make_model
from softmpm_learn.config import RunConf
from softmpm_learn.design import declared_inputs
from softmpm_learn.distributed import Group
from softmpm_learn.episode import run_episode
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.saved import load
from softmpm_learn.storage import checkpoint
from softmpm_learn.tasks import Resolution, Task, make_task
from softmpm_learn.tasks.task import FORMULATIONS

LONGER = 3
"""Length of the continued walk over that of an episode."""


def learned(folder: Path, device: torch.device, out: Path) -> tuple[RunConf, Run]:
    """Settings of a run, and the run with its best policy and design; ``out`` is an empty folder."""
    conf = load(folder)
    conf.device.name = device.type
    task = make_task(conf.task)
    run = Run(task, make_model(task, conf, Group()), conf.settings, out)
    run.load_policy(checkpoint.load(folder)["best"])
    return conf, run


@torch.no_grad()
def played(run: Run, task: Task, model: softmpm.Model) -> tuple[torch.Tensor, list[float]]:
    """Activations of the policy, (step, world, muscle), and displacement at the beginning of each step and at the end [m]."""
    frames, (params, inputs) = [], run.design()
    run_episode(task, model, run.observer, run.policy, params, inputs=inputs, on_frame=frames.append)
    way = [travelled(model, params, frame.state) for frame in frames]
    return torch.stack([frame.activation for frame in frames[:-1]]), way


def lasting(run: Run) -> float:
    """Speed from T to ``LONGER`` T over that until T, NaN where the simulation stopped."""
    steps = run.task.control_steps
    task = dataclasses.replace(run.task, control_steps=LONGER * steps)
    try:
        _, way = played(run, task, built(task, run))
    except softmpm.UnstableError as error:
        print(f"{task.name}, {LONGER} times as long: {error}")
        return math.nan
    return (way[-1] - way[steps]) / ((LONGER - 1) * way[steps])


def travelled(model: softmpm.Model, params: softmpm.Params, state: softmpm.State) -> float:
    mass = params.density * model.volume
    return (mass @ (state.x[0, :, 0] - model.positions[:, 0]) / mass.sum()).item()


def built(task: Task, run: Run, shift: float = 0.0) -> softmpm.Model:
    (body,), spacing = task.scene.bodies, task.scene.grid.spacing
    moved = dataclasses.replace(body, particles=body.particles.moved((shift * spacing, 0.0)))
    scene = dataclasses.replace(task.scene, bodies=[moved])
    settings = task.build | {"alarms": dataclasses.replace(task.build["alarms"], step=None)}
    settings |= {"inputs": declared_inputs(run.settings.design)}
    return softmpm.build(scene, device=run.model.device, dtype=run.model.dtype, **settings)


def transferred(run: Run, task: Task) -> tuple[softmpm.Params, softmpm.Inputs]:
    """The design of a run on the particles of a task of the same robot: values of the nearest particle."""
    old, new = (
        scene.bodies[0].particles.moved((0.0, -scene.bodies[0].particles.outline.points[:, 1].min()))
        for scene in (run.task.scene, task.scene)
    )
    nearest = torch.as_tensor(cKDTree(old.positions).query(new.positions)[1], device=run.model.device)
    params, inputs = run.design()
    muscles = {name: value for name, value in inputs._asdict().items() if name == "strength"}
    others = {
        name: None if value is None or name in muscles else value[nearest]
        for name, value in inputs._asdict().items()
    }
    return softmpm.Params(*(value[nearest] for value in params)), softmpm.Inputs(**others | muscles)


@torch.no_grad()
def replayed(run: Run, task: Task, activation: torch.Tensor) -> tuple[np.ndarray, float, float]:
    """Displacement at each position of the grid [m], NaN where a simulation stopped; and of all control steps the largest stretch [-]
    with dt over the stable step of a particle that is alone on the grid and as deformed [-]."""
    params, inputs = transferred(run, task)
    found, worst, F = np.full(len(SHIFTS), math.nan), 0.0, None
    for k, shift in enumerate(SHIFTS):
        model = built(task, run, shift)
        state = model.rest()
        try:
            for row in activation:
                state = softmpm.simulate(
                    model, state, row[None], params, substeps=task.substeps, inputs=inputs
                )
                stretches = torch.linalg.svdvals(state.F[0].double())[:, 0]
                if stretches.max() > worst:
                    worst, most = stretches.max().item(), stretches.argmax()
                    F = state.F[0, most].double().cpu()
            found[k] = travelled(model, params, state)
        except softmpm.UnstableError as error:
            print(f"{task.name}, shift {shift}: {error}")
    return found, worst, task.scene.dt / softmpm.stable_dt(task.scene, stretch=F)


def replays(
    table: Table,
    folder: Path,
    device: torch.device,
    out: Path,
    finest: Resolution,
    safeties: list[float],
    formulations: list[str],
) -> None:
    conf, run = learned(folder, device, out)
    activation, way = played(run, run.task, built(run.task, run))
    later, own, coarsest = lasting(run), conf.task, conf.task.resolution
    cases: list[dict] = [{"safety": safety} for safety in safeties]
    contacts = [own.contact] if own.on_surface else ["nodes", "surface"]
    finer = [r for r in Resolution if coarsest.value <= r.value <= finest.value]
    for formulation, contact, resolution in itertools.product(
        formulations or [own.formulation], contacts, finer
    ):
        width = own.contact_width if contact == own.contact else None
        case = {"contact": contact, "contact_width": width, "resolution": resolution}
        cases.append(
            case | {"formulation": formulation, "overlap": formulation == "reference" or own.overlap}
        )
    for case in cases:
        changed = dataclasses.replace(own, **case)
        found, stretch, ratio = replayed(run, make_task(changed), activation)
        row = {"run": folder.name, "η/μ ms": 1e3 * own.retardation, "contact": changed.build["contact"]}
        row |= {
            "formulation": changed.formulation,
            "cells/m": changed.resolution.value,
            "safety": changed.safety,
        }
        going = 1e3 * found[~np.isnan(found)]
        row |= {"learned mm": 1e3 * way[-1], "stopped": len(found) - len(going)}
        several = len(going) > 1
        row |= {
            "replayed mm": going.mean() if several else None,
            "std": going.std(ddof=1) if several else None,
        }
        table.add(row | {"later": later, "stretch": stretch, "dt / limit": ratio})


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--finest", choices=[r.name for r in Resolution], default="standard")
    parser.add_argument("--safety", type=float, nargs="*", default=[], help="also with these values of it")
    parser.add_argument(
        "--formulations", choices=FORMULATIONS, nargs="*", default=[], help="default: that of the run"
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    args = parser.parse_args()
    device = torch.device(args.device)
    table = Table("Best episode of a run on other grids", device, args.json)
    for folder in args.folders:
        with tempfile.TemporaryDirectory() as out:
            replays(table, folder, device, Path(out), Resolution[args.finest], args.safety, args.formulations)


if __name__ == "__main__":
    main()
