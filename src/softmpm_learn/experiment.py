"""One experiment, from its settings to everything that it leaves in its folder. Nothing here knows Hydra."""

import contextlib
import csv
import logging
import math
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import warp as wp

import softmpm
from softmpm_learn import plugins
from softmpm_learn.config import RunConf
from softmpm_learn.design import DESIGNABLE, declared_inputs
from softmpm_learn.distributed import Group
from softmpm_learn.figures import VALUES, latent_figure, loss_figure, robot_figure
from softmpm_learn.loggers import Loggers
from softmpm_learn.progress import ProgressBar
from softmpm_learn.run import Run
from softmpm_learn.saved import save
from softmpm_learn.stop import Signals
from softmpm_learn.tasks import Task, TaskConf, make_task
from softmpm_learn.train import Result, train

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
    "evaluation": "loss at the evaluation goals",
    "validation_loss": "validation loss of the autoencoder",
    "activation": "activation, root mean square",
    "young_change": "mean change of Young's modulus",
}
"""Columns of metrics.csv in loss.png; those without numbers are left out."""

logger = logging.getLogger("softmpm_learn")


def run_experiment(
    conf: RunConf,
    out: Path,
    group: Group | None = None,
    signals: Signals | None = None,
    begin: Callable[[], None] = lambda: None,
) -> Result:
    """Train, draw and convert; goes on where a checkpoint in ``out`` ends. The last line says what to do next.

    Of several processes, the first draws, converts and speaks.

    Args:
        signals: What asks the run to end, None for nothing.
        begin: Called in the first process once ``out`` is locked and found to be this run's, before the configuration is saved.
    """
    group, signals = group or Group(), signals or Signals()
    wp.config.log_level = wp.LOG_ERROR
    torch.set_num_threads(conf.device.threads)
    need_determinism(conf.device.deterministic)
    with group.fail_together():
        task = make_task(conf.task)
        model = make_model(task, conf, group)
    logger.info("%s", model.describe(task.substeps))
    with Loggers(conf.train.log, out) as loggers, contextlib.ExitStack() as held:
        progress = held.enter_context(ProgressBar(conf.train.iterations)) if group.first else None
        stop = held.enter_context(signals.awaited(insist=group.size == 1))

        def begun() -> None:
            begin()
            save(conf, out)
            signals.advice = f"Finished iterations are saved; to go on, or to draw the pictures: resume={out}"

        result = train(
            task,
            model,
            conf.settings,
            out,
            progress=(lambda iteration, row: progress(iteration, row["loss"])) if progress else None,
            stop=stop,
            begin=begun,
            group=group,
            finer=finer(conf.task) if conf.train.examine else None,
            sketch=Sketches(task, out, loggers),
            loggers=loggers,
        )
        held.close()  # a signal now ends the program
        if group.first:
            draw(result, task, out)
            loggers.pictures(result.run.iteration, [out / f"{name}.png" for name in DRAWN])
    if group.first:
        logger.info("%s", farewell(result, task, out))
        signals.advice = f"The run had ended; everything is in {out}."
    return result


def finer(conf: TaskConf) -> Task | None:
    """The same task on the next finer grid, None if there is none."""
    refined = conf.refined()
    return None if refined is None else make_task(refined)


def need_determinism(needed: bool) -> None:
    """Whether PyTorch must give the same bits in every run; an operation that cannot then raises a RuntimeError that names it."""
    if needed:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS reads it when it is first used
    torch.use_deterministic_algorithms(needed)


def make_model(task: Task, conf: RunConf, group: Group) -> softmpm.Model:
    """The task's scene on the device of the settings, with this process's share of the worlds."""
    device, memory = group.device(conf.device.name), conf.device.memory
    if device and device.startswith("cuda:"):
        torch.cuda.set_device(device)  # else every process takes memory of the first GPU too
    return softmpm.build(
        task.scene,
        device=device,
        dtype=getattr(torch, conf.device.dtype),
        worlds=len(group.split(conf.train.worlds)),
        memory_budget=None if memory is None else round(1e6 * memory),
        inputs=declared_inputs(conf.design),
        calls=task.control_steps,
        deterministic=conf.device.deterministic,
        **task.build,
    )


