"""Episodes of a task in the worlds of one model, each with a clock of its own: reset, step, observation and reward.

The reward of a control step is minus what it adds to the objective, with or without its windows of time (rewards.py). A world that
fails ends its episode and is charged as if it stood still in its last posture until the horizon, without velocity and activation: a bad
posture is paid for, later effort is not.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

import softmpm
from softmpm import Failures, Inputs, Model, Params, State, UnstableError
from softmpm_learn.gym.motions import Motions, Step
from softmpm_learn.gym.rewards import REWARDS, Costs, check_sums
from softmpm_learn.modes import plain_operations
from softmpm_learn.observe import Centroids, Observer
from softmpm_learn.observer_check import check_observer
from softmpm_learn.setting_checks import lengths
from softmpm_learn.tasks import Task

Tree = TypeVar("Tree")


@dataclass(frozen=True, kw_only=True)
class EnvConf:
    """Settings of an environment besides those of its task."""

    observer: Callable[[Task, Model], Observer] | None = None
    """Builds the observer; None takes the centroids of the task's regions."""
    reward: Literal["dense", "objective"] = "dense"
    """dense: the objective without its windows of time, so that every step counts. objective: as the learner counts it, the sum over an
    episode being minus the loss, but for what the first state adds. ``info["loss"]`` is the learner's loss in both."""
    kick: float = 0.0
    """Standard deviation of each component of the robot's velocity when an episode begins [m/s]; 0 starts at rest."""
    goal_spread: Sequence[float] = ()
    """Half widths [m] of the box around the task's goal from which each episode draws its own; empty: fixed goal."""
    body: tuple[Params, Inputs] | None = None
    """Material and inputs of the robot, such as ``run.design()`` of a run from :func:`softmpm_learn.load`; None are the scene's. They
    have no gradient."""
    device: str | None = None
    """Device of the simulation, None for CUDA if there is one."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision of the simulation, of the observations and of the actions."""

    def __post_init__(self):
        if self.reward not in REWARDS:
            raise ValueError(f"reward must be one of {', '.join(REWARDS)}, got {self.reward!r}.")
        if self.dtype not in ("float32", "float64"):
            raise ValueError(f"dtype must be 'float32' or 'float64', got {self.dtype!r}.")
        if not (math.isfinite(self.kick) and self.kick >= 0):
            raise ValueError(f"kick must be ≥ 0, got {self.kick}.")
        lengths("goal_spread", self.goal_spread)
        body: Any = self.body
        parts = [type(part) for part in body] if type(body) is tuple else None
        if not (body is None or parts == [Params, Inputs]):
            kind = type(body).__name__
            got = kind if parts is None else f"{kind} of {', '.join(part.__name__ for part in parts)}"
            raise TypeError(
                f"body must be a pair of softmpm.Params and softmpm.Inputs, such as (params, softmpm.Inputs()), got {got}."
            )


class Outcome(NamedTuple):
    """Result of one control step of every world."""

    observation: Tensor
    """Observation after it, shape (world, size). Differentiable."""
    reward: Tensor
    """Reward, shape (world,). Differentiable."""
    terminated: np.ndarray
    """Worlds whose simulation failed, shape (world,)."""
    truncated: np.ndarray
    """Worlds that reached the horizon, shape (world,)."""
    failures: dict[int, UnstableError]
    """Failures by world."""

    @property
    def ended(self) -> np.ndarray:
        """Worlds whose episode ended, shape (world,)."""
        return self.terminated | self.truncated


