"""Settings of the learner side by side: every variant with several seeds, each walker a world of one simulation.

    python bench/variants.py --robot elephant --seeds 6 --iterations 70 [--seconds-of-training 165] [--json FILE]

Walkers at draft resolution learn in closed loop, T = 2 s long, with co-design, with centroids as features and without alarms: a robot
that tears goes on. A seed has the same initial weights in every variant, up to their gain. Rates do not fall, strains cost
nothing. At the end each walker is simulated for 3T with the parameters of its best loss:

    loss     best in training, mainly minus the distance in the last 1.5 s of the episode [m]
    norm     largest norm of the gradient in training
    speed    mean speed from T to 3T [m/s]; 0 if the simulation of the world failed
    later    that over the mean speed from T/2 to T
    tilt     largest tilt until 3T [degrees]
    gap      largest distance of rest neighbours until 3T [cells]; beyond 1.4 a robot has torn
    lasting  seeds with later ≥ 0.7, tilt < 30 degrees and at least 0.1 m/s from T/2 to T

Of the first six the median of the seeds, the lowest and the highest.
"""

import argparse
import dataclasses
import math
import time
from pathlib import Path

import numpy as np
import torch
from batched import Learners, Policies
from common import Table
from torch import Tensor

import softmpm
from softmpm.scene.neighbours import rest_neighbours
from softmpm_learn import objective
from softmpm_learn.design import Design
from softmpm_learn.episode import Frame, run_episode
from softmpm_learn.observe import Centroids
from softmpm_learn.runs.loops import ClosedLoop
from softmpm_learn.settings import DesignConf
from softmpm_learn.tasks import BipedConf, ElephantConf, Task, make_task