def draw(result: Result, task: Task, out: Path) -> None:
    """Leave loss.png, latent.png where a latent was learned, and robot.png where something was recorded."""
    loss_figure(out / "loss.png", curves(out / "metrics.csv"))
    if result.run.learner is not None:
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
        """Draw, if it is time; arguments as of :func:`draw_robot`."""
        if time.monotonic() - self._drawn > PAUSE:
            loss_figure(self.out / "loss.png", curves(self.out / "metrics.csv"))
            draw_robot(run, self.task, self.out, iteration, frames)
            self.loggers.pictures(iteration, [self.out / "loss.png", self.out / "robot.png"])
            self._drawn = time.monotonic()


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
    fields = run.learner.autoencoder.decode(features.flatten(end_dim=1))
    return fields.unflatten(0, (size, len(VALUES))).movedim(2, -1).cpu().numpy()


@torch.no_grad()
def design(run: Run) -> dict[str, tuple[np.ndarray, str]]:
    """Material of the best robot and the inputs that were designed: value on each particle and unit."""
    now = run.policy_snapshot()
    if run.best["iteration"] >= 0:
        run.load_policy(run.best)
    params, inputs = run.design()
    run.load_policy(now)
    found = params._asdict() | {name: value for name, value in inputs._asdict().items() if value is not None}
    shown = {}
    for name, value in found.items():
        title, unit = DESIGN.get(name, (name, ""))
        shown[title] = (_on_particles(run.model, name, value.cpu().numpy()), unit)
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


def farewell(result: Result, task: Task, out: Path) -> str:
    """Summary of the result; its last line is the command to view the recording or to resume the run."""
    lines = []
    if math.isfinite(result.best_loss):
        lines.append(
            f"Best loss {result.best_loss:.5g}, in iteration {result.best_iteration}{outcome(task, out)}."
        )
    if count := result.run.fallback.count:
        lines.append(
            f"It fell far below its best and went back to it: {count} time{'s' if count > 1 else ''}."
        )
    if result.examination:
        lines.append(f"Examined: {examined(result.examination)}.")
    shown = _relative(out)
    if not result.finished:
        lines.append(f"Stopped after {result.run.iteration} iterations.")
    if (out / "run.h5").exists():
        lines.append(f"Everything is in {shown}. To look at the recording: {convert(out)}")
    else:
        lines.append(f"Everything is in {shown}; train.record_every=0, so nothing was recorded.")
    if not result.finished:
        lines.append(f"To go on: {plugins.command()} resume={shown}")
    return "\n".join(lines)


def examined(examination: dict[str, float]) -> str:
    """What was found at the end of a run; see examination.py."""
    answers = {name: "none" if math.isnan(value) else f"{value:.3g}" for name, value in examination.items()}
    return ", ".join(f"{name} {answer}" for name, answer in answers.items())


def outcome(task: Task, out: Path) -> str:
    """What the robot achieved in the last recorded simulation, in words."""
    episode = last_episode(out / "run.h5")
    if episode is None:
        return ""
    words = task.objective.outcome(episode[1]["x"], task.body_length)
    return f"; {words}" if words else ""


def convert(out: Path) -> str:
    """Turn run.h5 into run.rrd; gives the command that opens the recording, or that converts it elsewhere."""
    recording, picture = out / "run.h5", out / "run.rrd"
    try:
        softmpm.to_rerun(recording, picture)
    except ImportError:
        return f"python -m softmpm {_relative(recording)} && rerun {_relative(picture)} (with rerun-sdk)"
    return f"rerun {_relative(picture)}" if shutil.which("rerun") else f"python -m rerun {_relative(picture)}"


def _relative(path: Path) -> str:
    """As short as it can be typed from here."""
    here = os.path.relpath(path)
    return str(path) if here.startswith("..") else here
