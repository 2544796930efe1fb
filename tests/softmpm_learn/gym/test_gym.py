"""Tasks as gymnasium environments: the interface, the agreement of worlds with single environments, rewards and gradients."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv

import softmpm
import softmpm_learn.gym
from softmpm_learn.episode import run_episode
from softmpm_learn.gym import EnvConf, SoftRobotEnv, SoftRobotVectorEnv, make, make_vec
from softmpm_learn.gym.picture import picture
from softmpm_learn.objective import Path as Motion
from softmpm_learn.observe import Centroids
from softmpm_learn.register import TASKS

ROOT = Path(__file__).parents[3]
SHORT = dict(seconds=0.05, device="cpu")
"""Four control steps."""
UNBOUNDED = "ignore:.*A Box observation space m..imum value is -?infinity"


def actions(env, steps: int, seed: int = 0) -> np.ndarray:
    """Random actions, shape (step, world, muscle)."""
    shape = steps, env.num_envs, *env.single_action_space.shape
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)


class Replayed(torch.nn.Module):
    """A policy that returns given activations, one control step after the other."""

    def __init__(self, rows: torch.Tensor):
        super().__init__()
        self.rows = iter(rows)

    def forward(self, z, time, goal):
        return next(self.rows)


@pytest.mark.filterwarnings(UNBOUNDED)
@pytest.mark.parametrize("name", ["elephant", "arm", "biped"])
def test_the_interface_is_that_of_gymnasium(name):
    """gymnasium's own checker finds nothing but the infinite range of the observations; pictures are drawn."""
    env = make(name, kick=0.05, **SHORT)
    assert env.spec is not None and env.spec.id == f"softmpm/{name.capitalize()}-v0"
    check_env(env)
    assert isinstance(gymnasium.make(env.spec.id, **SHORT).unwrapped, SoftRobotEnv)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    ("name", "settings"), [("arm", {"goal_spread": (0.1, 0.05)}), ("biped", {"formulation": "reference"})]
)
def test_worlds_equal_single_environments(name, settings, mode):
    """Over three episodes, observations and ends are those of gymnasium's SyncVectorEnv of single environments, to the last bit, and
    rewards to rounding."""
    settings = settings | SHORT | {"kick": 0.1}
    ours = make_vec(name, 3, autoreset_mode=mode, **settings)
    theirs = SyncVectorEnv([lambda: make(name, **settings)] * 3, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"].value == mode
    assert ours.single_observation_space == theirs.single_observation_space
    for got, want in zip(ours.reset(seed=3)[0], theirs.reset(seed=3)[0], strict=True):
        np.testing.assert_array_equal(got, want)
    for row in actions(ours, 14):
        got, want = ours.step(row), theirs.step(row)
        for place in (0, 2, 3):
            np.testing.assert_array_equal(got[place], want[place])
        np.testing.assert_allclose(
            got[1], want[1], rtol=1e-6, atol=1e-9
        )  # a sum over particles in another order
        assert got[4].keys() == want[4].keys()
        if mode == "SameStep" and "final_obs" in got[4]:
            np.testing.assert_array_equal(np.stack(got[4]["final_obs"]), np.stack(want[4]["final_obs"]))
            np.testing.assert_allclose(
                got[4]["final_info"]["loss"], want[4]["final_info"]["loss"], rtol=1e-5, atol=1e-8
            )


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_episodes_may_begin_at_different_times(formulation):
    """A world that is reset while the other goes on equals a single environment, with surface points and nodes of its own."""
    settings = SHORT | {"kick": 0.2, "formulation": formulation, "seconds": 0.1}
    env = make_vec("biped", 2, autoreset_mode="Disabled", **settings)
    single = [make("biped", **settings) for _ in range(2)]
    env.reset(seed=0)
    for k, one in enumerate(single):
        one.reset(seed=k)
    for step, row in enumerate(actions(env, 6)):
        if step == 2:
            first, _ = env.reset(options={"reset_mask": np.array([False, True])})
            np.testing.assert_array_equal(first[1], single[1].reset()[0])
        observation, reward, *_ = env.step(row)
        for k, one in enumerate(single):
            want = one.step(row[k])
            np.testing.assert_array_equal(observation[k], want[0])
            assert reward[k] == pytest.approx(want[1], rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("reward", ["objective", "dense"])
@pytest.mark.parametrize("name", ["arm", "biped"])
def test_the_rewards_add_up_to_the_objective(name, reward):
    """Their sum is minus what the steps of an episode add to the objective, with or without its windows; the info has the learner's
    loss."""
    late = {"hold": 0.025} if name == "arm" else {}
    env = make(name, reward=reward, **SHORT, **late)
    worlds = env.worlds
    rows = np.random.default_rng(1).uniform(-1.0, 1.0, (4, worlds.model.muscle_count)).astype(np.float32)
    env.reset(seed=0)
    results = [env.step(row) for row in rows]
    frames, terms = [], worlds.task.objective.terms
    with torch.no_grad():
        policy = Replayed(torch.as_tensor(rows)[:, None])
        episode = run_episode(
            worlds.task, worlds.model, worlds.observer, policy, worlds.params, on_frame=frames.append
        )
    states, activation = [frame.state for frame in frames], torch.as_tensor(rows)[:, None]
    path = Motion([frame.time for frame in frames], states, activation)
    if reward == "dense":
        terms = [dataclasses.replace(term, begin=0.0) for term in terms]
    want = sum(term.weight * float(term.value(path)) for term in terms)
    for term in terms:  # the first state belongs to no step
        if term.adds_up == "states" and term.begin == 0.0:
            alone = dataclasses.replace(term, end=0.0)
            want -= term.weight * float(alone.value(path)) / len(states)
    assert sum(result[1] for result in results) == pytest.approx(-want, rel=1e-5, abs=1e-7)
    assert [result[3] for result in results] == [False, False, False, True]
    assert results[-1][4]["loss"] == pytest.approx(float(episode.loss), rel=1e-4, abs=1e-7)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        env.step(rows[0])


def test_seeds_decide_kicks_and_goals():
    """The same seed gives the same first observations, also of later episodes; kicks have the given size and goals fill their box."""
    env = make_vec("arm", 200, kick=0.1, goal_spread=(0.1, 0.0), **SHORT)
    first, _ = env.reset(seed=5)
    second, _ = env.reset()
    again, _ = env.reset(seed=5)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(second, env.reset()[0])
    assert np.abs(first - second).max() > 0.1
    goal, velocity = second[:, -2:], env.worlds.shown.v[:, 0]
    assert goal[:, 0].min() < -0.9 and goal[:, 0].max() > 0.9 and not goal[:, 1].any()
    assert velocity.std().item() == pytest.approx(0.1, rel=0.2)
    assert not make("arm", **SHORT).reset(seed=1)[0].any()  # at rest without a kick


@pytest.mark.parametrize(("seed", "problem"), [(np.int64(0), "python integer"), ([], "one number or 2")])
def test_what_is_no_seed_is_refused(seed, problem):
    """A number that a single environment refuses, or an empty list, does not count as no seed."""
    with pytest.raises((gymnasium.error.Error, ValueError), match=problem):
        make_vec("arm", 2, **SHORT).reset(seed=seed)


def total_return(env, rows: torch.Tensor) -> torch.Tensor:
    """Weighted sum of all observations and rewards of an episode from the beginning."""
    env.reset(seed=0)
    total = rows.new_zeros(())
    for row in rows:
        observation, reward = env.step_torch(row)
        weight = torch.linspace(0.5, 1.5, observation.numel(), dtype=rows.dtype)
        total = total + reward.sum() + 0.1 * weight @ observation.flatten()
    return total


@pytest.mark.parametrize("kind", ["dense", "objective"])
@pytest.mark.parametrize("worlds", [None, 2])
def test_the_gradient_of_a_step(task, kind, worlds):
    """In float64, step_torch agrees with central differences of rewards and observations through an episode, and with step."""
    conf = EnvConf(device="cpu", dtype="float64", reward=kind, kick=0.05)
    env = SoftRobotEnv(task, conf) if worlds is None else SoftRobotVectorEnv(task, worlds, conf)
    generator = torch.Generator().manual_seed(0)
    rows, way = torch.rand(2, 4, *env.action_space.shape, dtype=torch.float64, generator=generator)
    rows.requires_grad_()
    (gradient,) = torch.autograd.grad(total_return(env, rows), rows)
    assert (gradient.flatten(1).norm(dim=1) > 0).all()
    h = 1e-6
    with torch.no_grad():
        ahead, behind = (total_return(env, rows + s * h * way) for s in (1, -1))
    assert float((gradient * way).sum()) == pytest.approx(float(ahead - behind) / (2 * h), rel=1e-6)
    env.reset(seed=0)
    first = env.step_torch(rows[0])
    env.reset(seed=0)
    for got, want in zip(env.step(rows[0].detach().numpy())[:2], first, strict=True):
        np.testing.assert_array_equal(got, want.detach().numpy())


def test_windows_and_episodes_cut_the_gradient(task):
    """After detach no gradient reaches earlier actions; neither does it from the next episode of the same world."""
    env = SoftRobotVectorEnv(task, 2, EnvConf(device="cpu"))
    env.reset(seed=0)
    rows = (0.5 * torch.ones(task.control_steps + 2, 2, 2)).requires_grad_()
    env.step_torch(rows[0])
    env.detach()
    for row in rows[1 : task.control_steps]:
        observation, _ = env.step_torch(row)
    (gradient,) = torch.autograd.grad(observation.sum(), rows, retain_graph=True)
    assert not gradient[0].any() and gradient[1].any()
    assert env.truncated.all()
    for row in rows[task.control_steps :]:
        observation, _ = env.step_torch(row)
    (gradient,) = torch.autograd.grad(observation.sum(), rows)
    assert not gradient[:-1].any() and gradient[-1].any()


def test_pictures_show_the_robot():
    """One per world; the robot, its activation and the goal are in them."""
    env = make_vec("arm", 2, render_mode="rgb_array", goal_spread=(0.1, 0.1), **SHORT)
    env.reset(seed=0)
    before = env.render()
    env.step(np.stack([np.zeros(6), np.ones(6)]))
    after = env.render()
    assert before is not None and after is not None and len(after) == 2
    assert after[0].shape == (320, 480, 3) and after[0].dtype == np.uint8
    changed = [np.mean(one != two) for one, two in zip(before, after, strict=True)]
    assert changed[0] < 1e-3 < 0.01 < changed[1]
    assert (before[0] != before[1]).any()  # their goals


@pytest.mark.parametrize("dim", [2, 3])
def test_the_picture_follows_the_robot(dim):
    """On a track of 3 m a block of 0.3 m takes a third of the width, in the middle and above the floor; where it has moved, it is at
    the same place of the picture, and the lines are not."""
    low, high = (0.3, 0.1, 0.1), (0.6, 0.25, 0.3)
    block = softmpm.box(low[:dim], high[:dim], 0.02)
    muscle = softmpm.Muscle(particles=np.arange(len(block)), direction=(1.0, 0.0, 0.0)[:dim], strength=1.0)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(76, 21, 11)[:dim], spacing=0.04),
        bodies=[softmpm.Body(block, softmpm.NeoHookean(density=1.0, young=10.0))],
        muscles=[muscle],
        walls=[softmpm.Wall(normal=(0.0, 1.0, 0.0)[:dim], offset=0.1)],
        dt=1e-3,
    )
    shown, found = [], []
    for moved in (0.0, 1.037):
        x = block.positions + np.eye(dim)[0] * moved
        shown.append(picture(scene, x, np.ones(1), None).astype(int))
        rows, columns = np.nonzero(shown[-1][..., 0] - shown[-1][..., 2] > 100)
        found.append((rows.min(), rows.max(), columns.min(), columns.max()))
    top, bottom, left, right = found[0]
    assert shown[0].shape == (320, 480, 3) and np.abs(np.subtract(*found)).max() <= 1
    assert right - left == pytest.approx(160, rel=0.1) and (left + right) / 2 == pytest.approx(240, abs=3)
    assert bottom == pytest.approx(0.8 * 320, abs=4) and bottom - top == pytest.approx(80, rel=0.15)
    sky = [image[5] for image in shown]
    assert np.any(sky[0] != sky[1])


