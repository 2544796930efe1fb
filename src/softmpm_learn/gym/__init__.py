"""Tasks as gymnasium environments; importing this package registers ``softmpm/Elephant-v0`` and the others (docs/gym.md).

    env = softmpm_learn.gym.make("elephant", seconds=0.5)
    envs = softmpm_learn.gym.make_vec("elephant", num_envs=32)

It needs the packages of the extra ``rl``; nothing else of the learner does. :mod:`softmpm_learn.gym.stable_baselines` is imported
separately.
"""

from softmpm_learn.gym.env import SoftRobotEnv
from softmpm_learn.gym.registration import make, make_vec, register
from softmpm_learn.gym.vector import SoftRobotVectorEnv
from softmpm_learn.gym.worlds import EnvConf

__all__ = ["EnvConf", "SoftRobotEnv", "SoftRobotVectorEnv", "make", "make_vec"]

register()
