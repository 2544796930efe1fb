"""Evaluation at fixed goals of a run whose simulations draw their own: a loss without chance, which compares iterations and runs."""

import logging
import math

import torch

import softmpm
from softmpm_learn.distributed import OtherProcessError
from softmpm_learn.episode import run_episode
from softmpm_learn.run import Run

logger = logging.getLogger("softmpm_learn")


def due(run: Run) -> bool:
    """True if goals are drawn at random and this iteration is evaluated: the first, and every so many."""
    every = run.settings.train.evaluate_every
    return run.random_goals and (run.iteration == 0 or (run.iteration + 1) % every == 0)


@torch.no_grad()
def evaluate(run: Run) -> float:
    """Mean loss of policy and design as they are over the evaluation goals; nan if one of these simulations failed."""
    params, inputs = run.design()
    losses = []
    try:
        for goal in run.evaluation_goals():
            with run.failing_together():
                episode = run_episode(
                    run.task, run.model, run.observer, run.policy, params, inputs=inputs, goal=goal
                )
            losses += run.group.average([episode.loss.mean()])
    except (softmpm.UnstableError, OtherProcessError) as error:
        logger.warning("Iteration %d: the evaluation failed: %s", run.iteration, error)
        return math.nan
    return torch.stack(losses).mean().item()
