"""Pictures of a run: what loss.png, latent.png and robot.png show, at its end and while it goes on."""

import csv
import math
import time
from pathlib import Path

import numpy as np
import torch

import softmpm
from softmpm_learn.design import DESIGNABLE
from softmpm_learn.figures import VALUES, latent_figure, loss_figure, robot_figure
from softmpm_learn.loggers import Loggers
from softmpm_learn.runs.run import Run
from softmpm_learn.tasks import Task
from softmpm_learn.train import Result

PICTURES = 4
"""Moments of the best episode in robot.png, the first and the last among them."""
DRAWN = "loss", "robot", "latent"
"""Pictures of a run at its end."""
PAUSE = 60.0
"""Least time between pictures while a run goes on [s]."""
DESIGN = {
    "young": ("Young's modulus", "Pa"),
    "poisson": ("Poisson's ratio", ""),
    "density": ("density", "kg/m³"),
    "strength": ("strength of the muscles", "Pa"),
    "viscosity": ("viscosity", "Pa s"),
}
"""Title and unit of each quantity in robot.png."""
CURVES = {
    "loss": "loss",
    "evaluation": "loss in evaluations",
    "validation_loss": "validation loss of the autoencoder",
    "activation": "activation, root mean square",
    "young_change": "mean change of Young's modulus",
}
"""Columns of metrics.csv in loss.png; those without numbers are left out."""


def draw(result: Result, task: Task, out: Path) -> None:
    """Leave loss.png, latent.png where a latent was learned, and robot.png where something was recorded."""
    loss_figure(out / "loss.png", curves(out / "metrics.csv"))
    if result.run.learner is not None and result.run.learner.conf.epochs:
        latent_figure(out / "latent.png", decoded(result.run))
    episode = last_episode(out / "run.h5")
    if episode is not None:
        draw_robot(result.run, task, out, *episode)


def draw_robot(run: Run, task: Task, out: Path, iteration: int, frames: dict[str, np.ndarray]) -> None:
    """Leave robot.png: some moments of an episode, and the materials."""
    moments = np.linspace(0, len(frames["time"]) - 1, PICTURES).round().astype(int)
    active = frames["activation"][:-1]  # the last frame has none
    pictures = [
        (f"iteration {iteration}, {frames['time'][k]:.2f} s", frames["x"][k], active[min(k, len(active) - 1)])
        for k in moments
    ]
    goal = None if any(run.settings.train.goal_spread) else task.goal
    robot_figure(out / "robot.png", task.scene, pictures, design(run), goal=goal)


class Sketches:
    """Pictures while a run goes on: of the first recorded episode, and then of such as come a while after the last picture."""

    def __init__(self, task: Task, out: Path, loggers: Loggers):
        self.task, self.out, self.loggers, self._drawn = task, out, loggers, -math.inf

    def __call__(self, run: Run, iteration: int, frames: dict[str, np.ndarray]) -> None:
        """Draw, if it is time, for the loggers as well; arguments as of :func:`draw_robot`."""
        if run.settings.train.pictures and time.monotonic() - self._drawn > PAUSE:
            loss_figure(self.out / "loss.png", curves(self.out / "metrics.csv"))
            draw_robot(run, self.task, self.out, iteration, frames)
            self.loggers.pictures(iteration, [self.out / "loss.png", self.out / "robot.png"])
            self._drawn = time.monotonic()


def no_sketch(run: Run, iteration: int, frames: dict[str, np.ndarray]) -> None:
    """No picture while a run goes on: of several seeds only the first is drawn."""


def curves(path: Path) -> dict[str, tuple[list[float], list[float]]]:
    """Curves of loss.png from metrics.csv: iterations and values of each."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    found = {}
    for column, title in CURVES.items():
        points = [(int(row["iteration"]), float(row[column])) for row in rows if row.get(column)]
        found[title] = ([k for k, _ in points], [value for _, value in points])
    return found


@torch.no_grad()
def decoded(run: Run) -> np.ndarray:
    """Velocity [m/s] that each latent feature stands for at ``VALUES``, shape (feature, value, *nodes, dim)."""
    assert run.learner is not None
    size = run.observer.size
    features = torch.zeros(size, len(VALUES), size, dtype=run.model.dtype, device=run.model.device)
    for k in range(size):
        features[k, :, k] = torch.tensor(VALUES)
    fields = run.learner.autoencoder.decode(features.flatten(end_dim=1))[:, : run.model.dim]
    return fields.unflatten(0, (size, len(VALUES))).movedim(2, -1).cpu().numpy()


@torch.no_grad()
def design(run: Run) -> dict[str, tuple[np.ndarray, str]]:
    """Material of the best robot and the inputs that were designed: value on each particle and unit; of a material that differs between
    parts of the scene that of the scene, and the quotient of both."""
    now = run.policy_snapshot()
    if run.best["iteration"] >= 0:
        run.load_policy(run.best)
    params, inputs = run.design()
    run.load_policy(now)
    found = params._asdict() | {name: value for name, value in inputs._asdict().items() if value is not None}
    first, shown = run.model.params()._asdict(), {}
    for name, value in found.items():
        title, unit = DESIGN.get(name, (name, ""))
        values = _on_particles(run.model, name, value.cpu().numpy())
        if name in first and len(first[name].unique()) > 1:  # stiff parts would hide what was designed
            scene = first[name].cpu().numpy().reshape(-1)
            shown[f"{title} of the scene"] = (scene, unit)
            title, unit, values = f"{title}, over that of the scene", "", values / scene
        shown[title] = (values, unit)
    return shown


def _on_particles(model: softmpm.Model, name: str, value: np.ndarray) -> np.ndarray:
    """Value on each particle: of a quantity of the muscles the sum over those of the particle, NaN where there is none."""
    if DESIGNABLE[name] == "particle":
        return value
    total, muscular = np.zeros(model.particle_count), np.zeros(model.particle_count, dtype=bool)
    for muscle, one in zip(model.scene.muscles, value, strict=True):
        total[muscle.particles] += one
        muscular[muscle.particles] = True
    return np.where(muscular, total, np.nan)


def last_episode(path: Path) -> tuple[int, dict[str, np.ndarray]] | None:
    """Iteration shown and frames of the last recorded simulation: the best, once a run is finished."""
    if not path.exists():
        return None
    with softmpm.Recording(path) as recording:
        if not recording.episodes:
            return None
        row = recording.episodes[-1]
        frames = recording.frames(row)
        shown = int(recording.attributes(row).get("of", row))
    return (shown, frames) if len(frames["time"]) > 1 else None
