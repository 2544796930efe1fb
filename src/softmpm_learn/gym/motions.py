"""Motions of the running episodes, for terms that need the whole of one; their states stay in memory."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from softmpm import State
from softmpm_learn.tasks import Task
from softmpm_learn.term import Path


class Step(NamedTuple):
    """Control step of all worlds."""

    before: State
    after: State
    """States in which it begins and ends; a world that failed in it is at rest. Differentiable."""
    activation: Tensor
    """Activation during the step [-], shape (world, muscle). Differentiable."""
    goal: Tensor | None
    """Goal of each world [m], shape (world, dim), or None if it is the task's own."""
    count: np.ndarray
    """Control steps of the episode of each world, with this one, shape (world,)."""
    moving: np.ndarray
    """Worlds that take part, shape (world,). The others have just begun an episode."""
    failed: np.ndarray
    """Worlds that failed in it, shape (world,)."""


class Motions:
    """Motions of the running episodes of all worlds."""

    def __init__(self, task: Task):
        self._horizon, self._period = task.control_steps, task.control_period
        self._made: list[tuple[State, Tensor]] = []  # state before each step, and activation

    def add(self, step: Step) -> list[tuple[Tensor, Path]]:
        """The motions with one more step, each with the indices of the worlds that have made equally many. Differentiable.

        Those of worlds that failed go on until the horizon, at rest and without activation.
        """
        self._made.append((step.before, step.activation.clone()))
        self.trim(step.count)
        kinds = zip(step.count.tolist(), step.failed.tolist(), strict=True)
        return [self._some(step, count, failed) for count, failed in sorted(set(kinds)) if count]

    def trim(self, count: np.ndarray) -> None:
        """Release the steps before the running episodes, whose numbers of steps are ``count``."""
        del self._made[: len(self._made) - count.max()]

    def _some(self, step: Step, count: int, failed: bool) -> tuple[Tensor, Path]:
        """Motions of the worlds that have made ``count`` steps, and have failed or have not."""
        mask = (step.count == count) & (step.failed == failed)
        worlds = torch.as_tensor(np.flatnonzero(mask), device=step.activation.device)

        def rows(tensor: Tensor) -> Tensor:
            return tensor if mask.all() else tensor[worlds]

        made, left = self._made[-count:], self._horizon - count if failed else 0
        states = [
            State(rows(x), rows(v), rows(C), rows(F))
            for x, v, C, F, *_ in (*(before for before, _ in made), step.after)
        ]
        activations = [rows(activation) for _, activation in made]
        path = Path(
            [k * self._period for k in range(count + left + 1)],
            states + states[-1:] * left,
            torch.stack(activations + [torch.zeros_like(activations[0])] * left),
            None if step.goal is None else rows(step.goal),
        )
        return worlds, path

    def detach(self) -> None:
        """Cut the gradient."""
        self._made = [(before.detach(), activation.detach()) for before, activation in self._made]
