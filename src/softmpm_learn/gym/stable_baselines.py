"""Our vectorised worlds as the ``VecEnv`` of Stable-Baselines3."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from softmpm_learn.gym.vector import SoftRobotVectorEnv


class StableBaselinesVecEnv(VecEnv):
    """Adapter for Stable-Baselines3, whose environments reset themselves in the last step of an episode.

    Args:
        env: An environment in the mode ``SameStep``.

    Example:
        >>> env = StableBaselinesVecEnv(make_vec("arm", num_envs=8, autoreset_mode="SameStep"))
        >>> PPO("MlpPolicy", VecMonitor(env)).learn(10_000)
    """

    def __init__(self, env: SoftRobotVectorEnv):
        if not isinstance(env, SoftRobotVectorEnv):
            raise TypeError(
                f"StableBaselinesVecEnv takes the environment of make_vec itself, got {type(env).__name__}; wrap the adapter, as in "
                "VecMonitor(StableBaselinesVecEnv(env))."
            )
        if env.mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"Stable-Baselines3 needs autoreset_mode='SameStep', got {env.mode.value!r}; give it to make_vec."
            )
        self.env = env
        self._actions: np.ndarray | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """First observations, with the seeds of ``seed()``."""
        observation, _ = self.env.reset(seed=self._seeds)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step all worlds; ``terminal_observation`` and ``TimeLimit.truncated`` are in the infos of episodes that ended."""
        assert self._actions is not None
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(ended):
            final = {key: value for key, value in info["final_info"].items() if not key.startswith("_")}
            infos[world] = {key: value[world] for key, value in final.items() if value[world] is not None}
            infos[world]["terminal_observation"] = info["final_obs"][world]
            infos[world]["TimeLimit.truncated"] = bool(truncated[world])
        return observation, reward, ended, infos

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Picture of each world."""
        return self.env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices=None) -> list[Any]:
        """The attribute of the vector environment, for each index: the worlds have none of their own."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices=None) -> None:
        """Worlds have no attributes of their own."""
        raise NotImplementedError("the worlds of one model share all attributes; set them when it is made.")

    def env_method(self, method_name: str, *method_args, indices=None, **method_kwargs) -> list[Any]:
        """Worlds have no methods of their own."""
        raise NotImplementedError(f"the worlds of one model have no method {method_name} of their own.")

    def env_is_wrapped(self, wrapper_class, indices=None) -> list[bool]:
        """Worlds are not wrapped."""
        return [False for _ in self._get_indices(indices)]
