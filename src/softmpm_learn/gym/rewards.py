"""Rewards of control steps: minus what each adds to the terms of the task's objective (:mod:`softmpm_learn.objective`).

dense       windows of time are left out: distances count, and places are compared, from the first step to the last
objective   as the learner counts it: the sum over an episode is minus the loss, but for what the first state adds

Terms that add up (:attr:`softmpm_learn.term.Term.adds_up`) are evaluated on a single step. The others are evaluated on the motion so
far, of which there is none without a step or a state in the window: a step adds the change of their value.
"""

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softmpm import State
from softmpm_learn.gym.motions import Step
from softmpm_learn.tasks import Task
from softmpm_learn.term import Path, Term

REWARDS = ("dense", "objective")
ROUNDING = 1e-3
"""Largest difference of a term from the sum of its shares, relative to these: rounding in float32 is below 1e-4."""


def shared(term: Term, path: Path) -> tuple[Term, float, np.ndarray]:
    """A term that adds up on the state after a step or on the way there, the share of the first state, and that of each step."""
    states = term.window(path)
    share = np.zeros(len(path.times) - 1)
    if term.adds_up == "way":
        share[states.start : states.stop - 1] = 1.0
        return dataclasses.replace(term, begin=0.0, end=math.inf), 0.0, share
    alone = dataclasses.replace(term, begin=path.times[1], end=math.inf)
    if term.adds_up == "steps":
        steps = term.steps(path)
        share[steps] = 1.0 / (steps.stop - steps.start)
        return alone, 0.0, share
    share[max(states.start - 1, 0) : states.stop - 1] = 1.0 / (states.stop - states.start)
    return alone, (1.0 / (states.stop - states.start) if states.start == 0 else 0.0), share


@torch.no_grad()
def check_sums(task: Task, rest: State, activation: Tensor, goal: Tensor | None) -> None:
    """Compare each term that adds up with the sum of its shares, in three control steps at random near the initial state.

    Args:
        rest: Initial state of every world.
        activation: Gives the shape (world, muscle).
        goal: Goal of each world [m], shape (world, dim), or None.

    Raises:
        ValueError: They differ, so that the return of an episode would not be minus its loss.
    """
    generator, times = torch.Generator().manual_seed(0), [k * task.control_period for k in range(4)]

    def random(like: Tensor, scale: float) -> Tensor:
        return scale * torch.randn(like.shape, generator=generator).to(like)

    def moved() -> State:
        """Strained and displaced all over, and moving."""
        strain, middle = random(rest.F[:, 0], 0.02), rest.x.mean(dim=1, keepdim=True)
        x = rest.x + (rest.x - middle) @ strain.mT + random(middle, 0.25 * task.scene.grid.spacing)
        return State(x, random(rest.v, task.body_length), rest.C, rest.F + strain[:, None] @ rest.F)

    states, steps = [moved() for _ in times], torch.stack([random(activation, 0.5) for _ in times[1:]])
    for one in task.objective.terms:
        if not one.adds_up:
            continue
        term = dataclasses.replace(one, begin=0.0, end=math.inf)
        motion = Path(times, states, steps, goal)
        alone, first, share = shared(term, motion)
        single = [Path(times[:2], states[:1] * 2, steps[:1], goal)]
        single += [Path(times[:2], states[k : k + 2], steps[k : k + 1], goal) for k in range(len(share))]
        pairs = zip([first, *share], single, strict=True)
        parts = [part * _finite(alone, path) for part, path in pairs]
        away = (_finite(term, motion) - sum(parts)).abs().max()
        if away > ROUNDING * sum(part.abs().max() for part in parts):
            raise ValueError(
                f"{type(term).__name__} says adds_up = {term.adds_up!r}, but its value in a window is not the "
                f"{'sum' if term.adds_up == 'way' else 'mean'} of its values on its parts; leave adds_up out, which costs more time."
            )


