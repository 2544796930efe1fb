"""Environments that are given something that does not fit: a sentence, and no reward."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from softmpm_learn.gym import EnvConf, SoftRobotEnv
from softmpm_learn.objective import Objective, Path, Term
from softmpm_learn.tasks import ArmConf, make_task


@pytest.mark.parametrize("declared", ["states", None])
def test_a_value_that_is_not_one_number_for_each_world(declared):
    """It is refused in the reward too, as a share of each step and as a value of the whole motion."""

    @dataclass(frozen=True, kw_only=True)
    class Broad(Term):
        adds_up = declared

        def value(self, path: Path) -> torch.Tensor:
            return path.x.mean()

    task = dataclasses.replace(make_task(ArmConf(seconds=0.05)), objective=Objective(Broad()))
    env = SoftRobotEnv(task, EnvConf(device="cpu"))

    def one_step():
        env.reset()
        env.step(np.zeros(6))

    with pytest.raises(
        ValueError, match=r"term broad must be a tensor of shape \(world,\) = \(1,\).* got \(\);"
    ):
        one_step()
