"""The alarm on bodies that pass through each other: `python bench/overlap.py {depth,cost,gait} [--device cpu] [--json FILE]`

**depth**: how deep two bodies overlap when the alarm is raised [cells], mean and largest of some random offsets across their way. One
flies into the other, which stands still; neither is deformed, so the depth is the way since they touched. ``turned`` bodies begin at
45 degrees, ``random`` ones have particles at random places. Float64, two particles per cell and axis.

**cost**: median time of a call with the alarm over that without it, in turn, of one check and of a substep. Calls end with a check, and
so does every chunk of 128 substeps (64 from 30,000 particles on). A cube at rest, float32; on a CPU the time of the process.

**gait**: the failure, if there is one, of the gaits of ``bench/gait.py`` and of elephants and arms whose muscles swing at random rates
and phases, at half and at full activation; 80 cells per metre.
"""

import argparse
import itertools
import json
import math
import statistics
import time
from pathlib import Path

import numpy as np
import torch
from common import Table, cube, sync

import softmpm
from softmpm_learn.tasks import ArmConf, BipedConf, ElephantConf, make_task

CELL, SIDE, SPEED, SAMPLES = 1 / 16, 5.0, 0.01, 12
"""Size of a cell [m], of the bodies [cells], way of a substep [cells], offsets."""
REPEATS = 25
"""Calls with and without the alarm, in turn."""


def body(shape: str, dim: int, generator: np.random.Generator) -> softmpm.Particles:
    """A body around the origin."""
    half = 0.5 * SIDE * CELL
    if shape == "ball":
        return softmpm.ball((0.0,) * dim, half, spacing=CELL / 2)
    block = softmpm.box((-half,) * dim, (half,) * dim, spacing=CELL / 2)
    if shape == "random":
        places = generator.uniform(-half, half, block.positions.shape)
        return softmpm.Particles(places, block.volume)
    return block


def overlap(shape: str, dim: int, seed: int, device: torch.device) -> float:
    """Way from the touch to the alarm [cells]."""
    generator = np.random.default_rng(seed)
    lateral = np.append(0.0, generator.uniform(-0.5, 0.5, dim - 1))
    if shape == "ball":  # the centres are SIDE apart when they touch
        touch = math.sqrt(SIDE**2 - lateral @ lateral)
    else:
        touch = 0.5 * SIDE * (1.0 + math.sqrt(2.0)) if shape == "turned" else SIDE
    apart = SIDE + 5.0
    middle = np.array([4.0 + SIDE / 2, *[6.0 + SIDE / 2] * (dim - 1)]) + generator.uniform(0.0, 1.0, dim)
    places = middle, middle + lateral + np.eye(dim)[0] * apart
    material = softmpm.NeoHookean(density=1.0, young=100.0, poisson=0.3)
    parts = [body(shape, dim, generator).moved(CELL * place) for place in places]
    made = softmpm.Scene(
        grid=softmpm.Grid(shape=(28, 18, 18)[:dim], spacing=CELL),
        bodies=[softmpm.Body(part, material) for part in parts],
        dt=1e-3,
    )
    alarms = softmpm.Alarms(step=None)
    model = softmpm.build(made, device=device, dtype=torch.float64, formulation="reference", alarms=alarms)
    state, first = model.rest(), model.body == 0
    if shape == "turned":
        turn, center = torch.eye(dim, dtype=torch.float64), torch.from_numpy(CELL * middle)
        turn[:2, :2] = math.sqrt(0.5) * torch.tensor([[1.0, -1.0], [1.0, 1.0]])
        state.x[0, first] = (center + (state.x[0, first].cpu() - center) @ turn.T).to(model.device)
        state.F[0, first] = turn.to(model.device)
    state.v[0, first, 0] = SPEED * CELL / made.dt
    try:
        softmpm.simulate(model, state, None, model.params(), substeps=int((apart + SIDE) / SPEED))
    except softmpm.UnstableError as error:
        return SPEED * (error.substep + 1) - (apart - touch) if error.kind == "overlap" else math.nan
    return math.nan


