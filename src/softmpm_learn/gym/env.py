"""One robot as a gymnasium environment."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from torch import Tensor

from softmpm import UnstableError
from softmpm_learn.gym.picture import picture
from softmpm_learn.gym.worlds import EnvConf, Worlds
from softmpm_learn.tasks import Task

RENDER_MODES = ["rgb_array"]


class SoftRobotEnv(gymnasium.Env):
    """A task in one world.

    An action is the activation of each muscle, clipped to [-1, 1]: 1 contracts with the full strength, as where a policy of
    :mod:`softmpm_learn.policy` ends. An observation has the observer's features, in no fixed range, and where goals are drawn at random
    the goal, from -1 to 1 across its box; not the time. :attr:`EnvConf.reward` says what the reward is. An episode is truncated after
    ``task.control_steps`` steps and terminated if the simulation fails; the last ``info`` has the ``loss`` of the episode and after a
    failure its kind as ``failure`` and its ``message``.

    Args:
        task: What to simulate, from :func:`softmpm_learn.tasks.make_task`.
        conf: Settings of the environment.
        render_mode: "rgb_array", or None for no pictures.

    Attributes:
        terminated, truncated: Flags of the last step, for users of :meth:`step_torch`.
        worlds: The simulation; its ``params`` and ``inputs`` may be replaced when an episode begins (docs/gym.md).
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES}  # noqa: RUF012  (gymnasium's own declaration)

    def __init__(self, task: Task, conf: EnvConf | None = None, render_mode: str | None = None):
        self.worlds = Worlds(task, 1, conf or EnvConf())
        self.observation_space, self.action_space = spaces(self.worlds)
        self.metadata, self.render_mode = metadata_of(task, render_mode), render_mode
        self.terminated = self.truncated = False
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode. ``options`` are not used."""
        super().reset(seed=seed)
        with torch.no_grad():
            self.worlds.begin(np.ones(1, dtype=bool), [self.np_random])
            observation = self.worlds.observe()
        self.terminated = self.truncated = False
        self._begun = True
        return array(observation[0]), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step, without a gradient."""
        with torch.no_grad():
            observation, reward, info = self._advance(tensor(self.worlds, action).clamp(-1.0, 1.0))
        return array(observation), float(reward), self.terminated, self.truncated, info

    def step_torch(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """One control step with its gradient; see :attr:`terminated` and :attr:`truncated` for the end of the episode.

        Args:
            action: Activation [-], shape (muscle,), on the device of the model; not clipped. Differentiable.

        Returns:
            Observation, shape (size,), and reward, shape (). Both are differentiable in all actions since the last :meth:`detach` or
            the beginning of the episode.
        """
        return self._advance(action)[:2]

    def _advance(self, action: Tensor) -> tuple[Tensor, Tensor, dict[str, Any]]:
        if not self._begun or self.terminated or self.truncated:
            raise ResetNeeded("the episode has not begun or has ended; call reset() before the next step.")
        need_action(action, self.action_space.shape)
        outcome = self.worlds.step(action[None])
        self.terminated, self.truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        info = ending(self.worlds, 0, outcome.failures.get(0)) if outcome.ended[0] else {}
        return outcome.observation[0], outcome.reward[0], info

    def detach(self) -> None:
        """Cut the gradient between two windows of :meth:`step_torch`."""
        self.worlds.detach()

    def render(self) -> np.ndarray | None:
        """Picture of the robot, shape (height, width, 3), None without a render mode."""
        return render(self.worlds, 0) if self.render_mode else None


def spaces(worlds: Worlds) -> tuple[Box, Box]:
    """Observation and action space of one world."""
    kind = np.dtype(worlds.conf.dtype).type
    observation = Box(-np.inf, np.inf, (worlds.size,), kind)
    return observation, Box(-1.0, 1.0, (worlds.model.muscle_count,), kind)


def metadata_of(task: Task, render_mode: str | None) -> dict[str, Any]:
    """Metadata of an environment.

    Raises:
        ValueError: The render mode is not known.
    """
    if render_mode not in (None, *RENDER_MODES):
        raise ValueError(
            f"render_mode must be one of {', '.join(RENDER_MODES)} or None, got {render_mode!r}."
        )
    return {"render_modes": list(RENDER_MODES), "render_fps": round(1 / task.control_period)}


def ending(worlds: Worlds, world: int, error: UnstableError | None) -> dict[str, Any]:
    """Info of the last step of an episode."""
    info: dict[str, Any] = {"loss": float(worlds.loss[world])}
    return info if error is None else info | {"failure": error.kind, "message": str(error)}


def render(worlds: Worlds, world: int) -> np.ndarray:
    """Picture of one world."""
    goal = worlds.task.goal if worlds.goal is None else array(worlds.goal[world])
    x, activation = worlds.shown.x[world], worlds.activation[world]
    return picture(worlds.task.scene, array(x), array(activation), goal)


def tensor(worlds: Worlds, action: Any) -> Tensor:
    """Actions on the device of the model, in its precision."""
    values = np.asarray(action)
    if values.dtype.kind not in "biuf":
        raise TypeError(f"the action must be an array of real numbers, got {action!r}.")
    return torch.as_tensor(values, device=worlds.model.device).to(worlds.model.dtype)


def need_action(action: Any, shape: tuple[int, ...] | None) -> None:
    """Raise TypeError unless it is a tensor, and ValueError unless it has this shape, that of the action space."""
    if not isinstance(action, Tensor):
        raise TypeError(
            f"step_torch takes a torch.Tensor, got {type(action).__name__}; step takes arrays, without a gradient."
        )
    if action.shape != shape:
        raise ValueError(
            f"the action must have shape {shape}, that of action_space, got {tuple(action.shape)}."
        )


def array(values: Tensor) -> np.ndarray:
    """An array that shares no memory with the tensor."""
    return values.detach().cpu().numpy().copy()