def test_the_picture_of_a_robot_in_3d_shows_its_near_side():
    """Of two muscles, one behind the other, the near one, also where its particles come first."""
    block = softmpm.box((0.3, 0.1, 0.1), (0.6, 0.25, 0.3), 0.02)
    block = softmpm.Particles(block.positions[::-1], block.volume[::-1])
    near = block.positions[:, 2] > 0.2
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(30, 21, 11), spacing=0.04),
        bodies=[softmpm.Body(block, softmpm.NeoHookean(density=1.0, young=10.0))],
        muscles=[
            softmpm.Muscle(particles=np.flatnonzero(side), direction=(1.0, 0.0, 0.0), strength=1.0)
            for side in (near, ~near)
        ],
        dt=1e-3,
    )
    image = picture(scene, block.positions, np.array([1.0, -1.0]), None).astype(int)
    red_over_blue = image[..., 0] - image[..., 2]
    assert (red_over_blue > 100).sum() > 5000 and (red_over_blue < -100).sum() == 0


def test_any_observer_takes_the_place_of_the_centroids():
    """An environment observes what the given observer computes."""
    env = make("arm", observer=lambda task, model: Centroids(model, [np.arange(5)], 1.0), **SHORT)
    assert env.observation_space.shape == env.reset()[0].shape == (4,)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sceonds": 1.0}, "there is no setting sceonds; known are render_mode, observer, reward"),
        ({"reward": "sparse"}, "reward must be one of dense, objective"),
        ({"kick": -1.0}, "kick must be ≥ 0, got -1"),
        ({"goal_spread": 0.05}, r"goal_spread must be a list of lengths .* such as \[0.05, 0.05\], got 0.05"),
        ({"goal_spread": (0.1, -0.1)}, r"goal_spread must be a list of lengths .* got \[0.1, -0.1\]"),
        ({"dtype": "float16"}, "dtype must be 'float32' or 'float64'"),
        ({"render_mode": "human"}, "render_mode must be one of rgb_array or None"),
        ({"goal_spread": (0.1, 0.1)}, "goal_spread needs a task with a goal"),
    ],
)
def test_a_wrong_setting_says_what_must_hold(settings, message):
    """Settings are checked where they are made."""
    with pytest.raises(ValueError, match=message):
        softmpm_learn.gym.registration.make_single("biped", **(SHORT | settings))


