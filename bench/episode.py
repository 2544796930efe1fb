"""Time of a closed-loop learning iteration, and the share of physics in it.

    python bench/episode.py [--device cuda] [--json bench/results/episode.json]

A robot observes, acts and moves; the loss is differentiated with respect to policy and materials. ``iteration`` is the time of one
such iteration as in training; ``physics`` that of its calls of `simulate`, forward and backward, captured as a CUDA graph as well;
``eager`` that of the iteration without the graph. Medians after a warm-up. The rows with a viscous material compare contact at nodes
and at surface points, and both formulations.
"""

import tempfile
from pathlib import Path

import torch
from common import Table, arguments, median_seconds, on_grid

import softmpm
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.settings import Settings
from softmpm_learn.tasks.biped import BipedConf, biped
from softmpm_learn.tasks.elephant import ElephantConf, elephant
from softmpm_learn.tasks.task import Task

ROBOTS = {"biped": (BipedConf, biped), "elephant": (ElephantConf, elephant)}
ELASTIC = dict(retardation=0.0, contact="nodes", contact_width=0.0)
VISCOUS = dict(retardation=4e-3)
NODES, SURFACE = dict(contact="nodes", contact_width=0.0), dict(contact="surface", contact_width=0.01)
CASES = [
    ("biped", 128, 0.0125, 2000, ELASTIC),
    ("biped", 264, 0.0125, 2000, ELASTIC),
    ("biped", 264, 0.004, 2000, ELASTIC),
    ("biped", 128, 0.0125, 2000, VISCOUS | NODES),
    ("biped", 128, 0.0125, 2000, VISCOUS | SURFACE),
    ("biped", 128, 0.0125, 2000, VISCOUS | SURFACE | dict(formulation="reference")),
    ("elephant", 128, 0.0125, 2000, VISCOUS | NODES),
    ("elephant", 128, 0.0125, 2000, VISCOUS | SURFACE),
    ("elephant", 128, 0.0125, 2000, VISCOUS | SURFACE | dict(formulation="reference")),
]
"""Robot, cells per metre, seconds between two decisions, substeps of an episode, settings."""
ON_A_CPU = [("biped", 80, 0.0125, 100, settings) for *_, settings in CASES[3:6]]


def task_of(robot: str, cells: int, period: float, substeps: int, settings: dict) -> Task:
    kind, make = ROBOTS[robot]
    make_conf, settings = on_grid(kind, cells), settings | dict(control_period=period)
    steps = round(substeps / make(make_conf(seconds=period, **settings)).substeps)
    return make(make_conf(seconds=steps * period, **settings))


def physics(run: Run):
    """The simulations of an episode and their gradient, without anything around them."""
    model, task = run.model, run.task
    activation = torch.zeros(
        task.control_steps, 1, model.worlds, model.muscle_count, device=model.device
    ).requires_grad_()
    params, inputs = run.design()
    params = softmpm.Params(*(p.detach().clone().requires_grad_() for p in params))

    def work():
        state = model.rest()
        for row in activation:
            state = softmpm.simulate(model, state, row, params, substeps=task.substeps, inputs=inputs)
        return torch.autograd.grad(state.x.sum(), [activation, *params])

    return softmpm.Graph(work, model.device)


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("An iteration of learning in closed loop, float32", device, args.json)
    for case in CASES if device.type == "cuda" else ON_A_CPU:
        task = task_of(*case)
        model = softmpm.build(task.scene, device=device, calls=task.control_steps, **task.build)
        with tempfile.TemporaryDirectory() as folder:
            run = Run(task, model, Settings(), Path(folder))
            loop = Runs([run]).loop
            whole = median_seconds(lambda loop=loop: loop(None), device, args.repeats + 1)
            alone = median_seconds(physics(run), device, args.repeats + 1)
            eager = median_seconds(loop._work, device, 2)
        table.add(
            {
                "robot": task.name,
                "formulation": model.formulation,
                "contact": "nodes" if model.surface is None else "surface",
                "viscous": model.spec.viscosity,
                "particles": model.particle_count,
                "control steps": task.control_steps,
                "substeps": task.control_steps * task.substeps,
                "iteration ms": 1e3 * whole,
                "physics ms": 1e3 * alone,
                "physics share": alone / whole,
                "eager ms": 1e3 * eager,
            }
        )


if __name__ == "__main__":
    main()
