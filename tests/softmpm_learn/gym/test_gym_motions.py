"""Terms that need the whole of an episode, in environments: constraints, and terms of one's own that do not say how they add up."""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from softmpm_learn.episode import run_episode
from softmpm_learn.gym import EnvConf, SoftRobotEnv, SoftRobotVectorEnv
from softmpm_learn.objective import AtMost, Effort, Objective, Progress, Term
from softmpm_learn.objective import Path as Motion
from softmpm_learn.observe import Nothing

PAGE = (Path(__file__).parents[3] / "docs" / "learning.md").read_text()
(EXAMPLE,) = (code for code in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "class Spread" in code)
KINDS = ["dense", "objective"]
DOUBLE = dict(device="cpu", dtype="float64")


@dataclass(frozen=True, kw_only=True)
class Highest(Term):
    """Largest mean height [m]."""

    def value(self, path):
        return path.x[self.window(path)][..., 1].mean(dim=-1).amax(dim=0)


@dataclass(frozen=True, kw_only=True)
class Final(Term):
    """Squared distance of the last mean position from a place, or from the goal of the world [m²]."""

    def value(self, path):
        goal = path.x.new_tensor([0.6, 0.3]) if path.goal is None else path.goal
        return (path.x[self.window(path)][-1].mean(dim=-2) - goal).square().sum(dim=-1)


@dataclass(frozen=True, kw_only=True)
class Swing(Term):
    """Variance of the mean height over time [m²], which is no number for a single state."""

    def value(self, path):
        height = path.x[self.window(path)][..., 1].mean(dim=-1)
        return (height - height.mean(dim=0)).square().sum(dim=0) / (len(height) - 1)


def constraint(**changes) -> Term:
    """The constraint of docs/learning.md with a limit that a block exceeds."""
    names: dict = {}
    exec(EXAMPLE, names)
    (found,) = (term for term in names["objective"].terms if isinstance(term, AtMost))
    return dataclasses.replace(found, most=0.01, **changes)


def objective(period: float) -> Objective:
    """Terms of all kinds, some with a window."""
    return Objective(
        Progress(begin=period),
        Effort(weight=1e-2),
        constraint(begin=2 * period, end=4 * period),
        AtMost(term=Progress(), most=-0.05, begin=2 * period),
        AtMost(term=Effort(), most=0.1),
        Highest(weight=0.3, end=3 * period),
        Final(begin=3 * period),
    )


@pytest.fixture
def whole(task):
    return dataclasses.replace(task, objective=objective(task.control_period))


def loss_of(env, rows: torch.Tensor, goal=None, **changes) -> torch.Tensor:
    """The learner's loss of each world under these activations, shape (world,). Differentiable."""
    worlds, steps = env.worlds, iter(rows)
    task = dataclasses.replace(worlds.task, **changes)
    episode = run_episode(
        task, worlds.model, Nothing(), lambda *_: next(steps), worlds.params, start=worlds.origin, goal=goal
    )
    return episode.loss


def activations(*shape: int, seed: int = 0) -> torch.Tensor:
    return 2 * torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("worlds", [None, 3])
def test_the_loss_of_an_episode_is_the_learners(whole, kind, worlds):
    """Term by term, in float64, of one environment and of many, also in their second episodes. The rewards of a term that does not
    add up are minus all of it, or of it without its window."""
    rows = activations(2, whole.control_steps, worlds or 1, 2)
    for term in whole.objective.terms:
        alone = dataclasses.replace(whole, objective=Objective(term))
        conf = EnvConf(reward=kind, kick=0.1, **DOUBLE)
        env = SoftRobotEnv(alone, conf) if worlds is None else SoftRobotVectorEnv(alone, worlds, conf)
        total = 0.0
        for episode in range(2):
            env.reset(seed=episode)
            results = [
                env.step(np.squeeze(row.numpy(), 0) if worlds is None else row.numpy())
                for row in rows[episode]
            ]
            with torch.no_grad():
                want = loss_of(env, rows[episode])
            np.testing.assert_allclose(results[-1][4]["loss"], want, rtol=1e-12, atol=1e-15)
            if not term.adds_up:
                if kind == "dense":
                    free = Objective(dataclasses.replace(term, begin=0.0, end=np.inf))
                    with torch.no_grad():
                        want = loss_of(env, rows[episode], objective=free)
                total = sum(result[1] for result in results)
                np.testing.assert_allclose(total, -want, rtol=1e-12, atol=1e-15)
                assert want.abs().min() > 1e-6


