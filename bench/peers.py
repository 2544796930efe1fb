"""Speed beside other simulators: `python bench/peers.py [--device cuda] [--largest 64000] [--json bench/results/peers.json]`

One elastic cube, one run, float32, all contenders one after the other, medians after a warm-up, microseconds per substep:

    softmpm           `simulate` with default settings: checks on, the default memory budget of a sixteenth of the GPU's memory
    softmpm, all      the same with a memory budget for all states, which the peers store as well
    Warp, generated   bench/naive_warp.py: three kernels, Warp's generated adjoint, one CUDA graph forward, one backward
    Taichi            bench/taichi_mpm.py: the DiffTaichi scheme, in a process of its own

`forward` is a run without gradient, `kept` one that stores the states for the backward pass, `backward` the backward pass with its
recomputation. `forward x`, `backward x` and `gradient x` are the ratios of the contender's time to that of softmpm, the last one for
`kept` and `backward` together. The times of softmpm include its checks and all Python overhead; a CUDA graph has neither.

All contenders must compute the same motion: after 30 substeps, `apart` is the largest difference of a coordinate from that of softmpm
in dx, and `gradient apart` the relative difference of the gradient of a random projection of x with respect to the initial v. If a
tolerance below is exceeded, the run ends with an error.

Taichi is imported in this Python, or in the one that the environment variable TAICHI_PYTHON names; without it the row is empty.
"""

import dataclasses
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from common import Table, arguments, cube, median_seconds, sync
from naive_warp import NaiveWarp

import softmpm

CASES = [(2, 6_400, 128), (3, 8_000, 32), (3, 64_000, 48), (3, 1_000_000, 96)]
ORDERS = ("random", "lattice")
CHECKED = 30
"""Substeps after which results are compared."""
TAICHI_SECONDS = 400
"""Time limit for Taichi, of which compilation takes about a minute."""
WARM = 4
"""Warm-up runs."""
APART, GRADIENT_APART = 1e-4, 1e-3
"""Tolerances. The peers round x to float32 in every substep, 3e-8 m or 4e-6 dx on the finest grid; softmpm stores the remainder."""


class Ours:
    """softmpm through its public API, with the interface of :class:`NaiveWarp`."""

    def __init__(self, scene: softmpm.Scene, case: dict, substeps: int, device: torch.device, budget=None):
        self.model = softmpm.build(scene, device=device, memory_budget=budget)
        self.params, self.substeps = self.model.params(), substeps
        rest = self.model.rest()
        x, v, self.seed = (torch.tensor(case[name], device=device)[None] for name in ("x", "v", "seed"))
        self.start = softmpm.State(x.requires_grad_(), v.requires_grad_(), rest.C, rest.F)

    def keep(self):
        self.last = softmpm.simulate(self.model, self.start, None, self.params, substeps=self.substeps)

    def forward(self):
        with torch.no_grad():
            self.keep()

    def backward(self):
        self.start.x.grad = self.start.v.grad = None
        self.last.x.backward(self.seed)

    def end(self) -> np.ndarray:
        return self.last.x[0].detach().cpu().numpy()

    def adj_v(self) -> np.ndarray:
        return self.start.v.grad[0].cpu().numpy()


def ordered(scene: softmpm.Scene, order: str) -> softmpm.Scene:
    """The scene with its particles sorted row by row, or in the given random order."""
    if order == "random":
        return scene
    body = scene.bodies[0]
    positions = body.particles.positions
    rows = positions[np.lexsort(positions.T[::-1])]
    particles = softmpm.Particles(rows, body.particles.volume[0])
    return dataclasses.replace(scene, bodies=[dataclasses.replace(body, particles=particles)])


