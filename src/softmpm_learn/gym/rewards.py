"""Rewards of control steps: minus what each adds to the terms of the task's objective (:mod:`softmpm_learn.objective`).

dense       windows of time are left out: distances count, and places are compared, from the first step to the last
objective   as the learner counts it: the sum over an episode is minus the loss, but for what the first state adds
"""

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softmpm import State
from softmpm_learn.tasks import Task
from softmpm_learn.term import Path, Term

REWARDS = ("dense", "objective")


class Costs:
    """Contribution of a control step to the loss of an episode."""

    def __init__(self, task: Task, dense: bool):
        self.task, self.count, self.period = task, task.control_steps, task.control_period
        self._terms = [self._shared(term, dense) for term in task.objective.terms]

    def _shared(self, term: Term, dense: bool) -> tuple[Term, float, np.ndarray]:
        """The term on the state after a step or on the way there, the share of the first state, and that of each step."""
        if dense:
            term = dataclasses.replace(term, begin=0.0, end=math.inf)
        path: Any = Path([k * self.period for k in range(self.count + 1)], [], torch.empty(0))
        states, share = (
            term.window(path),
            np.zeros(self.count + 1),
        )  # the last one for :meth:`cost` after the end
        if term.adds_up == "way":
            share[states.start : states.stop - 1] = 1.0
            return dataclasses.replace(term, begin=0.0, end=math.inf), 0.0, share
        alone = dataclasses.replace(term, begin=self.period, end=math.inf)
        if term.adds_up == "steps":
            steps = term.steps(path)
            share[steps] = 1.0 / (steps.stop - steps.start)
            return alone, 0.0, share
        share[max(states.start - 1, 0) : states.stop - 1] = 1.0 / (states.stop - states.start)
        return alone, (1.0 / (states.stop - states.start) if states.start == 0 else 0.0), share

    def first(self, state: State, activation: Tensor, goal: Tensor | None) -> Tensor:
        """Contribution of the initial state, shape (world,); ``activation`` gives the shape (world, muscle)."""
        path = Path([0.0, self.period], [state, state], torch.zeros_like(activation)[None], goal)
        return self._sum(activation, [(term, first) for term, first, _ in self._terms], path)

    def cost(
        self, before: State, after: State, activation: Tensor, steps: np.ndarray, goal: Tensor | None
    ) -> Tensor:
        """Contribution of a control step, shape (world,).

        Args:
            activation: Activation during the step [-], shape (world, muscle).
            steps: Number of the step in the episode of each world, shape (world,).
        """
        path, at = (
            Path([0.0, self.period], [before, after], activation[None], goal),
            np.minimum(steps, self.count),
        )
        return self._sum(activation, [(term, share[at]) for term, _, share in self._terms], path)

    def _sum(self, like: Tensor, shares: list[tuple[Term, Any]], path: Path) -> Tensor:
        total = like.new_zeros(like.shape[0])
        for term, share in shares:
            if np.any(share):
                factor = torch.as_tensor(term.weight * np.asarray(share), device=like.device).to(like.dtype)
                total = total + factor * term.value(path)
        return total

    def standing(self, state: State, activation: Tensor, steps: np.ndarray, goal: Tensor | None) -> Tensor:
        """Contribution of the steps from ``steps`` on if a world stands still until the horizon, shape (world,)."""
        nothing = torch.zeros_like(activation)
        path = Path([0.0, self.period], [state, state], nothing[None], goal)
        left = [
            (term, np.array([share[k : self.count].sum() for k in steps])) for term, _, share in self._terms
        ]
        return self._sum(activation, left, path)
