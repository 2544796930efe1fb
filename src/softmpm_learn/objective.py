"""Objectives: sums of terms, each a number that a motion should make small, in a window of time. Users add terms of their own.

objective = Objective(
    Progress(begin=1.0),                             # minus the distance from 1 s on
    Effort(weight=1e-2),
    AtMost(Upright(front=front, back=back, rest=rest), most=0.1, weight=10.0),
)

A term of one's own is a frozen dataclass, so that a resumed run can tell whether it is the same, with a method ``value``:

@dataclass(frozen=True, kw_only=True)
class Spread(Term):
    def value(self, path: Path) -> Tensor:
        return path.x[self.window(path)][..., 0].var(dim=-1).mean(dim=0)
"""

import dataclasses
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from softmpm import State


class Path:
    """Motion in an episode, as terms see it: states at the beginning and at the end of every control step.

    Attributes:
        times: Of the states [s].
        states: The states. Differentiable.
        activation: Activations during the control steps [-], shape (step, world, muscle). Differentiable.
        goal: Goal of each world [m], shape (world, dim), or None if it is the task's own.
    """

    def __init__(
        self, times: Sequence[float], states: Sequence[State], activation: Tensor, goal: Tensor | None = None
    ):
        self.times, self.states, self.activation, self.goal = list(times), list(states), activation, goal

    @functools.cached_property
    def x(self) -> Tensor:
        """Positions [m], shape (state, world, particle, dim)."""
        return torch.stack([state.x for state in self.states])

    @functools.cached_property
    def v(self) -> Tensor:
        """Velocities [m/s], shape (state, world, particle, dim)."""
        return torch.stack([state.v for state in self.states])


class Placed:
    """Arrays among the fields, moved to a device once: a captured graph cannot copy from the host."""

    @functools.cached_property
    def _placed(self) -> dict:
        return {}

    def on(self, name: str, like: Tensor) -> Tensor:
        """The field ``name`` on the device of ``like``; real numbers in its precision."""
        key = name, like.device, like.dtype
        if key not in self._placed:
            tensor = torch.as_tensor(getattr(self, name))
            self._placed[key] = tensor.to(like.device, like.dtype if tensor.is_floating_point() else None)
        return self._placed[key]


@dataclass(frozen=True, kw_only=True)
class Term(Placed, ABC):
    """A term of an objective: its weight times its value. Smaller is better."""

    adds_up: ClassVar[Literal["states", "steps", "way"]] = "states"
    """The value is a mean over the states or the control steps of the window, or a sum over the control steps that lie in it. Where
    rewards are given step by step, a constraint counts state by state."""
    weight: float = 1.0
    begin: float = 0.0
    """The window begins here [s]; the state of that time counts."""
    end: float = math.inf
    """The window ends here [s]; the state of that time counts."""

    @abstractmethod
    def value(self, path: Path) -> Tensor:
        """Value of each world, shape (world,). Differentiable."""

    @property
    def name(self) -> str:
        """Column of metrics.csv."""
        return type(self).__name__.lower()

    def window(self, path: Path) -> slice:
        """The states of the window.

        Raises:
            ValueError: There is none.
        """
        near = 1e-6 * path.times[-1]
        inside = [k for k, time in enumerate(path.times) if self.begin - near <= time <= self.end + near]
        if not inside:
            raise ValueError(
                f"the objective's term {self.name} has a window from {self.begin:g} to {self.end:g} s without a state; the episode "
                f"ends at {path.times[-1]:g} s."
            )
        return slice(inside[0], inside[-1] + 1)

    def steps(self, path: Path) -> slice:
        """The control steps between these states, or the one that ends in a single state."""
        states = self.window(path)
        stop = max(states.stop - 1, 1)
        return slice(min(states.start, stop - 1), stop)

    def rate(self, path: Path) -> float:
        """Value that windows of different lengths can be compared by, in the mean of the worlds."""
        return self.value(path).mean().item()

    def verdict(self, own: float, other: float) -> float:
        """How another :meth:`rate` compares with that of the episode: their quotient, 1 if they agree."""
        return other / own if own else math.nan

    def worst(self, verdicts: Sequence[float]) -> float:
        """The worst of several; nan if one is."""
        return math.nan if any(math.isnan(one) for one in verdicts) else max(verdicts)

    def outcome(self, x: np.ndarray, body_length: float) -> str:
        """What became of it in words, from the positions of a recorded episode, shape (frame, particle, dim); or nothing."""
        return ""


@dataclass(frozen=True, kw_only=True)
class Progress(Term):
    """Go far: minus the distance [m] that the mean position travels along an axis within the window."""

    adds_up: ClassVar[Literal["states", "steps", "way"]] = "way"
    axis: int = 0
    particles: np.ndarray | None = None
    """Indices of the particles that count, None for all."""

    def value(self, path: Path) -> Tensor:
        states = self.window(path)
        moved = (path.states[states.stop - 1].x - path.states[states.start].x)[..., self.axis]
        return -(moved if self.particles is None else moved[:, self.on("particles", moved)]).mean(dim=-1)

    def rate(self, path: Path) -> float:
        """Minus the mean speed [m/s]."""
        states = self.window(path)
        return super().rate(path) / (path.times[states.stop - 1] - path.times[states.start])

    def worst(self, verdicts: Sequence[float]) -> float:
        return -super().worst([-one for one in verdicts])

    def outcome(self, x: np.ndarray, body_length: float) -> str:
        moved = float((x[-1] - x[0])[:, self.axis].mean())
        return f"it travelled {moved:.3f} m, {moved / body_length:.2f} of its length"


