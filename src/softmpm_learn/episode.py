"""Observe → act → simulate, again and again, differentiable end to end: one closed-loop simulation."""

from collections.abc import Callable
from dataclasses import dataclass, replace
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
    effort: Tensor
    """Mean square of the activation [-], shape (), detached."""

    @property
    def loss(self) -> Tensor:
        """Final loss and running cost together, shape (world,)."""
        return self.final + self.running

    def detach(self) -> "Episode":
        end = State(*(tensor.detach() for tensor in self.end))
        return replace(self, final=self.final.detach(), running=self.running.detach(), end=end)


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
        effort=effort / task.control_steps,
    )


class ClosedLoop:
    """Simulates a task under a policy and differentiates the loss, again and again; on a GPU as one recorded graph.

    Args:
        parameters: What the gradient is taken of.
        params: Gives the materials, see :class:`softmpm_learn.design.Design`.
        keep_every: As in :func:`run_episode`.
    """

    def __init__(
        self,
        task: "Task",
        model: Model,
        observer: Observer,
        policy: nn.Module,
        params: Callable[[], Params],
        parameters: list[nn.Parameter],
        keep_every: int = 0,
    ):
        self.task, self.model, self.observer, self.policy = task, model, observer, policy
        self.params, self.parameters, self.keep_every = params, parameters, keep_every
        self._goal: Tensor | None = None
        self._graph = softmpm.Graph(self._work, model.device)

    def __call__(
        self, goal: Tensor | None, on_frame: Callable[[Frame], None] | None = None
    ) -> tuple[Episode, tuple[Tensor, ...]]:
        """The episode, detached, and the gradient of its mean loss; overwritten by the next call. A film is not replayed.

        Raises:
            softmpm.UnstableError: As :func:`run_episode`.
        """
        if goal is not None:
            self._goal = goal.clone() if self._goal is None else self._goal.copy_(goal)
        return self._work(on_frame) if on_frame else self._graph()

    def _work(self, on_frame=None) -> tuple[Episode, tuple[Tensor, ...]]:
        episode = run_episode(
            self.task,
            self.model,
            self.observer,
            self.policy,
            self.params(),
            goal=self._goal,
            keep_every=self.keep_every,
            on_frame=on_frame,
        )
        return episode.detach(), torch.autograd.grad(episode.loss.mean(), self.parameters)
