"""Observe → act → simulate, again and again, differentiable end to end: one closed-loop simulation."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

import softmpm
from softmpm import Model, Params, State
from softmpm_learn.observe import Observer

if TYPE_CHECKING:
    from softmpm_learn.tasks.task import Task


@dataclass(frozen=True)
class Frame:
    """One control step as it begins, for a recorder; the last frame of an episode has no activation."""

    time: float
    """Time since the episode began [s]."""
    state: State
    features: Tensor
    """What the observer made of it, shape (world, size)."""
    activation: Tensor | None
    """Activation during the step [-], shape (world, muscle)."""


@dataclass(frozen=True)
class Episode:
    """One simulation of every world."""

    final: Tensor
    """Final loss, shape (world,). Differentiable."""
    running: Tensor
    """Mean cost of the control steps, shape (world,). Differentiable."""
    end: State
    seen: Tensor | None
    """What the observer saw, every so many control steps, shape (frame, world, ...), detached; None if it was not asked for."""
    effort: float
    """Root mean square of the activation [-]."""

    @property
    def loss(self) -> Tensor:
        """Final loss and running cost together, shape (world,)."""
        return self.final + self.running


def run_episode(
    task: "Task",
    model: Model,
    observer: Observer,
    policy: nn.Module,
    params: Params,
    *,
    goal: Tensor | None = None,
    keep_every: int = 0,
    on_frame: Callable[[Frame], None] | None = None,
) -> Episode:
    """Simulate a task from rest under a policy. Under ``torch.no_grad`` it keeps nothing for a gradient.

    Args:
        params: Materials; see :class:`softmpm_learn.design.Design`.
        goal: Goal of each world [m], shape (world, dim), where it is not the task's own.
        keep_every: Control steps between two kept looks, 0 for none.
        on_frame: Called at every control step and at the end.

    Raises:
        softmpm.UnstableError: With a note that names the control step.
    """
    start = state = model.rest()
    period = task.substeps * model.scene.dt
    running, effort, seen = state.x.new_zeros(model.worlds), state.x.new_zeros(()), []
    for step in range(task.control_steps):
        look = observer.look(model, state)
        if keep_every and step % keep_every == 0:
            seen.append(look.detach())
        features = observer.encode(look)
        activation = policy(features, step * period, goal)
        if on_frame:
            on_frame(Frame(step * period, state, features, activation))
        try:
            state = softmpm.simulate(model, state, activation[None], params, substeps=task.substeps)
        except softmpm.UnstableError as error:
            when = f"which began at {step * period:.4g} s"
            error.add_note(f"In control step {step} of {task.control_steps}, {when}.")
            raise
        running = running + task.objective.running(state, activation)
        effort += activation.detach().square().mean()
    if on_frame:
        with torch.no_grad():
            on_frame(Frame(task.control_steps * period, state, observer(model, state), None))
    return Episode(
        final=task.objective.final(start, state, goal),
        running=running / task.control_steps,
        end=state,
        seen=torch.stack(seen) if seen else None,
        effort=(effort / task.control_steps).sqrt().item(),
    )