def depths(table: Table, device: torch.device) -> None:
    for dim, shape in itertools.product((2, 3), ("face", "ball", "turned", "random")):
        found = [overlap(shape, dim, seed, device) for seed in range(SAMPLES)]
        table.add(dict(shape=shape, dim=dim, mean=statistics.mean(found), least=min(found), most=max(found)))


@torch.no_grad()
def seconds(model: softmpm.Model, substeps: int) -> float:
    """Time of a call: that of the process on a CPU, where other processes then matter less."""
    clock = time.process_time if model.device.type == "cpu" else time.perf_counter
    start, params = model.rest(), model.params()
    sync(model.device)
    begin = clock()
    softmpm.simulate(model, start, None, params, substeps=substeps)
    sync(model.device)
    return clock() - begin


def costs(table: Table, device: torch.device) -> None:
    sizes = ((2, 3_000, 96), (3, 8_000, 32), (3, 64_000, 48), (3, 1_000_000, 96))
    for (dim, particles, nodes), substeps in itertools.product(sizes, (1, 20, 128)):
        if device.type == "cpu" and particles > 10_000:
            continue
        made = cube(dim, particles, nodes)
        models = [
            softmpm.build(made, device=device, formulation="reference", alarms=softmpm.Alarms(overlap=o))
            for o in (1.0, None)
        ]
        seconds(models[0], substeps), seconds(models[1], substeps)  # compiles
        on, off = zip(*([seconds(model, substeps) for model in models] for _ in range(REPEATS)), strict=True)
        chunks = math.ceil(substeps / models[0].sizes().longest)
        more = statistics.median(a - b for a, b in zip(on, off, strict=True)) / chunks
        one = statistics.median(off) / substeps
        row = dict(dim=dim, particles=particles, substeps=substeps)
        row["with / without"] = statistics.median(a / b for a, b in zip(on, off, strict=True))
        table.add(row | {"check us": 1e6 * more, "substep us": 1e6 * one})


def gaits(table: Table, device: torch.device) -> None:
    learned = json.loads(Path(__file__).with_name("gaits.json").read_text())
    cases = [(BipedConf, name, np.array(rows)) for name, rows in learned.items()]
    swings = itertools.product((ElephantConf, ArmConf), (0.5, 1.0), range(3))
    cases += [(kind, f"swing {seed} at {part:g}", (seed, part)) for kind, part, seed in swings]
    for kind, name, gait in cases:
        task = make_task(kind(formulation="reference", retardation=4e-3, contact_width=0.0, safety=0.4))
        if isinstance(gait, tuple):
            random, count = np.random.default_rng(gait[0]), len(task.scene.muscles)
            phase, rate = random.uniform(0, 2 * math.pi, count), random.uniform(2.0, 4.0, count)
            times = np.arange(task.control_steps)[:, None] * task.control_period
            gait = gait[1] * np.sin(2 * math.pi * rate * times + phase)
        settings = dict(task.build, alarms=softmpm.Alarms(step=None))
        model = softmpm.build(task.scene, device=device, dtype=torch.float64, **settings)
        activation, found = torch.tensor(gait, dtype=torch.float64, device=device)[:, None], "none"
        try:
            softmpm.simulate(model, model.rest(), activation, model.params(), substeps=task.substeps)
        except softmpm.UnstableError as error:
            found = f"{error.kind} at {error.substep * task.scene.dt:.3g} s"
        table.add(dict(robot=task.name, gait=name, alarm=found, particles=model.particle_count))


PARTS = {
    "depth": (depths, "Overlap at the alarm [cells], float64"),
    "cost": (costs, "Cost of the alarm on overlaps, float32"),
    "gait": (gaits, "Alarms of gaits in the reference formulation, float64"),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    args = parser.parse_args()
    measure, title = PARTS[args.part]
    device = torch.device(args.device)
    measure(Table(title, device, args.json), device)


if __name__ == "__main__":
    main()
