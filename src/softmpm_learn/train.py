"""Learning in the loop (2019): optimise by the gradient of whole simulations, learn from what they showed, and again.

for each iteration:
    optimise   simulate in closed loop, then step policy and design along the gradient of the loss,
               which passes through every substep, every activation and every look of the encoder
    learn      every few iterations: train the autoencoder on the grid velocity of past simulations,
               and let the target network, through which the policy looks, follow it
    save       metrics, recording, checkpoint
"""

import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import softmpm
from softmpm import Model
from softmpm_learn import checkpoint
from softmpm_learn.episode import Episode, Frame, run_episode
from softmpm_learn.run import Run
from softmpm_learn.settings import Settings
from softmpm_learn.table import Table

METRICS = [
    *("loss", "final", "running", "best", "effort"),
    *("gradient_policy", "gradient_design", "clipped", "retries"),
    *("young_change", "poisson_change", "density_change"),
    *("epochs", "training_loss", "validation_loss", "replay"),
]
"""Columns of metrics.csv; nothing in it depends on the clock."""
TIMING = ["simulate", "backward", "learn", "save"]
"""Columns of timing.csv [s]; ``save`` is that of the iteration before."""

logger = logging.getLogger("softmpm_learn")


class TrainingError(RuntimeError):
    """A simulation failed or a gradient is not finite; the checkpoint of the iterations before is on the disk."""

    def __init__(self, iteration: int, problem: str):
        super().__init__(
            f"iteration {iteration}: {problem} The run up to there is saved; what helps is a smaller time step "
            "(task.safety), smaller learning rates, tighter bounds of the design, or optimizer.max_norm."
        )
        self.iteration = iteration


@dataclass(frozen=True)
class Result:
    """How a run stands when it ends."""

    run: Run
    """Observer, policy, design and learner as they are now."""
    finished: bool
    """False if it was stopped before the last iteration."""
    best_loss: float
    best_iteration: int


