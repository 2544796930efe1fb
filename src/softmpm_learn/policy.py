"""Features → activation. Closed loop: tanh(Wz + b) or a small network, with a clock if wanted. Open loop: sinusoids or knots.

The clock, sines and cosines of the time, is our choice: a pure feedback policy has to find a rhythm before it can improve one.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from softmpm_learn import register
from softmpm_learn.register import POLICIES
from softmpm_learn.seeding import seeded
from softmpm_learn.settings import PolicyConf


class Clock(nn.Module):
    """sin and cos of 2π h t / period for h = 1 … harmonics."""

    rate: Tensor
    phase: Tensor

    def __init__(self, period: float, harmonics: int):
        super().__init__()
        rate = 2 * math.pi / period * torch.arange(1, harmonics + 1)
        self.register_buffer("rate", rate.repeat(2), persistent=False)
        phase = torch.tensor([0.0, math.pi / 2]).repeat_interleave(harmonics)  # cos a = sin(a + π/2)
        self.register_buffer("phase", phase, persistent=False)
        self.size = 2 * harmonics

    def forward(self, time: Tensor) -> Tensor:
        """Shape (*time.shape, size)."""
        return torch.addcmul(self.phase, self.rate, time[..., None]).sin()


class Goal(nn.Module):
    """A goal [m] as its place in the box that goals are drawn from, in [-1, 1] along each axis."""

    centre: Tensor
    inverse: Tensor

    def __init__(self, centre: Tensor, spread: Tensor):
        super().__init__()
        self.register_buffer("centre", centre, persistent=False)
        self.register_buffer("inverse", torch.where(spread > 0, 1 / spread, 0.0), persistent=False)
        self.size = len(centre)

    def forward(self, goal: Tensor) -> Tensor:
        return (goal - self.centre) * self.inverse


class Feedback(nn.Module):
    """tanh of a network of features, clock and goal (Spielberg et al. 2021), or tanh(Wz + b) if it has no hidden layers."""

    def __init__(
        self,
        size: int,
        muscles: int,
        hidden: list[int],
        gain: float,
        clock: Clock | None = None,
        goal: Goal | None = None,
        feature_gain: float = 1.0,
    ):
        super().__init__()
        self.clock, self.goal = clock, goal
        width = size + (clock.size if clock else 0) + (goal.size if goal else 0)
        layers = []
        for wider in hidden:
            layers += [nn.Linear(width, wider), nn.ELU()]
            width = wider
        last = nn.Linear(width, muscles)
        nn.init.normal_(last.weight, std=gain / math.sqrt(width))
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(*layers, last)
        if clock is not None:  # beside the features of a body that shakes, its rhythm would hardly be heard
            with torch.no_grad():
                next(self.layers.parameters())[:, :size].mul_(feature_gain)

    def forward(self, z: Tensor, time: Tensor, goal: Tensor | None = None) -> Tensor:
        """Activation (..., world, muscle) in (-1, 1) from features (..., world, size), time [s] and goals (world, dim) [m].

        Of one control step with a time of shape (), or of many at once with times of shape (step, 1).
        """
        lead, inputs = z.shape[:-1], [z]
        if self.clock:
            inputs.append(self.clock(time).expand(*lead, -1))
        if self.goal:
            inputs.append(self.goal(goal).expand(*lead, -1))
        return torch.tanh(self.layers(torch.cat(inputs, dim=-1)))


class Sinusoids(nn.Module):
    """Open loop: tanh(W clock(t) + b), one amplitude and phase for each muscle and harmonic."""

    def __init__(self, muscles: int, gain: float, clock: Clock):
        super().__init__()
        self.clock, self.wave = clock, nn.Linear(clock.size, muscles)
        nn.init.normal_(self.wave.weight, std=gain / math.sqrt(clock.size))
        nn.init.zeros_(self.wave.bias)

    def forward(self, z: Tensor, time: Tensor, goal: Tensor | None = None) -> Tensor:
        return torch.tanh(self.wave(self.clock(time))).expand(*z.shape[:-1], -1)


class Knots(nn.Module):
    """Open loop: tanh of values at evenly spaced times, joined by straight lines; constant after the last."""

    number: Tensor

    def __init__(self, muscles: int, gain: float, knots: int, seconds: float):
        super().__init__()
        self.seconds, self.values = seconds, nn.Parameter(gain * torch.randn(knots, muscles))
        self.register_buffer("number", torch.arange(float(knots)), persistent=False)

    def forward(self, z: Tensor, time: Tensor, goal: Tensor | None = None) -> Tensor:
        place = (time / self.seconds).clamp(0.0, 1.0) * (len(self.values) - 1)
        share = (1.0 - (place[..., None] - self.number).abs()).clamp(min=0.0)  # of each knot: a hat
        return torch.tanh(share @ self.values).expand(*z.shape[:-1], -1)


@dataclass(frozen=True, kw_only=True)
class Space:
    """Inputs and outputs of a policy, ``forward(z, time, goal)``: activation (..., world, muscle), in (-1, 1), from features
    (..., world, feature), a time [s] of shape () or (step, 1), and goals (world, dim) [m] or None."""

    features: int
    """Number of features of the observer."""
    muscles: int
    """Number of activations."""
    seconds: float
    """Length of an episode [s]."""
    goal: Goal | None = None
    """If goals are drawn at random, how a feedback policy sees them."""


def clock(conf: PolicyConf) -> Clock:
    """The clock that the settings describe."""
    return Clock(conf.period, conf.harmonics)


@register.policy("linear")
def linear(conf: PolicyConf, space: Space) -> nn.Module:
    """tanh(Wz + b)."""
    return _feedback(conf, space, [])


@register.policy("mlp")
def mlp(conf: PolicyConf, space: Space) -> nn.Module:
    """A network with hidden layers."""
    return _feedback(conf, space, list(conf.hidden))


@register.policy("sinusoids")
def sinusoids(conf: PolicyConf, space: Space) -> nn.Module:
    """Open loop: sinusoids."""
    return Sinusoids(space.muscles, _gain(conf), clock(conf))


@register.policy("knots")
def knots(conf: PolicyConf, space: Space) -> nn.Module:
    """Open loop: straight lines between knots."""
    return Knots(space.muscles, _gain(conf), conf.knots, space.seconds)


def _feedback(conf: PolicyConf, space: Space, hidden: list[int]) -> nn.Module:
    seen = None if conf.clock is False else clock(conf)
    gain = 1.0 if conf.feature_gain is None else conf.feature_gain
    return Feedback(space.features, space.muscles, hidden, _gain(conf), seen, space.goal, gain)


def _gain(conf: PolicyConf) -> float:
    """That of the settings; 1 for a policy without a task (:meth:`softmpm_learn.settings.Settings.suited`)."""
    return 1.0 if conf.gain is None else conf.gain


def make_policy(
    conf: PolicyConf, size: int, muscles: int, seconds: float, seed: int, goal: Goal | None = None
) -> nn.Module:
    """The policy that the settings name.

    Args:
        size: Number of features of the observer.
        seconds: Length of an episode [s].
        goal: If goals are drawn at random, how a feedback policy sees them.
    """
    if muscles < 1:
        raise ValueError("a policy needs muscles to drive; the scene has none.")
    space = Space(features=size, muscles=muscles, seconds=seconds, goal=goal)
    with seeded(seed):
        policy = POLICIES.build(conf.name, conf.options, conf, space)
    if not isinstance(policy, nn.Module):
        raise ValueError(f"policy {conf.name} must be a torch.nn.Module, got {type(policy).__name__}.")
    return policy
