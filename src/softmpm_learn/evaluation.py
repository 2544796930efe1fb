"""Evaluation at fixed goals of a run whose simulations draw their own: a loss without chance, which compares iterations and runs."""

import logging
import math

import torch

import softmpm
from softmpm_learn.episode import run_episode
from softmpm_learn.run import Run
from softmpm_learn.runs import Runs

logger = logging.getLogger("softmpm_learn")


def due(run: Run) -> bool:
    """True if goals are drawn at random and this iteration is evaluated: the first, and every so many."""
    every = run.settings.train.evaluate_every
    return run.random_goals and (run.iteration == 0 or (run.iteration + 1) % every == 0)


@torch.no_grad()
def evaluate(runs: Runs) -> list[float]:
    """Mean loss of policy and design of each run as they are over the evaluation goals; nan if one of its simulations failed."""
    params, inputs = runs.design()
    losses, failures = [], softmpm.Failures("freeze")
    for goal in runs.evaluation_goals():
        episode = run_episode(
            runs.task,
            runs.model,
            runs.observer,
            runs.policy,
            params,
            inputs=inputs,
            goal=goal,
            failures=failures,
        )
        losses.append(episode.loss.unflatten(0, (len(runs.all), -1)).mean(dim=1))
    for k, error in runs.failed(failures).items():
        logger.warning("Iteration %d: the evaluation failed: %s", runs.all[k].iteration, error)
        losses[0][k] = math.nan
    means = runs.group.average(losses)  # nan in every process if it is in one
    return torch.stack(means).mean(dim=0).tolist()
