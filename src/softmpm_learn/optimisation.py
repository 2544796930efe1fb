"""The optimisation step: simulate, differentiate, update policy and design; a step that fails is halved and tried again."""

import contextlib
import logging
import math
import time
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

import softmpm
from softmpm_learn.distributed import OtherProcessError, in_full
from softmpm_learn.episode import Episode
from softmpm_learn.evaluation import due, evaluate
from softmpm_learn.run import Run
from softmpm_learn.run_logger import RunLogger

logger = logging.getLogger("softmpm_learn")


class TrainingError(RuntimeError):
    """A simulation failed or a gradient is not finite; the checkpoint of the iterations before is on the disk."""

    def __init__(self, iteration: int, problem: str):
        super().__init__(
            f"iteration {iteration}: {problem} The run up to there is saved; what helps is a smaller time step "
            "(task.safety), smaller learning rates, tighter bounds of the design, or optimizer.max_norm."
        )
        self.iteration = iteration


class NotFiniteError(RuntimeError):
    """The loss or its gradient is infinite or no number."""


def optimise(
    run: Run, run_logger: RunLogger | None, seconds: dict[str, float]
) -> tuple[dict[str, float], Tensor | None]:
    """One optimisation step: simulate, differentiate, update policy and design. Returns a row of metrics.csv and the observations.

    After a failure policy and design go halfway back to the last simulation that succeeded, and try again.
    """
    goal, retries = run.draw_goals(), 0
    while True:
        try:
            episode, row = attempt(run, goal, run_logger, seconds)
            break
        except (softmpm.UnstableError, OtherProcessError, NotFiniteError) as error:
            if not run.safe or retries == run.settings.optimizer.retries:
                raise TrainingError(run.iteration, in_full(error)) from error
            logger.warning("Iteration %d: %s Going halfway back.", run.iteration, error)
            run.backtrack()
            retries += 1
    row |= {f"{name}_change": change for name, change in run.design.change().items()}
    value = row["loss"]
    if run.random_goals:  # the loss is that of the goals drawn
        value = row["evaluation"] = evaluate(run) if due(run) else math.nan
    if value < run.best["loss"]:
        run.best = {"loss": value, "iteration": run.iteration, **run.policy_snapshot()}
    row |= {"retries": retries, "best": run.best["loss"], "fallbacks": int(step_or_fall_back(run, value))}
    return row, episode.observations


def step_or_fall_back(run: Run, loss: float) -> bool:
    """Take the step along the gradient, or go back to the best; True for the latter."""
    conf = run.settings.optimizer
    if not run.fallback.is_due(loss, run.best["loss"], conf):
        run.step()
        return False
    run.fall_back()
    logger.warning(
        "Iteration %d: for %d iterations the progress was below %g of the best; going back to iteration %d, with rates times %g.",
        *(run.iteration, conf.fallback_after, conf.fallback_share, run.best["iteration"], conf.fallback_rate),
    )
    return True


def attempt(run: Run, goal, run_logger: RunLogger | None, seconds) -> tuple[Episode, dict[str, float]]:
    """Simulate and differentiate policy and design as they are, in every process, or fail in every one."""
    recorded = (
        run_logger.record(run.iteration)
        if run_logger and run_logger.due(run.iteration)
        else contextlib.nullcontext()
    )
    with clock(seconds, "episode"):
        with run.failing_together(), recorded as on_frame:
            episode, gradients = run.loop(goal, on_frame)
        return episode, take_gradient(run, episode, gradients)


def take_gradient(run: Run, episode: Episode, gradients: Sequence[Tensor]) -> dict[str, float]:
    """Put the mean gradient of all worlds into ``.grad`` of policy and design; gives its length and the losses.

    The encoder is left out: it learns from pictures, not from the loss.

    Raises:
        NotFiniteError: In every process, because the means are the same everywhere.
    """
    policy, design = list(run.policy.parameters()), list(run.design.parameters())
    gradients = run.group.average(gradients)
    for parameter, gradient in zip(policy + design, gradients, strict=True):
        parameter.grad = gradient
    lengths = {
        "gradient_policy": _length(gradients[: len(policy)]),
        "gradient_design": _length(gradients[len(policy) :]),
    }
    losses = _losses(run, episode)
    if not all(math.isfinite(value) for value in (losses["loss"], *lengths.values())):
        both = f"{losses['loss']:g} and {math.hypot(*lengths.values()):g}"
        raise NotFiniteError(f"the loss or the norm of its gradient is not finite: {both}.")
    limit, clipped = run.settings.optimizer.max_norm, 0
    if limit is not None and math.hypot(*lengths.values()) > limit:
        torch.nn.utils.clip_grad_norm_(policy + design, limit)
        clipped = 1
    return losses | lengths | {"clipped": clipped}


def _losses(run: Run, episode: Episode) -> dict[str, float]:
    """Means over all worlds; the activation is a root mean square."""
    means = {name: term.mean() for name, term in ({"loss": episode.loss} | episode.terms).items()}
    *losses, square = run.group.average([*means.values(), episode.effort])
    return {name: loss.item() for name, loss in zip(means, losses, strict=True)} | {
        "activation": square.sqrt().item()
    }


def _length(gradients: Sequence[Tensor]) -> float:
    return math.sqrt(sum(g.double().square().sum().item() for g in gradients))


@contextlib.contextmanager
def clock(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Measure the time that the block takes [s]."""
    begin = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - begin
