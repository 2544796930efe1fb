"""Many robots as one gymnasium environment: the worlds of one model, advanced by one launch."""

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from softmpm_learn.gym.env import array, ending, metadata_of, need_action, render, spaces, tensor
from softmpm_learn.gym.worlds import EnvConf, Outcome, Worlds
from softmpm_learn.tasks import Task


class SoftRobotVectorEnv(VectorEnv):
    """A task in many worlds; spaces, rewards and ends of each are those of :class:`softmpm_learn.gym.SoftRobotEnv`.

    A world that fails ends its own episode and does not affect the others. Reset with an integer seed, world k draws as a single
    environment with ``seed + k``.

    Args:
        num_envs: Number of worlds.
        autoreset_mode: ``NextStep``: the step after the last of an episode ignores the action of that world and returns the first
            observation of the next one with a reward of 0. ``SameStep``: the last step itself returns it; ``info`` has the last one
            as ``final_obs``. ``Disabled``: call ``reset(options={"reset_mask": ended})``.

    Attributes:
        terminated, truncated: Flags of the last step, shape (num_envs,), for users of :meth:`step_torch`.
        worlds: The simulation; its ``params`` and ``inputs`` may be replaced when an episode begins (docs/gym.md).
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        conf: EnvConf | None = None,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        known = [mode.value for mode in AutoresetMode]
        if autoreset_mode not in (*AutoresetMode, *known):
            raise ValueError(f"autoreset_mode must be one of {', '.join(known)}, got {autoreset_mode!r}.")
        self.mode = AutoresetMode(autoreset_mode)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.worlds = Worlds(task, num_envs, conf or EnvConf())
        self.metadata = metadata_of(task, render_mode) | {"autoreset_mode": self.mode}
        self.single_observation_space, self.single_action_space = spaces(self.worlds)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.terminated = self.truncated = np.zeros(num_envs, dtype=bool)
        self._generators: list[np.random.Generator] = []

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in every world, or in those of ``options["reset_mask"]``, shape (num_envs,)."""
        mask = np.ones(self.num_envs, dtype=bool)
        if options and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(
                f"reset_mask must be {self.num_envs} booleans, got {mask.dtype} of shape {mask.shape}."
            )
        self._seed(seed, mask)
        with torch.no_grad():
            self.worlds.begin(mask, self._generators)
            observation = self.worlds.observe()
        self.terminated, self.truncated = self.terminated & ~mask, self.truncated & ~mask
        return array(observation), {}

    def _seed(self, seed: int | Sequence[int | None] | None, mask: np.ndarray) -> None:
        """New generators for the worlds of the mask that have a seed, and for all if there are none yet."""
        count = self.num_envs
        seeds: Any = [None] * count if seed is None else seed
        seeds = [seeds + k for k in range(count)] if isinstance(seeds, Integral) else list(seeds)
        if seeds and seeds[0] is not None:
            super().reset(seed=seeds[0])  # np_random, which wrappers draw from
        if len(seeds) != count:
            raise ValueError(f"seed must be one number or {count}, got {len(seeds)}.")
        if not self._generators:
            self._generators = [np_random(one)[0] for one in seeds]
        for world in np.flatnonzero(mask):
            if seeds[world] is not None:
                self._generators[world] = np_random(seeds[world])[0]

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of every world, without a gradient; actions of shape (num_envs, muscle)."""
        with torch.no_grad():
            outcome = self._advance(tensor(self.worlds, actions).clamp(-1.0, 1.0))
            info = self._info(outcome)
            observation = outcome.observation
            if self.mode is AutoresetMode.SAME_STEP and outcome.ended.any():
                self.worlds.begin(outcome.ended, self._generators)
                observation = self.worlds.observe()
        reward = array(outcome.reward).astype(np.float64)
        return array(observation), reward, outcome.terminated, outcome.truncated, info

    def step_torch(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """One control step of every world with its gradient, in the mode ``NextStep`` or ``Disabled``; see :attr:`terminated` and
        :attr:`truncated` for the ends of episodes. No gradient passes from an episode to the one before.

        Args:
            actions: Activation [-], shape (num_envs, muscle), on the device of the model; not clipped. Differentiable.

        Returns:
            Observation, shape (num_envs, size), and reward, shape (num_envs,). Both are differentiable in all actions since the last
            :meth:`detach`.
        """
        if self.mode is AutoresetMode.SAME_STEP:
            raise ValueError(
                "step_torch has no place for the last observation of an episode in the mode SameStep; use NextStep."
            )
        outcome = self._advance(actions)
        return outcome.observation, outcome.reward

    def _advance(self, actions: Tensor) -> Outcome:
        if not self._generators:
            raise ResetNeeded("no episode has begun; call reset() before the first step.")
        need_action(actions, self.action_space.shape)
        ended = self.terminated | self.truncated
        if self.mode is AutoresetMode.DISABLED and ended.any():
            raise ResetNeeded(
                f'worlds {np.flatnonzero(ended).tolist()} have ended; call reset(options={{"reset_mask": ...}}).'
            )
        begun = ended if self.mode is AutoresetMode.NEXT_STEP else np.zeros_like(ended)
        self.worlds.begin(begun, self._generators)
        outcome = self.worlds.step(actions, ~begun)
        self.terminated, self.truncated = outcome.terminated, outcome.truncated
        return outcome._replace(terminated=outcome.terminated.copy(), truncated=outcome.truncated.copy())

    def _info(self, outcome: Outcome) -> dict[str, Any]:
        """Loss and failure of the episodes that ended, in gymnasium's form; before the next ones begin."""
        info: dict[str, Any] = {}
        for world in np.flatnonzero(outcome.ended).tolist():
            found = ending(self.worlds, world, outcome.failures.get(world))
            if self.mode is AutoresetMode.SAME_STEP:
                found = {"final_obs": array(outcome.observation[world]), "final_info": found}
            info = self._add_info(info, found, world)
        return info

    def detach(self) -> None:
        """Cut the gradient between two windows of :meth:`step_torch`."""
        self.worlds.detach()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Picture of each world, each of shape (height, width, 3); None without a render mode."""
        return tuple(render(self.worlds, k) for k in range(self.num_envs)) if self.render_mode else None
