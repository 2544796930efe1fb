"""Learning curves on the gymnasium environment: PPO of two libraries, and the gradient of the simulation on the same reward.

    python bench/reinforcement.py [--minutes 8] [--learners sb3 skrl gradient] [--picture docs/images/reinforcement.png]

The arm at the draft resolution, episodes of 0.5 s with 20 control steps. Both PPOs have 16 worlds, rollouts of two episodes, 10 epochs
of minibatches of 160 steps, networks of two layers of 64, a learning rate of 1e-3 and normalised observations; other settings are the
libraries' defaults. ``gradient`` is Adam on a network of the same size in one world, with the gradient of the return through the whole
episode (``step_torch``). A curve ends after the given minutes, that of the gradient after two. Results go to
bench/results/reinforcement.cpu.json.
"""

import argparse
import contextlib
import json
import time
from pathlib import Path

import numpy as np
import torch
from skrl.agents.torch import ppo
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

import softmpm_learn.gym
from softmpm_learn.gym import SoftRobotVectorEnv
from softmpm_learn.gym.stable_baselines import StableBaselinesVecEnv

TASK = dict(name="arm", seconds=0.5, control_period=0.025, device="cpu")
WORLDS, ROLLOUT = 16, 40
RESULTS = Path(__file__).parent / "results" / "reinforcement.cpu.json"
COLOURS = {"sb3": "#1f5f9e", "skrl": "#d9a441", "gradient": "#8f8f8f"}
LABELS = {
    "sb3": "PPO, Stable-Baselines3",
    "skrl": "PPO, skrl",
    "gradient": "gradient of the simulation, Adam",
}


class BudgetError(Exception):
    """The budget of a curve is spent."""


class Returns:
    """Return of every episode of a vector environment, in the order in which they end; the environment stops after some minutes."""

    def __init__(self, env: SoftRobotVectorEnv, minutes: float):
        self.found, self._sums = [], np.zeros(env.num_envs)
        self._end, self._step = time.monotonic() + 60 * minutes, env.step
        env.step = self._recorded

    def _recorded(self, actions):
        result = self._step(actions)
        _, reward, terminated, truncated, _ = result
        self._sums += reward
        for world in np.flatnonzero(terminated | truncated):
            self.found.append(float(self._sums[world]))
            self._sums[world] = 0.0
        if time.monotonic() > self._end:
            raise BudgetError
        return result


def train_sb3(minutes: float, steps: int = 10**9, worlds: int = WORLDS, **settings) -> list[float]:
    """Returns of the episodes of a training with PPO of Stable-Baselines3."""
    env = softmpm_learn.gym.make_vec(num_envs=worlds, autoreset_mode="SameStep", **(TASK | settings))
    returns = Returns(env, minutes)
    agent = PPO(
        "MlpPolicy",
        VecNormalize(StableBaselinesVecEnv(env)),
        n_steps=ROLLOUT,
        batch_size=ROLLOUT * worlds // 4,
        n_epochs=10,
        learning_rate=1e-3,
        policy_kwargs=dict(net_arch=[64, 64], log_std_init=-0.5),
        seed=0,
        device="cpu",
    )
    with contextlib.suppress(BudgetError):
        agent.learn(steps)
    return returns.found