def test_goals_are_those_of_the_worlds(task):
    """A term sees the goal of each world."""
    own = dataclasses.replace(task, objective=Objective(Final()))
    env = SoftRobotVectorEnv(own, 2, EnvConf(goal_spread=(0.1, 0.1), **DOUBLE))
    env.reset(seed=0)
    rows = activations(task.control_steps, 2, 2)
    results = [env.step(row.numpy()) for row in rows]
    with torch.no_grad():
        want = loss_of(env, rows, goal=env.worlds.goal)
    np.testing.assert_allclose(results[-1][4]["loss"], want, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("worlds", [None, 2])
def test_the_gradient_of_the_rewards_is_minus_that_of_the_loss(task, kind, worlds):
    """In float64, of terms that do not add up; central differences of the rewards agree. A second episode needs no graph of the
    first."""
    terms = [AtMost(term=Progress(), most=-0.05), constraint(), Highest(weight=0.3), Final()]
    own = dataclasses.replace(task, objective=Objective(*terms))
    conf = EnvConf(reward=kind, **DOUBLE)
    env = SoftRobotEnv(own, conf) if worlds is None else SoftRobotVectorEnv(own, worlds, conf)
    rows = activations(task.control_steps, *env.action_space.shape).requires_grad_()
    way = activations(*rows.shape, seed=1)

    def total(rows: torch.Tensor) -> torch.Tensor:
        env.reset(seed=0)
        return torch.stack([env.step_torch(row)[1].sum() for row in rows]).sum()

    for _ in range(2):
        (gradient,) = torch.autograd.grad(total(rows), rows)
    (want,) = torch.autograd.grad(loss_of(env, rows.view(task.control_steps, -1, 2)).sum(), rows)
    torch.testing.assert_close(gradient, -want, rtol=1e-9, atol=1e-12)
    h = 1e-6
    with torch.no_grad():
        ahead, behind = (total(rows + s * h * way) for s in (1, -1))
    assert float((gradient * way).sum()) == pytest.approx(float(ahead - behind) / (2 * h), rel=1e-6)


def test_detach_cuts_the_gradient_of_the_motion(whole):
    """No reward after it depends on an action before it."""
    env = SoftRobotEnv(whole, EnvConf(reward="objective", **DOUBLE))
    env.reset()
    rows = activations(whole.control_steps, 2).requires_grad_()
    rewards = []
    for step, row in enumerate(rows):
        if step == 3:
            env.detach()
        rewards.append(env.step_torch(row)[1])
    (gradient,) = torch.autograd.grad(torch.stack(rewards[3:]).sum(), rows)
    assert not gradient[:3].any() and gradient[3:].any(dim=1).all()


@pytest.mark.parametrize("kind", KINDS)
def test_motions_begin_at_different_times(whole, kind):
    """A world that is reset while the other goes on has the rewards and the losses of a single environment."""
    conf = EnvConf(reward=kind, kick=0.1, goal_spread=(0.1, 0.1), **DOUBLE)
    env, single = (
        SoftRobotVectorEnv(whole, 2, conf, autoreset_mode="Disabled"),
        [SoftRobotEnv(whole, conf) for _ in range(2)],
    )
    env.reset(seed=0)
    for k, one in enumerate(single):
        one.reset(seed=k)
    for step, row in enumerate(activations(3 * whole.control_steps, 2, 2).numpy()):
        again = env.terminated | env.truncated | np.array([False, step == 2])
        if again.any():
            env.reset(options={"reset_mask": again})
            for k in np.flatnonzero(again):
                single[k].reset()
        _, reward, _, ended, info = env.step(row)
        for k, one in enumerate(single):
            want = one.step(row[k])
            assert reward[k] == pytest.approx(want[1], rel=1e-10, abs=1e-14)
            if ended[k]:
                assert info["loss"][k] == pytest.approx(want[4]["loss"], rel=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_the_motion_of_a_failed_world_stands_still_until_the_horizon(task, make_block, kind):
    """The loss is that of the motion so far and its last posture, without velocity and activation, for the steps that are left."""
    muscles = [dataclasses.replace(muscle, strength=290.0) for muscle in task.scene.muscles]
    seen = []

    @dataclass(frozen=True, kw_only=True)
    class Seen(Final):
        def value(self, path: Motion):
            seen.append(path)
            return super().value(path)

    own = dataclasses.replace(task, scene=make_block(muscles=muscles), objective=Objective(Seen()))
    env = SoftRobotVectorEnv(own, 2, EnvConf(reward=kind, **DOUBLE), autoreset_mode="SameStep")
    env.reset(seed=0)
    total = np.zeros(2)
    for row in ([[0.0, 0.0], [0.0, 0.0]], [[1.0, 1.0], [0.0, 0.0]]):
        _, reward, terminated, _, info = env.step(np.array(row))
        total += reward
    assert terminated.tolist() == [True, False]
    (path,) = (path for path in seen[-2:] if len(path.states) == task.control_steps + 1)
    torch.testing.assert_close(path.x[2:], path.x[2].expand_as(path.x[2:]), rtol=0.0, atol=0.0)
    assert (
        path.x.shape[1] == 1
        and not path.v[2:].any()
        and path.activation[1].all()
        and not path.activation[2:].any()
    )
    assert total[0] == pytest.approx(-info["final_info"]["loss"][0], rel=1e-12)
    assert len(env.worlds._motions._made) == 2  # those of the other world
    _, reward, *_ = env.step(np.zeros((2, 2)))
    (fresh,) = (path for path in seen[-2:] if len(path.states) == 2)
    torch.testing.assert_close(fresh.states[0].x, env.worlds.model.rest().x[:1])


@pytest.mark.parametrize("reward", KINDS)
def test_a_value_that_is_no_number_for_a_part_is_refused(task, reward):
    """A reward that is no number would make those of the policy none: the error names the term and the part of the episode."""
    own = dataclasses.replace(task, objective=Objective(Progress(), Swing(begin=task.control_period)))
    env = SoftRobotEnv(own, EnvConf(reward=reward, **DOUBLE))
    env.reset()
    message = r"term swing must be finite after each control step.*got nan on a motion of 1 control step\(s\).*return a finite number"
    with pytest.raises(ValueError, match=message):
        env.step(np.zeros(2))


def test_motions_are_stored_only_for_terms_that_need_them(task, whole):
    """Not for the tasks of the package; and no longer than the longest episode."""
    assert SoftRobotEnv(task, EnvConf(**DOUBLE)).worlds._motions is None
    env = SoftRobotVectorEnv(whole, 2, EnvConf(**DOUBLE))
    env.reset()
    for row in activations(2 * whole.control_steps, 2, 2).numpy():
        env.step(row)
        assert len(env.worlds._motions._made) == env.worlds.steps.max()
    env.reset()
    assert not env.worlds._motions._made
