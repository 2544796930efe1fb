"""Closed-loop simulation: observe → act → simulate in each control step, differentiable end to end."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

import softmpm
from softmpm import Inputs, Model, Params, State
from softmpm_learn.fading import Fading
from softmpm_learn.likeness import alike
from softmpm_learn.observe import Observer
from softmpm_learn.tasks.task import Task
from softmpm_learn.term import Path
from softmpm_learn.unchanged import need_unchanged, versions

Policy = Callable[[Tensor, Tensor, Tensor | None], Tensor]
"""Features, time and goal to activation, see :class:`softmpm_learn.policy.Space`."""


@dataclass(frozen=True)
class Frame:
    """One control step as it begins, for a recorder; the last frame of an episode has no activation."""

    time: float
    """Time since the episode began [s]."""
    state: State
    features: Tensor
    """Features that the observer computed, shape (world, size)."""
    activation: Tensor | None
    """Activation during the step [-], shape (world, muscle)."""

    def detach(self) -> "Frame":
        """The frame without its history."""
        activation = None if self.activation is None else self.activation.detach()
        return replace(
            self, state=self.state.detach(), features=self.features.detach(), activation=activation
        )


@dataclass(frozen=True)
class Episode:
    """One simulation of every world."""

    terms: dict[str, Tensor]
    """Terms of the objective by their names, shape (world,) each. Differentiable."""
    end: State
    observations: Tensor | None
    """Observations at regular control steps, shape (frame, world, ...), detached; None if not requested."""
    activation: Tensor
    """Activations during the control steps [-], shape (step, world, muscle), detached."""
    decisions: "Decisions"
    path: Path | None
    """The motion. Differentiable; None in :meth:`detach`."""

    @property
    def loss(self) -> Tensor:
        """The sum of the terms, shape (world,)."""
        return torch.stack(list(self.terms.values())).sum(dim=0)

    def detach(self) -> "Episode":
        """The episode without its autograd graph, the decisions and the motion."""
        terms = {name: term.detach() for name, term in self.terms.items()}
        return replace(self, terms=terms, end=self.end.detach(), decisions=Decisions(), path=None)


@dataclass(frozen=True)
class Decisions:
    """Inputs and outputs of the policy, one tensor for each control step."""

    features: list[Tensor] = field(default_factory=list)
    """Features that it received, each of shape (world, size)."""
    activations: list[Tensor] = field(default_factory=list)
    """Activations that it returned [-], each of shape (world, muscle). Differentiable."""


def run_episode(
    task: Task,
    model: Model,
    observer: Observer,
    policy: Policy,
    params: Params,
    *,
    inputs: Inputs | None = None,
    goal: Tensor | None = None,
    start: State | None = None,
    fade: float | Tensor = math.inf,
    keep_every: int = 0,
    on_frame: Callable[[Frame], None] | None = None,
    failures: softmpm.Failures | None = None,
) -> Episode:
    """Simulate a task under a policy. Under ``torch.no_grad`` it keeps nothing for a gradient.

    Args:
        params, inputs: Material of the robot and what else is not the scene's, see :class:`softmpm_learn.design.Design`.
        goal: Goal of each world [m], shape (world, dim), where it is not the task's own.
        start: Initial state, None for rest.
        fade: Time constant with which gradients fade on their way through the states [s], or that of each world, shape (world,), see
            :mod:`softmpm_learn.fading`.
        keep_every: Control steps between two stored observations, 0 for none.
        on_frame: Called at every control step and at the end.
        failures: Collects the failures of worlds, while the others go on; None raises the first. A world that failed has no
            activation from then on, or it would fail again and again.

    Raises:
        ValueError: The model is of another scene, parameters or buffers of the observer or the policy have another precision than the
            model, or the observer or a term works in place.
        softmpm.UnstableError: With a note that names the control step, as those have that are collected or met in a backward pass.
    """
    need_scene_of(task, model)
    _check_precision(model, observer=observer, policy=policy)
    state = model.rest() if start is None else start
    period, times = task.control_period, times_of(task, model)
    made, states, observations, fading = Decisions(), [state], [], Fading(fade, period)
    for step in range(task.control_steps):
        with softmpm.noted(note_of(step, task)):
            before = versions(state[:4])
            observation = observer.observe(model, state)
            need_unchanged(
                f"the observer {type(observer).__name__}", "the state", before, versions(state[:4])
            )
            if keep_every and step % keep_every == 0:
                observations.append(observation.detach())
            features = observer.encode(observation)
            activation = policy(features, times[step], goal)
            _need_finite(activation, failures)
            if failures:
                failed = torch.tensor(failures.worlds, device=activation.device)
                activation = activation.index_fill(0, failed, 0.0)
            if on_frame:
                on_frame(Frame(step * period, state, features, activation))
            state = softmpm.simulate(
                model,
                state,
                activation[None],
                params,
                substeps=task.substeps,
                inputs=inputs,
                failures=failures,
            )
        made.features.append(features)
        made.activations.append(activation)
        state, seen = fading(state)
        states.append(seen)
    if on_frame:
        with torch.no_grad():
            on_frame(Frame(task.control_steps * period, state, observer(model, state), None))
    activations = torch.stack(made.activations)
    path = Path([period * k for k in range(len(states))], states, activations, goal)
    return Episode(
        terms=task.objective(path),
        end=state,
        observations=torch.stack(observations) if observations else None,
        activation=activations.detach(),
        decisions=made,
        path=path,
    )


def _need_finite(activation: Tensor, failures: softmpm.Failures | None) -> None:
    """A policy whose activations are not finite has failed in these worlds, as a robot has that tears. In a captured graph, where
    nothing can be read, the robot itself fails."""
    if activation.is_cuda and torch.cuda.is_current_stream_capturing():
        return
    bad = (~activation.detach().isfinite()).any(dim=-1).nonzero()[:, 0].tolist()
    errors = [
        _not_finite(activation, world) for world in bad if failures is None or world not in failures.worlds
    ]
    if failures is not None:
        failures.errors += errors
    elif errors:
        raise errors[0]


def _not_finite(activation: Tensor, world: int) -> softmpm.UnstableError:
    values, limit = activation.detach()[world].tolist(), "activations must be finite"
    muscle = next(k for k, value in enumerate(values) if not math.isfinite(value))
    return softmpm.UnstableError(
        f"the policy gives an activation of {values[muscle]} for muscle {muscle} of world {world}; {limit}. Look at the policy, or "
        "take smaller learning rates.",
        kind="activation",
        world=world,
        particle=-1,
        substep=0,
        value=values[muscle],
        limit=limit,
    )


def _check_precision(model: Model, **parts: Policy | Observer) -> None:
    """Raise ValueError unless the real parameters and buffers of these parts, where they are modules, have the model's precision."""
    for what, part in parts.items():
        tensors = [*part.parameters(), *part.buffers()] if isinstance(part, nn.Module) else []
        for tensor in tensors:
            if tensor.is_floating_point() and tensor.dtype != model.dtype:
                raise ValueError(
                    f"the {what} must be {model.dtype} like the model, has {tensor.dtype}; use {what}.to({model.dtype}), or build the "
                    "model with another dtype, as run.model_of does for a run."
                )


