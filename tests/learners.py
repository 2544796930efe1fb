"""Learners with pictures of one's choice, settings with other values, and the metrics of runs, for tests of several parts."""

import csv
import dataclasses
import itertools
from pathlib import Path

import torch

from softmpm_learn.autoencoder import Autoencoder
from softmpm_learn.learning.learner import Learner
from softmpm_learn.learning.phase import learn_together
from softmpm_learn.learning.replay import Replay
from softmpm_learn.seeding import seeded
from softmpm_learn.settings import LearningConf, Settings

TRAINING, HELD_OUT = (0, 4, 8), (2, 6)
"""Numbers of simulations that are for training and for validation, by the split of a quarter."""


def waves(count: int, shape=(11, 6), seed=1) -> torch.Tensor:
    """Pictures with two numbers in them: the strengths of two patterns."""
    generator = torch.Generator().manual_seed(seed)
    x, y = (torch.linspace(0, 3, n) for n in shape)
    pattern = torch.stack([torch.sin(x)[:, None] * torch.cos(y), torch.cos(x)[:, None] * torch.sin(y)])
    pattern = torch.stack([pattern, pattern.flip(0)])
    return torch.einsum("bk,kcij->bcij", torch.randn(count, 2, generator=generator), pattern)


def make_learner(
    folder: Path,
    conf: LearningConf,
    simulations: dict[int, torch.Tensor],
    *,
    seed=0,
    device="cpu",
    dtype=torch.float32,
) -> Learner:
    """A learner whose replay buffer has these simulations, by number, each of shape (frame, dim, *nodes)."""
    shape = tuple(next(iter(simulations.values())).shape)
    with seeded(seed):
        autoencoder = Autoencoder(shape[1], shape[2:], 2, [4, 8])
    replay = Replay(folder, shape, simulations=8, validation=0.25, device=device)
    for number, pictures in sorted(simulations.items()):
        replay.add(number, pictures)
    return Learner(conf, autoencoder.to(device, dtype), replay, seed)


def spoil(learner: Learner, epoch: int, value: float) -> None:
    """From this epoch on, counted from 0, every picture of the learner's buffer has this value; what is held out is not affected in a
    phase that has begun."""
    calls, real = itertools.count(), learner.replay.draw

    def draw(*args):
        if next(calls) == epoch:
            learner.replay.memory.fill_(value)
        return real(*args)

    learner.replay.draw = draw


def viscous(task):
    """The task with a material that can have its viscosity designed."""
    (body,) = task.scene.bodies
    body = dataclasses.replace(body, material=dataclasses.replace(body.material, viscosity=0.1))
    return dataclasses.replace(task, scene=dataclasses.replace(task.scene, bodies=[body]))


def learn(learner: Learner) -> dict[str, float]:
    """One learning phase of a learner alone; its figures."""
    return learn_together([learner])[0]


def changed(settings: Settings, **changes) -> Settings:
    """Settings with other values, given as group=dict(name=value)."""
    parts = {
        group: dataclasses.replace(getattr(settings, group), **values) for group, values in changes.items()
    }
    return dataclasses.replace(settings, **parts)


def rows_of(folder: str | Path) -> list[dict[str, str]]:
    """Rows of the metrics of a run."""
    with open(Path(folder) / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def metrics(folder: str | Path) -> list[dict[str, float]]:
    """The same as numbers, nan where a cell is empty."""
    return [{name: float(cell or "nan") for name, cell in row.items()} for row in rows_of(folder)]
