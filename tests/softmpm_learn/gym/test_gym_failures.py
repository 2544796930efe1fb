"""Worlds of a gymnasium environment whose simulation fails: the reason, the charge, and no effect on the others."""

import dataclasses

import numpy as np
import pytest
import torch

from softmpm_learn.gym import EnvConf, SoftRobotEnv, make_vec
from softmpm_learn.objective import Effort, Low, Objective, Progress, Still

FAILING = dict(seconds=0.1, device="cpu", strength=1e5, safety=1.0)
"""An arm whose muscles are too strong for its time step as soon as they pull."""


def test_a_world_that_fails_ends_alone():
    """It is terminated with the reason and charged as if it had stood still; the others have the bits that they have beside a healthy
    world, and the next episode of the failed one is that of a new environment."""
    env, calm = (make_vec("arm", 3, kick=0.01, **FAILING) for _ in range(2))
    rows = np.zeros((8, 3, 6), dtype=np.float32)
    rows[:, 1:] = 0.003 * np.random.default_rng(0).uniform(-1.0, 1.0, (8, 2, 6))
    for one in (env, calm):
        one.reset(seed=2)
    first, total = float(env.worlds.loss[0]), 0.0
    for step, row in enumerate(rows):
        wild = row.copy()
        wild[0] = 1.0 if step == 1 else 0.0
        got, want = env.step(wild), calm.step(row)
        total += got[1][0]
        np.testing.assert_array_equal(got[0][1:], want[0][1:])
        np.testing.assert_array_equal(got[1][1:], want[1][1:])
        assert got[2].tolist() == [step == 1, False, False]
        if step == 1:
            info, value = got[4], float(env.worlds.loss[0])
            assert info["failure"][0] == "step" and "stable step" in info["message"][0]
            assert info["failure"][1] is None and info["_failure"].tolist() == [True, False, False]
            assert value == pytest.approx(first - total, rel=1e-3)
        if step == 2:
            assert got[1][0] == 0.0
            fresh = env.worlds.shown.x[0] - env.worlds.model.positions
            assert not fresh.any()


def test_a_failed_world_is_charged_until_the_horizon(task, make_block):
    """The running cost of its last state without activation counts for all steps that are left."""
    muscles = [dataclasses.replace(muscle, strength=290.0) for muscle in task.scene.muscles]
    high = dataclasses.replace(
        task,
        scene=make_block(muscles=muscles),
        objective=Objective(Progress(), Low(lowest=10.0), Effort(weight=1e-2)),
    )
    env = SoftRobotEnv(high, EnvConf(device="cpu"))
    env.reset(seed=0)
    total, costs = 0.0, [float((10.0 - env.worlds.shown.x[0, :, 1].mean()).square())]
    for pull in (0.0, 1.0):
        _, reward, terminated, _, info = env.step(np.full(2, pull))
        costs.append(float((10.0 - env.worlds.shown.x[0, :, 1].mean()).square()))
        total += reward
    assert terminated and "failure" in info
    moved = float((env.worlds.shown.x - env.worlds.model.positions)[..., 0].mean())
    steps = task.control_steps
    want = moved - (costs[1] + (steps - 1) * costs[2]) / (steps + 1) - 1e-2 / steps
    assert total == pytest.approx(want, rel=1e-6)
    assert info["loss"] == pytest.approx(costs[0] / (steps + 1) - want, rel=1e-6)


@pytest.mark.parametrize("reward", ["dense", "objective"])
def test_a_failed_world_has_no_speed(task, make_block, reward):
    """The velocity with which it fails is charged in no step, neither in the one that fails nor in those that are left."""
    muscles = [dataclasses.replace(muscle, strength=290.0) for muscle in task.scene.muscles]
    still = Objective(Still(particles=np.arange(16)))
    fast = dataclasses.replace(task, scene=make_block(muscles=muscles), objective=still)
    env = SoftRobotEnv(fast, EnvConf(device="cpu", reward=reward))
    env.reset(seed=0)
    env.step(np.full(2, 0.1))
    before = env.worlds.loss.clone()
    _, charged, terminated, _, info = env.step(np.full(2, 1.0))
    assert terminated and before > 0 and env.worlds.shown.v[0, :16].mean(dim=0).norm() > 0.1
    assert charged == 0.0 and info["loss"] == before


def test_a_failed_world_has_no_gradient():
    """The gradients of the others are finite and those that they have without it."""
    env = make_vec("arm", 2, **FAILING)
    found = []
    for wild in (1.0, 0.0):
        env.reset(seed=0)
        row = torch.full((2, 6), 0.003)
        row[0] = wild
        row.requires_grad_()
        observation, reward = env.step_torch(row)
        assert env.terminated.tolist() == [wild == 1.0, False]
        found.append(torch.autograd.grad(observation.sum() + reward.sum(), row)[0])
    assert torch.isfinite(found[0]).all()
    torch.testing.assert_close(found[0][1], found[1][1], rtol=0.0, atol=0.0)
    assert found[0][0].abs().max() < 1e-3 * found[1][0].abs().max()  # only its effort