class Costs:
    """Costs of the running episode of each world.

    Args:
        task: Whose objective counts.
        reward: One of :data:`REWARDS`.
        like: Gives the shape, (world, muscle), the device and the precision.

    Attributes:
        wholes: Terms that do not add up, each with the number of states with which its window begins to count.
        total: Sum of the costs so far, with that of the initial state, shape (world,), detached.
    """

    def __init__(self, task: Task, reward: str, like: Tensor):
        self.horizon, self.period = task.control_steps, task.control_period
        terms = task.objective.terms
        if reward == "dense":
            terms = tuple(dataclasses.replace(term, begin=0.0, end=math.inf) for term in terms)
        path: Any = Path([k * self.period for k in range(self.horizon + 1)], [], torch.empty(0))
        self._terms = [shared(term, path) for term in terms if term.adds_up]
        self.wholes = [(term, term.window(path).start + 1) for term in terms if not term.adds_up]
        self.total = self._added = self._whole = like.new_zeros(like.shape[0])

    def begin(self, worlds: Tensor, state: State, activation: Tensor, goal: Tensor | None) -> None:
        """Begin new episodes.

        Args:
            worlds: Which worlds, shape (world,).
            state: Initial state of every world.
            activation: Gives the shape (world, muscle).
            goal: Goal of each world [m], shape (world, dim), or None.
        """
        path = Path([0.0, self.period], [state, state], torch.zeros_like(activation)[None], goal)
        first = self._sum(activation, [(term, first) for term, first, _ in self._terms], path)
        self._added, self.total = (torch.where(worlds, first, one) for one in (self._added, self.total))

    def add(self, step: Step, motions: list[tuple[Tensor, Path]]) -> Tensor:
        """Cost of a control step, shape (world,), 0 of worlds that do not take part. Differentiable.

        Args:
            motions: With this step, of :meth:`softmpm_learn.gym.motions.Motions.add`; only :attr:`wholes` need them.
        """
        before, device = step.count - step.moving, step.activation.device
        cost = self._cost(step, before)
        if step.failed.any():
            cost = cost + torch.where(torch.as_tensor(step.failed, device=device), self._standing(step), 0.0)
        cost = torch.where(torch.as_tensor(step.moving, device=device), cost, 0.0)
        going = torch.as_tensor(before > 0, device=device)
        earlier = torch.where(going, self._whole, 0.0) if before.any() else torch.zeros_like(self._whole)
        self._added, self._whole = self._added + cost.detach(), self._value(motions)
        self.total = self._added + self._whole.detach()
        return cost + (self._whole - earlier)

    def _cost(self, step: Step, before: np.ndarray) -> Tensor:
        """Contribution of the terms that add up, shape (world,)."""
        path = Path([0.0, self.period], [step.before, step.after], step.activation[None], step.goal)
        return self._sum(step.activation, [(term, share[before]) for term, _, share in self._terms], path)

    def _standing(self, step: Step) -> Tensor:
        """Their contribution after the step if a world stands still until the horizon, shape (world,)."""
        nothing = torch.zeros_like(step.activation)
        path = Path([0.0, self.period], [step.after, step.after], nothing[None], step.goal)
        left = [(term, np.array([share[k:].sum() for k in step.count])) for term, _, share in self._terms]
        return self._sum(step.activation, left, path)

    def _sum(self, like: Tensor, shares: list[tuple[Term, Any]], path: Path) -> Tensor:
        total = like.new_zeros(like.shape[0])
        for term, share in shares:
            if np.any(share):
                factor = torch.as_tensor(term.weight * np.asarray(share), device=like.device).to(like.dtype)
                total = total + factor * _finite(term, path)
        return total

    def _value(self, motions: list[tuple[Tensor, Path]]) -> Tensor:
        """Value of the terms that do not add up, of the motions so far, shape (world,)."""
        total = torch.zeros_like(self._added)
        for worlds, path in motions:
            for term, states in self.wholes:
                if len(path.states) >= states:
                    value = term.weight * _finite(term, path)
                    total = total.index_add(0, worlds, value.to(total.dtype))
        return total

    def detach(self) -> None:
        """Cut the gradient."""
        self._whole = self._whole.detach()


def _finite(term: Term, path: Path) -> Tensor:
    """Value of the term, shape (world,).

    Raises:
        ValueError: It is infinite or no number: so would be a reward, and with it all parameters of a policy that learns from it.
    """
    value = term.value_of_each_world(path)
    wrong = value[~value.isfinite()]
    if len(wrong) > 0:
        raise ValueError(
            f"the value of the objective's term {term.name} must be finite after each control step, for which an environment gives "
            f"a reward, got {wrong[0].item()} on a motion of {len(path.activation)} control step(s), {path.times[-1]:g} s; "
            "return a finite number for the first part of an episode too, such as 0 where it is too short for the value."
        )
    return value