class Actor(GaussianMixin, Model):
    """Gaussian policy of two layers of 64, as that of Stable-Baselines3."""

    def __init__(self, env):
        Model.__init__(
            self, observation_space=env.observation_space, action_space=env.action_space, device=env.device
        )
        GaussianMixin.__init__(self)
        self.layers = layers(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -0.5))

    def compute(self, inputs, role=""):
        return self.layers(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """Value of an observation."""

    def __init__(self, env):
        Model.__init__(
            self, observation_space=env.observation_space, action_space=env.action_space, device=env.device
        )
        DeterministicMixin.__init__(self)
        self.layers = layers(self.num_observations, 1)

    def compute(self, inputs, role=""):
        return self.layers(inputs["observations"]), {}


def layers(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers of 64; the last one starts small."""
    last = nn.Linear(64, outputs)
    nn.init.normal_(last.weight, std=0.01 / 8)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), last)


def train_skrl(minutes: float, steps: int = 10**9, worlds: int = WORLDS, **settings) -> list[float]:
    """Returns of the episodes of a training with PPO of skrl."""
    torch.manual_seed(0)
    env = softmpm_learn.gym.make_vec(num_envs=worlds, **(TASK | settings))
    returns = Returns(env, minutes)
    wrapped = wrap_env(env, wrapper="gymnasium", verbose=False)
    space = wrapped.observation_space
    cfg = ppo.PPO_CFG(
        rollouts=ROLLOUT,
        learning_epochs=10,
        mini_batches=4,
        learning_rate=1e-3,
        time_limit_bootstrap=True,
        rewards_shaper=lambda rewards, *_: 100.0 * rewards,
        observation_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs={"size": space, "device": wrapped.device},
        value_preprocessor=RunningStandardScaler,
        value_preprocessor_kwargs={"size": 1, "device": wrapped.device},
    )
    cfg.experiment.write_interval = cfg.experiment.checkpoint_interval = 0
    agent = ppo.PPO(
        models={"policy": Actor(wrapped), "value": Critic(wrapped)},
        memory=RandomMemory(memory_size=ROLLOUT, num_envs=worlds, device=wrapped.device),
        cfg=cfg,
        observation_space=space,
        action_space=wrapped.action_space,
        device=wrapped.device,
    )
    trainer = SequentialTrainer(
        cfg={
            "timesteps": steps,
            "headless": True,
            "disable_progressbar": True,
            "close_environment_at_exit": False,
        },
        env=wrapped,
        agents=agent,
    )
    with contextlib.suppress(BudgetError):
        trainer.train()
    return returns.found


def train_gradient(minutes: float, episodes: int = 10**9, **settings) -> list[float]:
    """Returns of the episodes of gradient ascent through whole episodes in one world."""
    torch.manual_seed(0)
    env = softmpm_learn.gym.make(**(TASK | settings))
    policy = nn.Sequential(layers(env.worlds.size, env.action_space.shape[0]), nn.Tanh())
    optimizer = torch.optim.Adam(policy.parameters(), lr=5e-3)
    found, end = [], time.monotonic() + 60 * minutes
    while len(found) < episodes and time.monotonic() < end:
        observation, total = torch.as_tensor(env.reset()[0]), torch.zeros(())
        while not (env.terminated or env.truncated):
            observation, reward = env.step_torch(policy(observation))
            total = total + reward
        optimizer.zero_grad()
        (-total).backward()
        optimizer.step()
        env.detach()
        found.append(total.item())
    return found


LEARNERS = {"sb3": train_sb3, "skrl": train_skrl, "gradient": train_gradient}


def draw(results: dict[str, list[float]], path: Path) -> None:
    """Returns against simulations, and their moving means."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for name, values in results.items():
        x, y = np.arange(1, len(values) + 1), np.asarray(values)
        width = min(len(y), WORLDS if name != "gradient" else 1)
        axes.plot(x, y, ".", markersize=1.5, alpha=0.25, color=COLOURS[name])
        mean = np.convolve(y, np.ones(width) / width, mode="valid")
        axes.plot(x[width - 1 :], mean, color=COLOURS[name], label=LABELS[name])
    axes.set(xscale="log", xlabel="simulations of 0.5 s", ylabel="return of an episode [m²]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=8)
    figure.savefig(path, dpi=120)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--learners", nargs="+", choices=list(LEARNERS), default=list(LEARNERS))
    parser.add_argument("--picture", type=Path, default=Path("docs/images/reinforcement.png"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    results = {}
    for name in args.learners:
        results[name] = LEARNERS[name](min(args.minutes, 2.0) if name == "gradient" else args.minutes)
        y = np.asarray(results[name])
        print(
            f"{LABELS[name]}: {len(y)} simulations, mean return of the first 16 {y[:16].mean():.5f}, "
            f"of the last 16 {y[-16:].mean():.5f}, best {y.max():.5f}",
            flush=True,
        )
        RESULTS.write_text(
            json.dumps({key: [round(v, 6) for v in values] for key, values in results.items()})
        )
    draw(results, args.picture)


if __name__ == "__main__":
    main()