def train(
    task,
    model: Model,
    settings: Settings,
    out: str | Path,
    *,
    progress: Callable[[int, dict[str, float]], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Result:
    """Optimise a robot; goes on where the checkpoint in ``out`` ends, if there is one.

    On a CPU the metrics of a run that was killed and resumed equal those of an unbroken one, to the last bit.

    Args:
        task: A :class:`softmpm_learn.tasks.task.Task`.
        model: Built from ``task.scene`` with ``settings.train.worlds`` worlds.
        out: Folder for checkpoint.pt, metrics.csv, timing.csv, run.h5 and replay/.
        progress: Called after each iteration with its number and metrics.
        stop: Asked after each iteration; once it says True the run ends, ready to resume.

    Raises:
        TrainingError: A simulation or a gradient failed; names the iteration.
        ValueError: Settings that do not go together, or with the checkpoint.
        softmpm_learn.checkpoint.CheckpointError: Every checkpoint in ``out`` is damaged.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    with checkpoint.locked(out):
        run = Run(task, model, settings, out)
        if checkpoint.exists(out):
            run.load_state_dict(checkpoint.load(out))
            logger.info("Going on after iteration %d of %s.", run.iteration, out)
        return _loop(run, out, progress, stop)


def _loop(run: Run, out: Path, progress, stop) -> Result:
    metrics = Table(out / "metrics.csv", METRICS, rows=run.iteration)
    timing = Table(out / "timing.csv", TIMING, rows=run.iteration)
    last, seconds = run.settings.train.iterations, dict.fromkeys(TIMING, 0.0)
    named = run.learner.replay.ids if run.learner else []
    with _recorder(run, out) as recorder:
        if run.iteration == 0:
            named = _save(run, out, named)
        while run.iteration < last and not stop():
            k = run.iteration
            row = optimise(run, recorder, seconds) | learn(run, seconds)
            metrics.append(k, row)
            timing.append(k, seconds)
            if recorder:
                recorder.scalars(k, {name: value for name, value in row.items() if math.isfinite(value)})
            run.iteration += 1
            with _clock(seconds, "save"):
                named = _save(run, out, named)
            if progress:
                progress(k, row)
        if run.iteration >= last and recorder and run.best["iteration"] >= 0:
            play_best(run, recorder)
    return Result(run, run.iteration >= last, run.best["loss"], run.best["iteration"])


def optimise(run: Run, recorder: softmpm.Recorder | None, seconds: dict[str, float]) -> dict[str, float]:
    """One optimisation step: simulate, differentiate, move policy and design. Gives figures for metrics.csv."""
    goal, retries = run.draw_goals(), 0
    while True:
        try:
            episode, lengths = attempt(run, goal, recorder, seconds)
            break
        except softmpm.UnstableError as error:
            if not run.safe or retries == run.settings.optimizer.retries:
                problem = " ".join([str(error), *getattr(error, "__notes__", [])])
                raise TrainingError(run.iteration, problem) from error
            logger.warning("Iteration %d: %s Going halfway back.", run.iteration, error)
            run.step_back()
            retries += 1
    row = _figures(run, episode) | lengths | {"retries": retries}
    if row["loss"] < run.best["loss"]:
        run.best = {"loss": row["loss"], "iteration": run.iteration, **run.actor()}
    run.keep_safe()
    run.optimizer.step()
    if run.learner and episode.seen is not None:
        run.learner.watch(run.iteration * run.model.worlds, episode.seen)
    return row | {"best": run.best["loss"]}


def attempt(run: Run, goal, recorder, seconds) -> tuple[Episode, dict[str, float]]:
    """Simulate and differentiate policy and design as they are."""
    k, conf = run.iteration, run.settings.train
    due = recorder is not None and (k % conf.record_every == 0 or k == conf.iterations - 1)
    with _clock(seconds, "simulate"), _record(run, recorder if due else None, k) as on_frame:
        episode = run_episode(
            run.task,
            run.model,
            run.observer,
            run.policy,
            run.params(),
            goal=goal,
            keep_every=run.settings.learning.frame_every if run.learner else 0,
            on_frame=on_frame,
        )
    with _clock(seconds, "backward"):
        return episode, differentiate(run, episode)


def differentiate(run: Run, episode: Episode) -> dict[str, float]:
    """Put the gradient of the mean loss into ``.grad`` of policy and design; gives its lengths.

    The encoder is left out: it learns from pictures, not from the loss.
    """
    policy, design = list(run.policy.parameters()), list(run.design.parameters())
    gradients = torch.autograd.grad(episode.loss.mean(), policy + design)
    for parameter, gradient in zip(policy + design, gradients, strict=True):
        parameter.grad = gradient
    lengths = {
        "gradient_policy": _length(gradients[: len(policy)]),
        "gradient_design": _length(gradients[len(policy) :]),
    }
    loss = episode.loss.mean().item()
    if not all(math.isfinite(value) for value in (loss, *lengths.values())):
        raise TrainingError(run.iteration, f"the loss or its gradient is not finite: {loss:g}, {lengths}.")
    limit, clipped = run.settings.optimizer.max_norm, 0
    if limit is not None and math.hypot(*lengths.values()) > limit:
        torch.nn.utils.clip_grad_norm_(policy + design, limit)
        clipped = 1
    return lengths | {"clipped": clipped}


def _length(gradients: Sequence[Tensor]) -> float:
    return math.sqrt(sum(g.double().square().sum().item() for g in gradients))


def learn(run: Run, seconds: dict[str, float]) -> dict[str, float]:
    """The learning phase, where one is due. Gives figures for metrics.csv."""
    seconds["learn"] = 0.0
    if run.learner is None:
        return {}
    row: dict[str, float] = {"replay": len(run.learner.replay.ids)}
    if run.iteration == 0 or (run.iteration + 1) % run.settings.learning.every == 0:
        with _clock(seconds, "learn"):
            row |= run.learner.learn(run.generator)
    return row


@torch.no_grad()
def play_best(run: Run, recorder: softmpm.Recorder) -> None:
    """Record the best policy and design once more, as the episode after the last."""
    now = run.actor()
    run.load_actor(run.best)
    with _record(run, recorder, run.iteration, of=run.best["iteration"], kind="best") as on_frame:
        run_episode(
            run.task,
            run.model,
            run.observer,
            run.policy,
            run.params(),
            goal=run.middle_goals(),
            on_frame=on_frame,
        )
    run.load_actor(now)


def _figures(run: Run, episode: Episode) -> dict[str, float]:
    parts = {"loss": episode.loss, "final": episode.final, "running": episode.running}
    row = {name: value.mean().item() for name, value in parts.items()} | {"effort": episode.effort}
    return row | {f"{name}_change": change for name, change in run.design.change().items()}


def _save(run: Run, out: Path, named: list[int]) -> list[int]:
    """Write a checkpoint, then drop the simulations that neither it nor the one before names."""
    checkpoint.save(out, run.state_dict())
    if run.learner is None:
        return []
    ids = run.learner.replay.ids
    run.learner.replay.prune(named + ids)
    return ids


def _recorder(run: Run, out: Path) -> contextlib.AbstractContextManager:
    conf = run.settings.train
    if conf.record_every == 0:
        return contextlib.nullcontext()
    return softmpm.Recorder(out / "run.h5", run.model, resume_before=run.iteration, every=conf.frame_every)


@contextlib.contextmanager
def _record(run: Run, recorder: softmpm.Recorder | None, iteration: int, **about) -> Iterator:
    """Gives what to call at each frame, or None without a recorder."""
    if recorder is None:
        yield None
        return
    with recorder.episode(iteration, task=run.task.name, **about) as film:

        def on_frame(frame: Frame) -> None:
            with torch.no_grad():
                velocity = softmpm.rasterize(run.model, frame.state).velocity
                film.frame(frame.time, frame.state, frame.activation, velocity, frame.features)

        yield on_frame


@contextlib.contextmanager
def _clock(seconds: dict[str, float], name: str) -> Iterator[None]:
    begin = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - begin