class Worlds:
    """Episodes of a task in ``count`` worlds.

    Attributes:
        model: Model of all worlds.
        size: Numbers in an observation.
        params: Material, read in every step; shapes that broadcast to (world, particle).
        inputs: Inputs, read in every step: those of ``conf.body``, for which the model was built.
        state: State after the last step, that of :func:`softmpm.contact_forces`; ``shown`` has the particles after a reset too.
    """

    @torch.inference_mode(False)  # in which all that is made could have no gradient later
    @plain_operations()
    def __init__(self, task: Task, count: int, conf: EnvConf):
        self.task, self.count, self.conf = task, count, conf
        dtype = torch.float64 if conf.dtype == "float64" else torch.float32
        inputs = {} if conf.body is None else conf.body[1]._asdict()
        self.model = softmpm.build(
            task.scene,
            device=conf.device,
            dtype=dtype,
            worlds=count,
            calls=task.control_steps,
            inputs=[name for name, value in inputs.items() if value is not None],
            **task.build,
        )
        params, place = self.model.params() if conf.body is None else conf.body[0], self.model.device
        self.params = Params(*(value.detach().to(place) for value in params))
        self.inputs = Inputs(**{k: v.detach().to(place) for k, v in inputs.items() if v is not None})
        self.observer = (conf.observer or centroids)(task, self.model)
        check_observer(self.observer, self.model)
        self._spread = self._tensor(self._checked_spread())
        self._centre = self._tensor([] if task.goal is None else task.goal)
        self.goal = self._centre.expand(count, -1).clone() if len(self._spread) else None
        self.size = self.observer.size + len(self._spread)
        self.origin: State = self.model.rest()
        self.state: State = self.model.rest()
        self.steps = np.zeros(count, dtype=int)
        self.activation = self._tensor(np.zeros((count, self.model.muscle_count)))
        self._fresh = np.ones(count, dtype=bool)
        check_sums(task, self.origin, self.activation, self.goal)
        self._costs = {reward: Costs(task, reward, self.activation) for reward in ("objective", conf.reward)}
        self._motions = Motions(task) if self._costs["objective"].wholes else None

    def _checked_spread(self) -> list[float]:
        spread = list(self.conf.goal_spread)
        if spread and (self.task.goal is None or len(spread) != self.model.dim):
            raise ValueError(
                f"goal_spread needs a task with a goal and {self.model.dim} lengths; "
                f"task {self.task.name} has goal {self.task.goal}, goal_spread is {spread}."
            )
        return spread

    def _tensor(self, values: Any) -> Tensor:
        return torch.as_tensor(np.asarray(values), device=self.model.device).to(self.model.dtype)

    @torch.inference_mode(False)
    def begin(self, worlds: np.ndarray, generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes.

        Args:
            worlds: Which worlds, shape (world,).
            generators: Of each world, for its kick and its goal.
        """
        if not worlds.any():
            return
        dim = self.model.dim
        kicks, goals = np.zeros((self.count, 1, dim)), np.zeros((self.count, dim))
        for world in np.flatnonzero(worlds).tolist():
            kicks[world] = self.conf.kick * generators[world].standard_normal(dim)
            goals[world] = generators[world].uniform(-1.0, 1.0, dim)
        mask = self._mask(worlds)
        velocity = self._tensor(kicks).expand_as(self.origin.v)
        self.origin = self.origin._replace(v=select(mask, velocity, self.origin.v))
        if self.goal is not None:
            self.goal = select(mask, self._centre + self._spread * self._tensor(goals), self.goal)
        self.steps = np.where(worlds, 0, self.steps)
        self._fresh = self._fresh | worlds
        self.activation = select(mask, torch.zeros_like(self.activation), self.activation)
        for costs in self._costs.values():
            costs.begin(mask, self.origin, self.activation, self.goal)
        if self._motions:
            self._motions.trim(self.steps)

    @property
    def loss(self) -> Tensor:
        """Loss of the episode so far, as the learner defines it, shape (world,), detached; of a complete episode it is the ``loss`` of
        a gradient-based run."""
        return self._costs["objective"].total

    def observe(self) -> Tensor:
        """Features and, if it is drawn at random, the goal in [-1, 1] along each axis of its box; shape (world, size)."""
        with plain_operations():
            features = self.observer(self.model, self.shown)
        if self.goal is None:
            return features
        inverse = torch.where(self._spread > 0, 1 / self._spread, 0.0)
        return torch.cat([features, (self.goal - self._centre) * inverse], dim=-1)

    @property
    def shown(self) -> State:
        """Particles of every world as they are now."""
        mask, first, now = self._mask(self._fresh), self.origin, self.state
        if not self._fresh.any():
            return State(now.x, now.v, now.C, now.F)
        if self._fresh.all():  # without the graph of the episodes before
            return State(first.x, first.v, first.C, first.F)
        x, v, C, F = (select(mask, one, two) for one, two in zip(first[:4], now[:4], strict=True))
        return State(x, v, C, F)

    @plain_operations()
    def step(self, activation: Tensor, moving: np.ndarray | None = None) -> Outcome:
        """One control step.

        Args:
            activation: Activation [-], shape (world, muscle). Differentiable.
            moving: Worlds that take part, shape (world,); the others have just begun and stay as they are, with a reward of 0.
        """
        moving = np.ones(self.count, dtype=bool) if moving is None else moving
        activation = select(self._mask(moving), activation, torch.zeros_like(activation))
        before = self.shown
        failures = self._simulate(activation, moving) if moving.any() else {}
        failed = np.array([world in failures for world in range(self.count)])
        self.activation = select(self._mask(moving), activation.detach(), self.activation)
        self.steps = self.steps + moving
        reward = self._reward(before, activation, moving, failed)
        truncated = moving & ~failed & (self.steps >= self.task.control_steps)
        return Outcome(self.observe(), reward, failed, truncated, failures)

    def _simulate(self, activation: Tensor, moving: np.ndarray) -> dict[int, UnstableError]:
        """Advance the worlds that move. Episodes that begin and episodes that go on take a launch each: only the state of the latter
        has surface points and nodes."""
        found = {}
        for group, start in ((moving & ~self._fresh, self.state), (moving & self._fresh, self.origin)):
            if not group.any():
                continue
            mask, failures = self._mask(group), Failures("freeze")
            driven = select(mask, activation, torch.zeros_like(activation))
            end = softmpm.simulate(
                self.model,
                start,
                driven[None],
                self.params,
                substeps=self.task.substeps,
                inputs=self.inputs,
                failures=failures,
            )
            others = bool((~group & ~self._fresh).any())
            self.state = select(mask, end, self.state) if others else end
            for error in failures.errors:
                if group[error.world]:
                    found.setdefault(error.world, error)
        self._fresh = self._fresh & ~moving
        return found

    def _reward(self, before: State, activation: Tensor, moving: np.ndarray, failed: np.ndarray) -> Tensor:
        """Reward of the step that has just been made, which also adds to the loss."""
        after = self.shown
        if failed.any():
            after = select(self._mask(failed), at_rest(after), after)
        step = Step(before, after, activation, self.goal, self.steps, moving, failed)
        motions = self._motions.add(step) if self._motions else []
        cost = {reward: costs.add(step, motions) for reward, costs in self._costs.items()}
        return -cost[self.conf.reward]

    def _mask(self, worlds: np.ndarray) -> Tensor:
        return torch.as_tensor(worlds, device=self.model.device)

    def detach(self) -> None:
        """Cut the gradient: later steps do not differentiate through earlier ones."""
        self.state = self.state.detach()
        for costs in self._costs.values():
            costs.detach()
        if self._motions:
            self._motions.detach()


def at_rest(state: State) -> State:
    """The state without its velocities."""
    return state._replace(v=torch.zeros_like(state.v), C=torch.zeros_like(state.C))


def centroids(task: Task, model: Model) -> Observer:
    """Position and velocity of each region of the task."""
    return Centroids(model, list(task.regions.values()), task.body_length)


def select(mask: Tensor, chosen: Tree, other: Tree) -> Tree:
    """Rows of ``chosen`` in the worlds of ``mask`` and of ``other`` elsewhere, of tensors or of named tuples of them."""
    if isinstance(chosen, Tensor):
        return torch.where(mask.view(-1, *(1,) * (chosen.ndim - 1)), chosen, other)  # type: ignore[return-value]
    if chosen is None:
        return chosen
    pairs = zip(chosen, other, strict=True)  # type: ignore[call-overload]
    return type(chosen)(*(select(mask, one, two) for one, two in pairs))  # type: ignore[return-value]