def need_scene_of(task: Task, model: Model) -> None:
    """Raise ValueError unless a model is of the task's scene: everything in it was read when the model was built."""
    if not alike(model.scene, task.scene):
        raise ValueError(
            f"the model was built from another scene than that of task {task.name}; build it from this one, with "
            "softmpm.build(task.scene, **task.build), or with run.model_of(task, worlds) where there is a run."
        )


def need_model_of(task: Task, model: Model) -> None:
    """Raise ValueError unless a model is of the task's scene, with its formulation and its contact."""
    need_scene_of(task, model)
    got = {"formulation": model.formulation, "contact": "nodes" if model.surface is None else "surface"}
    got |= {"contact_width": model.contact_width}
    wanted = {name: task.build[name] for name in got if name in task.build}
    other = [name for name, value in wanted.items() if got[name] != value]
    if other:
        raise ValueError(
            f"task {task.name} has {other[0]}={wanted[other[0]]!r}, but the model has {got[other[0]]!r}; build it with "
            "softmpm.build(task.scene, **task.build)."
        )


def kicked(state: State, kicks: Tensor) -> State:
    """A start of each world with so much more speed along the first axis [m/s], shape (world,)."""
    v = state.v.clone()
    v[..., 0] += kicks[:, None]
    return state._replace(v=v)


def note_of(step: int, task: Task) -> str:
    """Note of the errors of a control step, for :func:`softmpm.noted`."""
    return (
        f"In control step {step} of {task.control_steps}, which began at {step * task.control_period:.4g} s."
    )


def times_of(task: Task, model: Model) -> Tensor:
    """Time at which each control step begins [s], shape (step,)."""
    return task.control_period * torch.arange(task.control_steps, dtype=model.dtype, device=model.device)
