"""Environments that are given something that does not fit: a sentence, and no reward."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from softmpm_learn.gym import EnvConf, SoftRobotEnv, make, make_vec
from softmpm_learn.objective import Effort, Objective, Path, Progress, Term
from softmpm_learn.observe import Observer
from softmpm_learn.tasks import ArmConf, make_task

SHORT = dict(seconds=0.05, device="cpu")


@pytest.mark.parametrize("declared", ["states", None])
def test_a_value_that_is_not_one_number_for_each_world(declared):
    """It is refused by environments too, as a share of each step and as a value of the whole motion."""

    @dataclass(frozen=True, kw_only=True)
    class Broad(Term):
        adds_up = declared

        def value(self, path: Path) -> torch.Tensor:
            return path.x.mean()

    task = dataclasses.replace(make_task(ArmConf(seconds=0.05)), objective=Objective(Broad()))

    def one_step():
        env = SoftRobotEnv(task, EnvConf(device="cpu"))
        env.reset()
        env.step(np.zeros(6))

    with pytest.raises(
        ValueError, match=r"term broad must be a tensor of shape \(world,\) = \(1,\).* got \(\);"
    ):
        one_step()


@dataclass(frozen=True, kw_only=True)
class Farthest(Term):
    """The largest distance of the mean position from the first wall, of all states: no mean over them."""

    adds_up = "states"

    def value(self, path: Path) -> torch.Tensor:
        return path.x[self.window(path)].mean(dim=2)[..., 0].amax(dim=0)


@dataclass(frozen=True, kw_only=True)
class Jumps(Term):
    """Changes of the activation from step to step: none in a single one."""

    adds_up = "steps"

    def value(self, path: Path) -> torch.Tensor:
        activation = path.activation[self.steps(path)]
        return (activation[1:] - activation[:-1]).square().mean(dim=-1).sum(dim=0)


@dataclass(frozen=True, kw_only=True)
class Speed(Progress):
    """A mean speed, which is no sum of those of the steps."""

    adds_up = "way"

    def value(self, path: Path) -> torch.Tensor:
        return super().value(path) / (path.times[-1] - path.times[0])


@pytest.mark.parametrize("term", [Farthest, Jumps, Speed])
def test_a_term_that_does_not_add_up_as_it_says(term):
    """It would give another return than minus the loss; without the declaration it is accepted."""
    task = dataclasses.replace(
        make_task(ArmConf(seconds=0.05)), objective=Objective(Effort(), term(begin=0.02))
    )
    with pytest.raises(
        ValueError, match=f"{term.__name__} says adds_up = '{term.adds_up}', but its value in a"
    ):
        SoftRobotEnv(task, EnvConf(device="cpu"))

    class Whole(term):
        adds_up = None

    task = dataclasses.replace(task, objective=Objective(Effort(), Whole(begin=0.02)))
    SoftRobotEnv(task, EnvConf(device="cpu"))


@dataclass(frozen=True, kw_only=True)
class Height(Term):
    """Logarithm of the height above one kilometre, which is no number below."""

    adds_up = "states"

    def value(self, path: Path) -> torch.Tensor:
        return (path.x[self.window(path)].mean(dim=2)[..., 0] - 1e3).log().mean(dim=0)


def test_a_term_whose_sum_is_no_number():
    """Nobody can tell if it adds up."""
    task = dataclasses.replace(make_task(ArmConf(seconds=0.05)), objective=Objective(Height()))
    with pytest.raises(ValueError, match="term height must be finite after each control step.*got nan"):
        SoftRobotEnv(task, EnvConf(device="cpu"))


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
    """What is not in the observation space is refused when the environment is made."""

    class Place(Observer):
        size = 3

        def observe(self, model, state):
            return state.x.mean(dim=1)

        def encode(self, observation):
            return observation

    with pytest.raises(ValueError, match=r"features of shape \(world, size\) = \(1, 3\), got \(1, 2\)"):
        make("arm", observer=lambda task, model: Place(), **SHORT)


@pytest.mark.parametrize(
    "word", [dict(max_episode_steps=3), dict(disable_env_checker=True), dict(vectorization_mode="sync")]
)
def test_words_of_gymnasium_are_not_ours(word):
    """Its wrappers would be taken off again, so that the word would do nothing."""
    for build in (make, make_vec):
        with pytest.raises(
            ValueError, match=f"there is no setting {next(iter(word))}; known are render_mode"
        ):
            build("arm", **SHORT, **word)


def test_the_seed_of_a_vector_is_that_of_its_wrappers():
    """They draw from np_random, as of a single environment."""
    env, drawn = make_vec("arm", 2, **SHORT), []
    for seed in (0, 0, [0, 7]):
        env.reset(seed=seed)
        drawn.append(env.np_random.uniform())
    assert drawn == [np.random.default_rng(0).uniform()] * 3 and env.np_random_seed == 0
    env.reset()
    assert env.np_random.uniform() != drawn[0]


def test_an_ignored_action_may_be_anything():
    """In the step after an episode a world ignores its action: the others go on."""
    env = make_vec("arm", 2, **(SHORT | dict(seconds=0.05)), autoreset_mode="NextStep")
    env.reset(seed=0)
    actions, ended = np.zeros((2, env.single_action_space.shape[0])), np.array([True, False])
    env.step(actions)
    env.terminated = ended
    actions[0] = np.nan
    _, reward, *_ = env.step(actions)
    assert reward[0] == 0 and np.isfinite(reward).all()


def test_modes_of_the_caller_are_not_those_of_an_environment():
    """Observations are as without autocast; one that was made in inference mode has gradients later."""
    plain = make("arm", **SHORT)
    with torch.inference_mode():
        env = make("arm", **SHORT)
        env.reset(seed=0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = [one.step(np.full(one.action_space.shape, 0.3)) for one in (env, plain) if one.reset(seed=0)]
        env.reset(seed=0)
        action = torch.full(env.action_space.shape, 0.3, requires_grad=True)
        observation, reward = env.step_torch(action)
    plain.reset(seed=0)
    want = plain.step(np.full(plain.action_space.shape, 0.3))[0]
    assert all(np.array_equal(one[0], want) for one in found)
    np.testing.assert_allclose(observation.detach().numpy(), want, rtol=1e-6)
    assert torch.autograd.grad(reward, action)[0].isfinite().all()