def case_of(scene: softmpm.Scene) -> dict[str, np.ndarray]:
    """The scene in plain numbers, moving: a swirl that stretches and shears, and a random projection of the end."""
    grid, body = scene.grid, scene.bodies[0]
    material, volume, x = body.material, body.particles.volume[0], body.particles.positions
    mu = material.young / (2 * (1 + material.poisson))
    lam = material.young * material.poisson / ((1 + material.poisson) * (1 - 2 * material.poisson))
    v = 0.5 * (np.sin(2 * np.pi * np.roll(x, 1, axis=1)) + np.cos(2 * np.pi * x))
    # The projection follows the particle, not its place in the array.
    seed = np.random.default_rng(1).standard_normal(x.shape)[np.argsort(np.lexsort(x.T[::-1]))]
    fields = {"x": x, "v": v, "seed": seed, "gravity": scene.gravity}
    numbers = {"dx": grid.spacing, "dt": scene.dt, "volume": volume, "mass": material.density * volume}
    return (
        {name: np.asarray(value, dtype=np.float32) for name, value in fields.items()}
        | {name: np.float64(value) for name, value in (numbers | {"mu": mu, "lam": lam}).items()}
        | {"dim": np.int64(grid.dim), "nodes": np.int64(grid.shape[0])}
    )


def keep(contender):
    """Run and store the states for the backward pass; the peers always do."""
    getattr(contender, "keep", contender.forward)()


def times(contender, device: torch.device, repeats: int) -> dict[str, float]:
    """Seconds of a run without gradient, of one that stores states, and of its backward pass, after windows and graphs are in place."""
    kept, backward = [], []
    for _ in range(repeats + WARM):
        sync(device)
        begin = time.perf_counter()
        keep(contender)
        sync(device)
        middle = time.perf_counter()
        contender.backward()
        sync(device)
        kept.append(middle - begin)
        backward.append(time.perf_counter() - middle)
    return {
        "forward": median_seconds(contender.forward, device, repeats),
        "kept": statistics.median(kept[WARM:]),
        "backward": statistics.median(backward[WARM:]),
    }


def result(make, substeps: int, device: torch.device, repeats: int) -> dict:
    """Final positions and gradient of the contender in the compared run, and its times."""
    checked = make(CHECKED)
    keep(checked)
    checked.backward()
    found = {"end": checked.end(), "adj_v": checked.adj_v()}
    del checked
    return found | times(make(substeps), device, repeats)


class Cube(NamedTuple):
    """One cube with its particles in each order."""

    dim: int
    nodes: int
    substeps: int
    scenes: list[softmpm.Scene]
    cases: list[dict[str, np.ndarray]]


def cube_in_orders(dim: int, particles: int, nodes: int, device: torch.device) -> Cube:
    most = 20 if device.type == "cpu" else 1000
    # The peers store all states, some gigabytes of them; and in 3D the swirl takes a particle off the grid after 745 substeps.
    substeps = 1000 if dim == 2 else 256 if particles < 10_000 else 200 if particles < 100_000 else 32
    scenes = [ordered(cube(dim, particles, nodes), order) for order in ORDERS]
    return Cube(dim, nodes, min(most, substeps), scenes, [case_of(scene) for scene in scenes])


def taichi(cubes: list[Cube], device: torch.device, repeats: int) -> list[list[dict] | None]:
    """Results of Taichi for each cube and order; None, with a printed reason, if there is no result."""
    python = os.environ.get("TAICHI_PYTHON", sys.executable)
    program = Path(__file__).with_name("taichi_mpm.py")
    with tempfile.TemporaryDirectory() as folder:
        for k, one in enumerate(cubes):
            orders = {name: np.stack([case[name] for case in one.cases]) for name in ("x", "v", "seed")}
            counts = {"substeps": one.substeps, "check": CHECKED, "repeats": repeats}
            np.savez(Path(folder) / f"{k}.case.npz", **(one.cases[0] | orders | counts))
        reason = run([python, str(program), folder, "--device", device.type])
        if reason:
            print(f"Taichi did not finish, {reason}", flush=True)
        return [read_taichi(Path(folder) / f"{k}.result.npz", device) for k in range(len(cubes))]


