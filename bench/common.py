"""Scenes and timing that the benchmarks share."""

import argparse
import json
import platform
import statistics
import time
from pathlib import Path

import numpy as np
import torch

import softmpm


def cube(
    dim: int,
    particles: int,
    nodes: int,
    *,
    law=softmpm.NeoHookean,
    muscles=False,
    floor=False,
    seed=0,
    domain=None,
    **scene_settings,
) -> softmpm.Scene:
    """An elastic cube with 2^dim particles per cell in the middle of the grid, particles in random order.

    Args:
        nodes: Nodes along an axis of a grid one metre wide; they decide the spacing.
        domain: Nodes along an axis of a larger grid, most of it empty.
    """
    dx = 1.0 / nodes
    side = round(particles ** (1 / dim))
    axis = (np.arange(side) - (side - 1) / 2) * dx / 2 + 0.5 * (domain or nodes) * dx
    positions = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim)
    np.random.default_rng(seed).shuffle(positions)
    body = softmpm.Body(
        softmpm.Particles(positions, (dx / 2) ** dim), law(density=1.0, young=100.0, poisson=0.3)
    )
    up = (0.0, 1.0) + (0.0,) * (dim - 2)
    index = np.arange(len(positions))
    scene = dict(
        grid=softmpm.Grid(shape=(domain or nodes,) * dim, spacing=dx),
        bodies=[body],
        muscles=[softmpm.Muscle(particles=index, direction=up, strength=1.0)] if muscles else [],
        walls=[softmpm.Wall(normal=up, offset=float(positions[:, 1].min()), friction=0.5)] if floor else [],
        gravity=tuple(-0.5 * u for u in up),  # so weak that a thousand substeps stay on the grid
    )
    scene |= scene_settings
    return softmpm.Scene(**scene, dt=0.3 * softmpm.stable_dt(softmpm.Scene(**scene, dt=1.0)))


def turning(model: softmpm.Model, rate: float = 2.0) -> softmpm.State:
    """The scene at rest but turning [rad/s], so that particles change their cells and the order they are kept in grows stale."""
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


def arguments(description: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--largest", type=int, default=None, help="skip cases with more particles")
    parser.add_argument("--json", type=Path, default=None, help="write the table there as well")
    return parser.parse_args()


def machine(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device).removeprefix("NVIDIA ")
    return f"CPU, {torch.get_num_threads()} PyTorch thread(s), {platform.machine()}"


def report(title: str, rows: list[dict], device: torch.device, path: Path | None) -> None:
    """Print a table; write it as JSON if asked."""
    print(f"{title} ({machine(device)})")
    names = list(rows[0])
    cells = [[f"{row[n]:.4g}" if isinstance(row[n], float) else str(row[n]) for n in names] for row in rows]
    widths = [max(len(c) for c in column) for column in zip(names, *cells, strict=True)]
    for line in (names, *cells):
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            json.dumps({"title": title, "machine": machine(device), "rows": rows}, indent=1) + "\n"
        )