ROBOTS = {"biped": BipedConf, "elephant": ElephantConf}
SOLES = 0.04
"""Height of the part of a walker that counts as its soles [m]."""
LONGER = 3
"""Length of the examination over that of an episode."""
RETRIES = 5
"""Times that a failed episode is repeated."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Variant:
    """Settings of a learner; the defaults are those that the variants change."""

    gain: float = 3.0
    """Size of the first activations before tanh."""
    fade: float = 0.25
    """Time constant with which gradients fade [s]."""
    rate: float = 0.005
    """Learning rate of the policy."""
    effort: float = 0.05
    """Weight of the mean squared activation in the loss [m]."""
    mean: float = 0.0
    """Weight of the squared mean over time of each activation in the loss [m]."""
    period: float = 0.4
    """Period of the clock [s]."""
    upright: float = 1.0
    """Weight of the squared slope of the torso in the loss [m]."""
    features: bool = True
    """False leaves the clock only."""
    linear: bool = False
    """A policy without hidden layers."""
    soles: bool = False
    """The distance is that of the soles, else of all particles."""

    def __str__(self) -> str:
        changed = (f for f in dataclasses.fields(self) if getattr(self, f.name) != f.default)
        return ", ".join(f"{f.name}={getattr(self, f.name):g}" for f in changed) or "base"


VARIANTS = [
    Variant(),
    Variant(gain=1.0),
    Variant(gain=6.0),
    Variant(fade=0.1),
    Variant(fade=0.5),
    Variant(fade=1.0),
    Variant(fade=math.inf),
    Variant(rate=0.01),
    Variant(rate=0.02),
    Variant(mean=0.1),
    Variant(mean=0.1, gain=1.0),
    Variant(effort=0.15),
    Variant(effort=0.15, gain=6.0),
    Variant(features=False),
    Variant(period=0.3),
    Variant(period=0.6),
    Variant(upright=3.0),
    Variant(linear=True, gain=1.0),
    Variant(linear=True),
    Variant(gain=1.0, fade=0.1),
    Variant(mean=0.5),
    Variant(fade=0.5, mean=0.1),
    Variant(soles=True),
    Variant(soles=True, fade=0.1),
]


class Walkers:
    """Variants times seeds as worlds of one simulation, those of a variant side by side."""

    def __init__(self, task: Task, variants: list[Variant], seeds: int, device: torch.device):
        alarms = softmpm.Alarms(**dict.fromkeys(f.name for f in dataclasses.fields(softmpm.Alarms)))
        built = task.build | {"alarms": alarms, "calls": task.control_steps}
        worlds = len(variants) * seeds
        self.model = model = softmpm.build(task.scene, device=device, worlds=worlds, **built)
        table = [[float(getattr(v, f.name)) for v in variants] for f in dataclasses.fields(Variant)]
        columns = torch.tensor(table, device=device).repeat_interleave(seeds, dim=1)
        each = dict(zip((f.name for f in dataclasses.fields(Variant)), columns, strict=True))
        self.tilt = next(term for term in task.objective.terms if isinstance(term, objective.Tilt))
        self.task = dataclasses.replace(task, objective=weighted(task, self.tilt, each))
        self.observer = Centroids(model, list(task.regions.values()), task.body_length)
        self.policies = Policies(self.observer.size, model.muscle_count, each, seeds)
        one = Design(DesignConf(), model, task.regions)
        self.bounds = one.bounds
        self.free = {k: p.detach().repeat(worlds, 1).requires_grad_() for k, p in one.free.items()}
        weights, free = list(self.policies.parameters()), list(self.free.values())
        parts = self.task, model, self.observer, self.policies, self.design, weights, free
        self.loop = ClosedLoop(*parts, runs=worlds, fade=each["fade"])
        design_rate = each["rate"].new_full((1,), 0.03)
        rates = [each["rate"]] * len(weights) + [design_rate] * len(free)
        self.learners = Learners(weights + free, rates)

    def design(self) -> tuple[softmpm.Params, softmpm.Inputs]:
        """(D1) of design.py for every world."""
        values = {k: low + width * self.free[k].sigmoid() for k, (low, width) in self.bounds.items()}
        return self.model.params()._replace(**values), softmpm.Inputs()

    def train(self, iterations: int, seconds: float = math.inf) -> np.ndarray:
        """Losses, shape (iteration, world), of as many iterations as begin in this time; fewer if one fails in spite of its retries."""
        begin, losses = time.perf_counter(), []
        while len(losses) < iterations and time.perf_counter() - begin < seconds:
            try:
                losses.append(self._iteration().cpu().numpy())
            except softmpm.UnstableError as error:
                print(f"Training ends: {error}")
                break
        return np.array(losses)

    def _iteration(self) -> Tensor:
        """Losses of the worlds. One that fails goes halfway back to its best, then all the way, and the episode is repeated."""
        for share in (0.5, *[1.0] * (RETRIES - 1)):
            try:
                return self._learn()
            except softmpm.UnstableError as error:
                self.learners.back(error.world, share)
        return self._learn()

    def _learn(self) -> Tensor:
        episode, gradients = self.loop(None)
        loss = episode.loss.clone()
        self.learners.step(loss, list(gradients))
        return loss

    @torch.no_grad()
    def examine(self) -> dict[str, np.ndarray]:
        """Columns of the table for each world, simulated with its best parameters."""
        self.learners.back(slice(None), share=1.0)
        steps, spacing = self.task.control_steps, self.task.scene.grid.spacing
        near = rest_neighbours(self.task.scene, 1.4 * spacing)
        first, slot = np.nonzero(near >= 0)
        a, b = (torch.as_tensor(i, device=self.model.device) for i in (first, near[first, slot]))
        level, places, tilts, gaps = float(self.tilt.lever @ self.tilt.rest[:, 1]), [], [], []

        def watch(frame: Frame) -> None:
            x = frame.state.x
            places.append(x[..., 0].mean(dim=1))
            tilts.append((x[..., 1] @ self.tilt.on("lever", x) - level).abs().atan().rad2deg())
            gaps.append((x[:, a] - x[:, b]).norm(dim=-1).amax(dim=1) / spacing)

        long = dataclasses.replace(self.task, control_steps=LONGER * steps)
        params, inputs = self.design()
        failures = softmpm.Failures("freeze")
        rest = dict(inputs=inputs, on_frame=watch, failures=failures)
        run_episode(long, self.model, self.observer, self.policies, params, **rest)
        failed = np.isin(np.arange(self.model.worlds), failures.worlds)
        x = torch.stack(places).double().cpu().numpy()
        own = (x[steps] - x[steps // 2]) / (steps - steps // 2) / self.task.control_period
        speed = (x[-1] - x[steps]) / (LONGER - 1) / steps / self.task.control_period * ~failed
        found = {"tilt": torch.stack(tilts).amax(dim=0), "gap": torch.stack(gaps).amax(dim=0)}
        found |= {"loss": self.learners.best, "norm": self.learners.longest}
        found = {name: tensor.cpu().numpy() for name, tensor in found.items()}
        return found | {"own": own, "speed": speed, "later": speed / own, "failed": failed}


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeanActivation(objective.Term):
    """Mean over the muscles of the square of their mean activation [-]."""

    def value(self, path: objective.Path) -> Tensor:
        return path.activation.mean(dim=0).square().mean(dim=-1)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Weighted(objective.Term):
    """A term with a weight for each world."""

    term: objective.Term
    of_world: Tensor

    def value(self, path: objective.Path) -> Tensor:
        return self.of_world * self.term.value(path)


def weighted(task: Task, tilt: objective.Tilt, each: dict[str, Tensor]) -> objective.Objective:
    """Objective with the weights of each world."""
    heights, on_soles = task.scene.positions[:, 1], each["soles"]
    soles = np.flatnonzero(heights <= heights.min() + SOLES)
    begin = task.objective.terms[0].begin
    terms = (
        (objective.Progress(begin=begin), 1.0 - on_soles),
        (objective.Progress(begin=begin, particles=soles), on_soles),
        (objective.Effort(), each["effort"]),
        (MeanActivation(), each["mean"]),
        (tilt, each["upright"]),
    )
    return objective.Objective(*(Weighted(term=term, of_world=weights) for term, weights in terms))


def row(variant: Variant, found: dict[str, np.ndarray], iterations: int, examined: float) -> dict:
    """Row of the table from the columns of a variant's worlds; ``gap`` is left out if there is none."""
    lasting = (found["later"] >= 0.7) & (found["tilt"] < 30) & (found["own"] >= 0.1)
    head = {
        "variant": str(variant),
        "seeds": len(lasting),
        "iterations": iterations,
        "examined s": round(examined, 4),
    }
    for name in ("loss", "norm", "speed", "later", "tilt", "gap"):
        if name in found:
            ends = (np.median(found[name]), found[name].min(), found[name].max())
            head |= dict(zip((name, f"{name} low", f"{name} high"), map(float, ends), strict=True))
    return head | {"lasting": int(lasting.sum()), "failed": int(found["failed"].sum())}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--robot", choices=list(ROBOTS), default="elephant")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--iterations", type=int, default=70)
    parser.add_argument("--seconds-of-training", type=float, default=math.inf)
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    args = parser.parse_args()
    device = torch.device(args.device)
    task = make_task(ROBOTS[args.robot]())
    walkers = Walkers(task, VARIANTS, args.seeds, device)
    iterations = len(walkers.train(args.iterations, args.seconds_of_training))
    found = walkers.examine()
    table = Table(f"Variants of the learner, {task.name}, float32", device, args.json)
    for k, variant in enumerate(VARIANTS):
        own = {name: values[k * args.seeds : (k + 1) * args.seeds] for name, values in found.items()}
        table.add(row(variant, own, iterations, LONGER * task.seconds))


if __name__ == "__main__":
    main()