@pytest.mark.parametrize("worlds", [None, 2])
def test_a_wrong_action_says_what_must_hold(worlds):
    """The shape in the message is the one to pass, of one environment and of many; step_torch takes tensors."""
    env = make("arm", **SHORT) if worlds is None else make_vec("arm", worlds, **SHORT)
    env.reset()
    shape = (6,) if worlds is None else (2, 6)
    text = re.escape(f"the action must have shape {shape}, that of action_space, got (3,).")
    with pytest.raises(ValueError, match=text):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match=text):
        env.step_torch(torch.zeros(3))
    with pytest.raises(TypeError, match=r"step_torch takes a torch.Tensor, got ndarray; step takes arrays"):
        env.step_torch(np.zeros(shape))
    with pytest.raises(TypeError, match="the action must be an array of real numbers, got 'pull'"):
        env.step("pull")
    env.step(np.zeros(shape))
    env.step_torch(torch.zeros(shape))


def test_two_tasks_have_two_names(monkeypatch):
    """In gymnasium's registry a task may have the name of another one, whose robot is not given instead."""
    entry = TASKS["arm"]
    monkeypatch.setitem(TASKS._entries, "ARM", entry)
    with pytest.raises(ValueError, match="tasks 'arm' and 'ARM' are both softmpm/Arm-v0 in gymnasium"):
        make("ARM")