def run(command: list[str]) -> str | None:
    """Run a command; the reason if it fails, else None."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TAICHI_SECONDS)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode == 0:
        return None
    return f"exit {done.returncode}: {' | '.join((done.stdout + done.stderr).strip().splitlines()[-3:])}"


def read_taichi(path: Path, device: torch.device) -> list[dict] | None:
    if not path.exists():
        print(f"Taichi skipped: no result for cube {path.name.split('.')[0]}", flush=True)
        return None
    found = dict(np.load(path))
    if str(found["arch"]).endswith("cuda") != (device.type == "cuda"):
        print(f"Taichi skipped: it ran on {found['arch']}", flush=True)
        return None
    results = []
    for k in range(len(ORDERS)):
        one = {name: found[f"{name}{k}"] for name in ("end", "adj_v", "forward", "backward")}
        results.append(one | {"kept": one["forward"]})
    return results


def row(name: str, found: dict | None, ours: dict, substeps: int, dx: float) -> dict:
    """A line of the table; dashes if the contender did not run."""
    if found is None:
        times = ("forward", "kept", "backward", "forward x", "backward x", "gradient x")
        return {"contender": name} | dict.fromkeys((*times, "apart [dx]", "gradient apart"), "-")
    off = found["adj_v"].astype(np.float64) - ours["adj_v"]
    both = [r["kept"] + r["backward"] for r in (found, ours)]
    return {
        "contender": name,
        **{part: float(found[part]) / substeps * 1e6 for part in ("forward", "kept", "backward")},
        "forward x": float(found["forward"] / ours["forward"]),
        "backward x": float(found["backward"] / ours["backward"]),
        "gradient x": float(both[0] / both[1]),
        "apart [dx]": float(np.abs(found["end"].astype(np.float64) - ours["end"]).max() / dx),
        "gradient apart": float(np.linalg.norm(off) / np.linalg.norm(ours["adj_v"])),
    }


def contest(one: Cube, others: list[dict] | None, device: torch.device, repeats: int, table: Table) -> None:
    """All contenders on one cube, with its particles in both orders; the results of Taichi are an argument."""
    others = others or [None] * len(ORDERS)
    for order, scene, case, other in zip(ORDERS, one.scenes, one.cases, others, strict=True):

        def ours(count, budget=None, scene=scene, case=case):
            return Ours(scene, case, count, device, budget)

        makes = {
            "softmpm": ours,
            "softmpm, all": lambda count, ours=ours: ours(count, budget=2**40),
            "Warp, generated": lambda count, case=case: NaiveWarp(case, count, str(device)),
        }
        found = {name: result(make, one.substeps, device, repeats) for name, make in makes.items()}
        label = {"dim": one.dim, "particles": len(case["x"]), "nodes": one.nodes, "order": order}
        for name, theirs in (found | {"Taichi": other}).items():
            table.add(label | row(name, theirs, found["softmpm"], one.substeps, scene.grid.spacing))
        if device.type == "cuda":
            torch.cuda.empty_cache()


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("softmpm and peers, us/substep, float32", device, args.json)
    most = args.largest or (8_000 if device.type == "cpu" else max(case[1] for case in CASES))
    cubes = [cube_in_orders(*case, device) for case in CASES if case[1] <= most]
    for one, others in zip(cubes, taichi(cubes, device, args.repeats), strict=True):
        contest(one, others, device, args.repeats, table)
    ran = [r for r in table.rows if r["apart [dx]"] != "-"]
    wrong = [r for r in ran if not (r["apart [dx]"] < APART and r["gradient apart"] < GRADIENT_APART)]
    if wrong:
        sys.exit(f"{len(wrong)} results differ by more than {APART} dx or {GRADIENT_APART} of the gradient.")


if __name__ == "__main__":
    main()