@dataclass(frozen=True, kw_only=True)
class Reach(Term):
    """Bring a part to a place and hold it there: mean squared distance [m²] of its mean position from the place."""

    particles: np.ndarray
    """Indices of the particles that should get there."""
    target: np.ndarray
    """Target position [m], shape (dim,); the goal of an episode, if it has one, takes its place."""

    def value(self, path: Path) -> Tensor:
        x = path.x[self.window(path)]
        place = self.on("target", x) if path.goal is None else path.goal
        return (x[..., self.on("particles", x), :].mean(dim=-2) - place).square().sum(dim=-1).mean(dim=0)

    def verdict(self, own: float, other: float) -> float:
        """The distance from the place, root mean square [m]."""
        return math.sqrt(other)

    def outcome(self, x: np.ndarray, body_length: float) -> str:
        away = float(np.linalg.norm(x[-1, self.particles].mean(axis=0) - self.target))
        return f"it ended {1000 * away:.0f} mm from the goal"


@dataclass(frozen=True, kw_only=True)
class Still(Term):
    """Come to rest: mean squared speed [m²/s²] of the mean of some particles."""

    particles: np.ndarray
    """Indices of the particles."""

    def value(self, path: Path) -> Tensor:
        v = path.v[self.window(path)]
        return v[..., self.on("particles", v), :].mean(dim=-2).square().sum(dim=-1).mean(dim=0)


@dataclass(frozen=True, kw_only=True)
class Effort(Term):
    """Mean squared activation [-] (Spielberg et al. 2021 use weights of about 1e-6)."""

    adds_up: ClassVar[Literal["states", "steps", "way"]] = "steps"

    def value(self, path: Path) -> Tensor:
        return path.activation[self.steps(path)].square().mean(dim=(0, -1))


@dataclass(frozen=True, kw_only=True)
class Low(Term):
    """Do not fall: mean of max(0, lowest − height)² [m²], of the particles' mean height."""

    lowest: float
    """Height that costs nothing [m]."""
    up: int = 1
    """Vertical axis."""

    def value(self, path: Path) -> Tensor:
        height = path.x[self.window(path)][..., self.up].mean(dim=-1)
        return (self.lowest - height).clamp(min=0.0).square().mean(dim=0)


@dataclass(frozen=True, kw_only=True)
class Tilt(Term):
    """Keep level: mean squared change of the slope from the hind part of the robot to its front part since rest [-]."""

    front: np.ndarray
    back: np.ndarray
    """Indices of the particles of either part."""
    rest: np.ndarray
    """Rest positions of all particles [m], shape (particle, dim)."""
    along: int = 0
    """Axis from back to front."""
    up: int = 1
    """Vertical axis."""

    @functools.cached_property
    def lever(self) -> np.ndarray:
        """Weight of each particle's height in the slope [1/m], shape (particle,)."""
        share = np.zeros(len(self.rest))
        share[self.front] += 1 / len(self.front)
        share[self.back] -= 1 / len(self.back)
        return share / (share @ self.rest[:, self.along])

    def value(self, path: Path) -> Tensor:
        return self._change(path).square().mean(dim=0)

    def degrees(self, path: Path) -> float:
        """The largest tilt of any world in the window."""
        return math.degrees(math.atan(self._change(path).abs().max().item()))

    def _change(self, path: Path) -> Tensor:
        """Change of the slope, shape (state, world)."""
        x = path.x[self.window(path)]
        return x[..., self.up] @ self.on("lever", x) - float(self.lever @ self.rest[:, self.up])


@dataclass(frozen=True, kw_only=True)
class AtMost(Term):
    """The constraint that another term's value is at most ``most``, as a penalty: the square of what is beyond it."""

    term: Term
    """Its weight and its window do not count."""
    most: float

    def value(self, path: Path) -> Tensor:
        term = dataclasses.replace(self.term, begin=self.begin, end=self.end)
        return (term.value(path) - self.most).clamp(min=0.0).square()

    @property
    def name(self) -> str:
        return f"{self.term.name}_beyond"


@dataclass(frozen=True, init=False)
class Objective:
    """The sum of terms."""

    terms: tuple[Term, ...]

    def __init__(self, *terms: Term):
        object.__setattr__(self, "terms", terms)

    @property
    def names(self) -> list[str]:
        """Name of each term; a second one of a name has a number."""
        names = [term.name for term in self.terms]
        count = dict.fromkeys(names, 0)
        for k, name in enumerate(names):
            count[name] += 1
            names[k] = f"{name}_{count[name]}" if count[name] > 1 else name
        return names

    def __call__(self, path: Path) -> dict[str, Tensor]:
        """Each term with its weight, shape (world,), by its name; the loss is their sum."""
        return {
            name: term.weight * term.value(path) for name, term in zip(self.names, self.terms, strict=True)
        }

    def outcome(self, x: np.ndarray, body_length: float) -> str:
        """What became of the first term that tells, in words."""
        return next(filter(None, (term.outcome(x, body_length) for term in self.terms)), "")