def test_a_wrong_autoreset_mode_is_answered_with_the_modes():
    """Their names are those of gymnasium."""
    with pytest.raises(ValueError, match="one of NextStep, SameStep, Disabled, got 'same'"):
        make_vec("arm", 2, autoreset_mode="same", **SHORT)


def test_the_learner_needs_no_gymnasium():
    """Every module outside of the package ``gym`` is imported without gymnasium and the libraries of reinforcement learning."""
    root = ROOT / "src" / "softmpm_learn"
    paths = [path.relative_to(root.parent).with_suffix("") for path in root.rglob("*.py")]
    names = [".".join(path.parts) for path in paths if "gym" not in path.parts]
    absent = dict.fromkeys(("gymnasium", "stable_baselines3", "skrl"))
    names = [name for name in names if not name.endswith("__main__")]
    code = f"import sys, importlib\nsys.modules.update({absent})\nfor name in {names}: importlib.import_module(name)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT / "src", timeout=120)


def test_the_sentence_of_the_page_silences_warp():
    """A program that follows docs/gym.md prints no module that Warp loads; one that does not prints many."""
    (line,) = re.findall(r"`import warp as wp` and `(.*?)`", (ROOT / "docs" / "gym.md").read_text())
    code = (
        "import softmpm_learn.gym\n"
        f"env = softmpm_learn.gym.make('arm', **{SHORT})\nenv.reset()\nenv.step(env.action_space.sample())"
    )
    loud, quiet = (
        subprocess.run([sys.executable, "-c", f"{first}\n{code}"], check=True, capture_output=True, text=True)
        for first in ("", f"import warp as wp\n{line}")
    )
    assert "Module" in loud.stdout and "Module" not in quiet.stdout + quiet.stderr


def test_the_code_of_the_page_runs():
    """Each example of docs/gym.md runs alone and does what it says: the last one improves its return."""
    for code in re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "gym.md").read_text(), re.DOTALL):
        names: dict = {}
        exec(code, names)
    assert names["returns"][-1] > names["returns"][0]
