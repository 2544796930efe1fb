"""Scenes and timing that the benchmarks share."""

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

import softmpm
from softmpm_learn.tasks import TaskConf

Conf = TypeVar("Conf", bound=TaskConf)


def cube(
    dim: int,
    particles: int,
    nodes: int,
    *,
    law=softmpm.NeoHookean,
    muscles=False,
    pressure=False,
    floor=False,
    clamp=False,
    seed=0,
    domain=None,
    on_knots=False,
    **scene_settings,
) -> softmpm.Scene:
    """An elastic cube with 2^dim particles per cell in the middle of the grid, particles in random order.

    Args:
        nodes: Nodes along an axis of a grid one metre wide; they decide the spacing.
        muscles, pressure: Add an actuator of this kind that acts on all particles.
        floor: Add a wall with friction at the lowest particles.
        clamp: Drive the lowest particles, which stand still unless a call gives their velocity.
        domain: Nodes along an axis of a larger grid, most of it empty.
        on_knots: Shift the cube by half a cell, so that its faces lie on knots of the splines and its cells are full.
    """
    dx = 1.0 / nodes
    side = round(particles ** (1 / dim))
    axis = (np.arange(side) - (side - 1) / 2) * dx / 2 + 0.5 * ((domain or nodes) + on_knots) * dx
    positions = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim)
    positions = np.random.default_rng(seed).permutation(positions)
    body = softmpm.Body(
        softmpm.Particles(positions, (dx / 2) ** dim), law(density=1.0, young=100.0, poisson=0.3)
    )
    up = (0.0, 1.0) + (0.0,) * (dim - 2)
    index, lowest = np.arange(len(positions)), float(positions[:, 1].min())
    actuators = [softmpm.Muscle(particles=index, direction=up, strength=1.0)] if muscles else []
    actuators += [softmpm.Pressure(particles=index, strength=1.0)] if pressure else []
    scene = dict(
        grid=softmpm.Grid(shape=(domain or nodes,) * dim, spacing=dx),
        bodies=[body],
        muscles=actuators,
        walls=[softmpm.Wall(normal=up, offset=lowest, friction=0.5)] if floor else [],
        driven=np.flatnonzero(positions[:, 1] == lowest) if clamp else (),
        gravity=tuple(-0.5 * u for u in up),  # so weak that a thousand substeps stay on the grid
    )
    scene |= scene_settings
    return softmpm.Scene(**scene, dt=0.3 * softmpm.stable_dt(softmpm.Scene(**scene, dt=1.0)))


def on_grid(kind: type[Conf], cells: int) -> type[Conf]:
    """Settings of a task on a grid of so many cells per metre, which none of its resolutions need have."""
    return type(kind.__name__, (kind,), {"cells_per_metre": cells})


def turning(model: softmpm.Model, rate: float = 2.0) -> softmpm.State:
    """The scene at rest but turning [rad/s], so that particles change cells and their order becomes stale."""
    start = model.rest()
    arm = start.x - start.x.mean(dim=1, keepdim=True)
    start.v[..., 0], start.v[..., 1] = -rate * arm[..., 1], rate * arm[..., 0]
    return start


def sync(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def median_seconds(work, device: torch.device, repeats: int) -> float:
    """Median time of ``work`` after one warm-up run, which also compiles."""
    work()
    seconds = []
    for _ in range(repeats):
        sync(device)
        begin = time.perf_counter()
        work()
        sync(device)
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds)


def arguments(
    description: str, scenes: Iterable[str] = (), formulations: bool = False, threads: bool = False
) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--largest", type=int, default=None, help="skip cases with more particles")
    if scenes:
        parser.add_argument("--scheme", default="auto", choices=["auto", "fast", "plain"])
        parser.add_argument("--scenes", nargs="+", default=scenes, choices=scenes, help="skip the others")
    if formulations:
        parser.add_argument("--formulation", default="moving", choices=["moving", "reference"])
    if threads:
        help = "numbers of threads on a CPU"
        parser.add_argument("--threads", type=int, nargs="+", default=[torch.get_num_threads()], help=help)
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    return parser.parse_args()


def train(words: list[str], processes: int, folder: str) -> None:
    """``python -m softmpm_learn`` with these words in so many processes, into this folder; ends the program if it fails."""
    torchrun = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    program = ["-m", "softmpm_learn", *words, f"hydra.run.dir={folder}"]
    done = subprocess.run([sys.executable, *torchrun, *program], capture_output=True, text=True)
    if done.returncode:
        last = (done.stdout + done.stderr).splitlines()[-60:]  # torchrun adds some forty of its own
        sys.exit("\n".join([*last, f"The run in {processes} process(es) failed."]))


def machine(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device).removeprefix("NVIDIA ")
    return f"CPU, {torch.get_num_threads()} PyTorch thread(s), {platform.machine()}"


class Table:
    """Results of a benchmark. Each row is printed, and written to the JSON file if one was given, as soon as it is measured."""

    def __init__(self, title: str, device: torch.device, path: Path | None):
        self.title, self.machine, self.path, self.rows = title, machine(device), path, []

    def add(self, row: dict) -> None:
        if not self.rows:
            print(f"{self.title} ({self.machine})")
            print(self._line({name: name for name in row}, row))
        self.rows.append(row)
        print(self._line(row, self.rows[0]), flush=True)
        if self.path:
            content = {"title": self.title, "machine": self.machine, "rows": self.rows}
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.write_text(json.dumps(content, indent=1) + "\n")

    @staticmethod
    def _line(row: dict, like: dict) -> str:
        texts = {
            name: f"{value:.4g}" if isinstance(value, float) else str(value) for name, value in row.items()
        }
        words = (
            text.ljust(25) if isinstance(like[n], str) else text.rjust(max(9, len(n)))
            for n, text in texts.items()
        )
        return "  ".join(words)
