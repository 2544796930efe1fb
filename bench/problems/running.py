"""How the problems are run: scenes at a part of their stable step, means over windows, and the cost."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
import torch

import softmpm

Measure = Callable[[softmpm.State], float]


def scene_of(
    h: float,
    shape: softmpm.Particles,
    material: softmpm.NeoHookean,
    *,
    step: float,
    walls: list[softmpm.Wall] = [],  # noqa: B006
    **settings,
) -> softmpm.Scene:
    """The scene of one body on a grid that ends two cells beyond it, at this part of the stable step."""
    upper = shape.positions.max(axis=0)
    nodes = tuple(int(n) for n in np.ceil(upper / h) + 3)
    grid, bodies = softmpm.Grid(shape=nodes, spacing=h), [softmpm.Body(shape, material)]
    scene = softmpm.Scene(grid=grid, bodies=bodies, walls=walls, dt=1.0, **settings)
    return dataclasses.replace(scene, dt=step * softmpm.stable_dt(scene))


class Simulation:
    """A model in float64 on a CPU, its state, and the cost so far. The formulation is the first word of its kind.

    Attributes:
        cost: Particle-substeps, in millions.
        seconds: Wall time of the calls.
    """

    def __init__(self, scene: softmpm.Scene, kind: str, **settings):
        formulation = kind.split(",")[0]
        settings = dict(device="cpu", dtype=torch.float64, alarms=softmpm.Alarms(step=None)) | settings
        self.model = softmpm.build(scene, formulation=formulation, **settings)
        self.state = self.model.rest()
        self.cost = self.seconds = 0.0

    def run(self, substeps: int, inputs: softmpm.Inputs | None = None) -> softmpm.State:
        start, model = time.perf_counter(), self.model
        given = {} if inputs is None else {"inputs": inputs}
        self.state = softmpm.simulate(model, self.state, None, model.params(), substeps=substeps, **given)
        self.cost += substeps * model.particle_count / 1e6
        self.seconds += time.perf_counter() - start
        return self.state

    def settled(
        self, duration: float, measure: Measure, inputs: softmpm.Inputs | None = None
    ) -> tuple[float, float]:
        """Mean of a measure over the last fifth of a run [s], and how far it is from that of the fifth before."""
        substeps, values = round(duration / 20 / self.model.scene.dt), []
        for _ in range(20):
            values.append(measure(self.run(substeps, inputs)))
        last = float(np.mean(values[-4:]))
        return last, last - float(np.mean(values[-8:-4]))

    def frequency(self, mode: np.ndarray, amplitude: float, expected: float, periods: float = 4.0) -> float:
        """Angular frequency [rad/s] of a free vibration that begins with the velocity amplitude · mode, by Prony's method.

        With q the projection of the velocity on the mode, q(t+τ) + q(t−τ) = 2 cos(ω τ) q(t), fitted by least squares.
        """
        model, shape = self.model, torch.from_numpy(mode)
        self.state = self.state._replace(v=amplitude * shape[None], nodes=None)
        weights = model.mass[:, None] * shape
        every = max(1, round(2 * np.pi / expected / 40 / model.scene.dt))
        q = []
        for _ in range(int(periods * 2 * np.pi / expected / every / model.scene.dt)):
            q.append((weights * self.run(every).v[0]).sum().item())
        q = np.array(q)
        cosine = np.dot(q[1:-1], q[2:] + q[:-2]) / (2 * np.dot(q[1:-1], q[1:-1]))
        return float(np.arccos(cosine) / (every * model.scene.dt))


def result(one: Simulation, found: tuple[float, float], want: float) -> dict:
    """Part of a row of the table: the error of a value and its drift."""
    value, drift = found
    return {
        "cost M": one.cost,
        "s": one.seconds,
        "error %": 100 * float(value / want - 1),
        "drift %": 100 * float(drift / want),
    }
