"""An objective of one's own: a biped that walks and keeps its torso from bouncing. Leaves objective.gif and objective.png."""

import csv
import dataclasses
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path as File

import matplotlib.pyplot as plt
import numpy as np
from torch import Tensor

import softmpm
from softmpm_learn.objective import Objective, Path, Term
from softmpm_learn.settings import DesignConf, ObserverConf, Settings, TrainConf
from softmpm_learn.tasks import BipedConf, biped
from softmpm_learn.train import train


@dataclass(frozen=True, kw_only=True)
class Bounce(Term):
    """Mean squared vertical velocity [m²/s²] of the mean of some particles."""

    particles: np.ndarray

    def value(self, path: Path) -> Tensor:
        v = path.v[self.window(path)][..., self.on("particles", path.v), 1]  # (state, world, particle)
        return v.mean(dim=-1).square().mean(dim=0)


quick = "--quick" in sys.argv
task = biped(BipedConf(seconds=0.2 if quick else 1.0, control_period=0.025, lead=0.0))
bounce = Bounce(weight=0.5, particles=task.regions["body"])
task = dataclasses.replace(task, objective=Objective(*task.objective.terms, bounce))
settings = Settings(
    observer=ObserverConf(name="centroids"),
    design=DesignConf(enabled=False),
    train=TrainConf(iterations=3 if quick else 40, record_every=1, examine=False, endurance=1),
)
model = softmpm.build(task.scene, calls=task.control_steps, **task.build)
out = File("objective_run")
shutil.rmtree(out, ignore_errors=True)  # the learner would resume a run that is there
result = train(task, model, settings, out, progress=lambda k, row: print(f"{k}: loss {row['loss']:.4f}"))

softmpm.to_video(out / "run.h5", "objective.gif")  # of the last episode, which repeats the best
with open(out / "metrics.csv", newline="") as file:
    rows = list(csv.DictReader(file))
figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
for name in ("loss", *task.objective.names):
    axes.plot([float(row[name]) for row in rows], label=name)
axes.set(xlabel="iteration", ylabel="weighted term")
axes.legend()
figure.savefig("objective.png", dpi=110)
