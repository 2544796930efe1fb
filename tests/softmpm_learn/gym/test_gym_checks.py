"""Environments that are given something that does not fit: a sentence, and no reward."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from softmpm_learn.gym import EnvConf, SoftRobotEnv, make
from softmpm_learn.objective import Objective, Path, Term
from softmpm_learn.observe import Observer
from softmpm_learn.tasks import ArmConf, make_task

SHORT = dict(seconds=0.05, device="cpu")


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


def test_a_body_is_material_and_inputs():
    """The material alone is refused when the settings are made."""
    params = make("arm", **SHORT).worlds.params
    with pytest.raises(
        TypeError, match=r"body must be a pair of softmpm.Params and softmpm.Inputs.*got Params"
    ):
        make("arm", body=params, **SHORT)
    with pytest.raises(TypeError, match=r"body must be a pair .*got tuple of Params, NoneType"):
        make("arm", body=(params, None), **SHORT)


def test_an_observer_of_another_size():
    """An observation that is not in the observation space is refused at the first reset."""

    class Place(Observer):
        size = 3

        def observe(self, model, state):
            return state.x.mean(dim=1)

        def encode(self, observation):
            return observation

    env = make("arm", observer=lambda task, model: Place(), **SHORT)
    with pytest.raises(ValueError, match=r"features of shape \(world, size\) = \(1, 3\), got \(1, 2\)"):
        env.reset()
