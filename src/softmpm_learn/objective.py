"""Objectives: sums of terms, each a number that a motion should make small, in a window of time. Users add terms of their own.

objective = Objective(
    Progress(begin=1.0),                             # minus the distance from 1 s on
    Effort(weight=1e-2),
    AtMost(term=Tilt(front=front, back=back, rest=rest), most=0.1, weight=10.0),
)

A term of one's own is a frozen dataclass, so that a resumed run can tell whether it is the same, with a method ``value``:

@dataclass(frozen=True, kw_only=True)
class Spread(Term):
    def value(self, path: Path) -> Tensor:
        x = path.x[self.window(path)]                    # (state, world, particle, dim)
        return x[..., 0].var(dim=-1).mean(dim=0)         # (world,)
"""

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor

from softmpm_learn.setting_checks import particles
from softmpm_learn.term import Path, Sum, Term, check_terms


@dataclass(frozen=True, kw_only=True)
class Progress(Term):
    """Go far: minus the distance [m] that the mean position travels along an axis within the window."""

    adds_up: ClassVar[Sum | None] = "way"
    axis: int = 0
    particles: np.ndarray | None = None
    """Indices of the particles that count, None for all."""

    def value(self, path: Path) -> Tensor:
        """Minus the distance along the axis from the first state of the window to the last one [m], shape (world,)."""
        states = self.window(path)
        moved = (path.states[states.stop - 1].x - path.states[states.start].x)[..., self.axis]
        return -(moved if self.particles is None else moved[:, self.on("particles", moved)]).mean(dim=-1)

    def speed(self, path: Path) -> Tensor:
        """Mean speed in the window [m/s], shape (world,)."""
        states = self.window(path)
        return -self.value(path) / (path.times[states.stop - 1] - path.times[states.start])

    def rate(self, path: Path) -> float:
        """Minus the mean speed [m/s]."""
        return -self.speed(path).mean().item()

    def outcome(self, x: np.ndarray, body_length: float) -> str:
        moved = float((x[-1] - x[0])[:, self.axis].mean())
        return f"it travelled {moved:.3f} m, {moved / body_length:.2f} of its length"


@dataclass(frozen=True, kw_only=True)
class Reach(Term):
    """Bring a part to a place and hold it there: mean squared distance [m²] of its mean position from the place."""

    adds_up: ClassVar[Sum | None] = "states"
    particles: np.ndarray
    """Indices of the particles that should get there."""
    target: np.ndarray
    """Target position [m], shape (dim,); the goal of an episode, if it has one, takes its place."""

    def value(self, path: Path) -> Tensor:
        """Squared distance from the place [m²], mean over the states of the window, shape (world,)."""
        return self._away(path).square().sum(dim=-1).mean(dim=0)

    def verdict(self, own: float, other: float) -> float:
        """The distance from the place, root mean square [m]."""
        return math.sqrt(other)

    def farthest(self, path: Path) -> float:
        """The largest distance from the place of any world in the window [m]."""
        return self._away(path).norm(dim=-1).max().item()

    def _away(self, path: Path) -> Tensor:
        """Way from the place, shape (state, world, dim)."""
        x = path.x[self.window(path)]
        place = self.on("target", x) if path.goal is None else path.goal
        return x[..., self.on("particles", x), :].mean(dim=-2) - place

    def outcome(self, x: np.ndarray, body_length: float) -> str:
        away = float(np.linalg.norm(x[-1, self.particles].mean(axis=0) - self.target))
        return f"it ended {1000 * away:.0f} mm from the goal"


@dataclass(frozen=True, kw_only=True)
class Still(Term):
    """Come to rest: mean squared speed [m²/s²] of the mean of some particles."""

    adds_up: ClassVar[Sum | None] = "states"
    particles: np.ndarray
    """Indices of the particles."""

    def value(self, path: Path) -> Tensor:
        """Squared speed [m²/s²], mean over the states of the window, shape (world,)."""
        return self._velocity(path).square().sum(dim=-1).mean(dim=0)

    def fastest(self, path: Path) -> float:
        """The largest speed of any world in the window [m/s]."""
        return self._velocity(path).norm(dim=-1).max().item()

    def _velocity(self, path: Path) -> Tensor:
        """Mean velocity of the particles, shape (state, world, dim)."""
        v = path.v[self.window(path)]
        return v[..., self.on("particles", v), :].mean(dim=-2)


@dataclass(frozen=True, kw_only=True)
class Effort(Term):
    """Mean squared activation [-] (Spielberg et al. 2021 use weights of about 1e-6)."""

    adds_up: ClassVar[Sum | None] = "steps"

    def value(self, path: Path) -> Tensor:
        """Squared activation [-], mean over the control steps of the window and the muscles, shape (world,)."""
        return path.activation[self.steps(path)].square().mean(dim=(0, -1))


@dataclass(frozen=True, kw_only=True)
class Low(Term):
    """Do not fall: mean of max(0, lowest − height)² [m²], of the particles' mean height."""

    adds_up: ClassVar[Sum | None] = "states"
    lowest: float
    """Height that costs nothing [m]."""
    up: int = 1
    """Vertical axis."""

    def value(self, path: Path) -> Tensor:
        """Squared height that is missing [m²], mean over the states of the window, shape (world,)."""
        height = path.x[self.window(path)][..., self.up].mean(dim=-1)
        return (self.lowest - height).clamp(min=0.0).square().mean(dim=0)


@dataclass(frozen=True, kw_only=True)
class Tilt(Term):
    """Keep level: mean squared change of the slope from the hind part of the robot to its front part since rest [-].

    In 3D the squared slope from side to side is added.
    """

    adds_up: ClassVar[Sum | None] = "states"
    front: np.ndarray
    back: np.ndarray
    """Indices of the particles of either part."""
    rest: np.ndarray
    """Rest positions of all particles [m], shape (particle, dim)."""
    along: int = 0
    """Axis from back to front."""
    up: int = 1
    """Vertical axis."""

    def __post_init__(self):
        particles("Tilt.front", self.front)
        particles("Tilt.back", self.back)
        if self.rest.shape[1] == 3 and not np.allclose(self.vectors, np.eye(3)[self.horizontal], atol=1e-6):
            raise ValueError(
                "Tilt needs parts that have an extent along each horizontal axis: give it more particles."
            )

    @functools.cached_property
    def lever(self) -> np.ndarray:
        """Weight of each particle's height in the slope [1/m], shape (particle,)."""
        share = np.zeros(len(self.rest))
        share[self.front] += 1 / len(self.front)
        share[self.back] -= 1 / len(self.back)
        return share / (share @ self.rest[:, self.along])

    @functools.cached_property
    def parts(self) -> np.ndarray:
        """Indices of the particles of both parts."""
        return np.union1d(self.front, self.back)

    @functools.cached_property
    def level(self) -> np.ndarray:
        """Weights [1/m] by which the places of both parts give the vectors that were unit vectors along the horizontal axes at rest,
        by least squares, shape (particle of the parts, axis): from back to front, and in 3D from side to side.
        """
        rest = self.rest[self.parts]
        return np.linalg.pinv(rest - rest.mean(axis=0), rcond=1e-9).T[:, self.horizontal]

    @property
    def horizontal(self) -> list[int]:
        """The horizontal axes, that from back to front first."""
        return [self.along, *(k for k in range(self.rest.shape[1]) if k not in (self.along, self.up))]

    @property
    def vectors(self) -> np.ndarray:
        """Vectors that these weights give at rest, shape (axis, dim): unit vectors, or in 2D another one of particles on a line."""
        return self.level.T @ self.rest[self.parts]

    def value(self, path: Path) -> Tensor:
        """Squared change of the slope [-], mean over the states of the window, shape (world,)."""
        squared = self.slope(path).square()
        if self.rest.shape[1] == 3:
            squared = squared + self.turned(path)[1][..., self.up].square()
        return squared.mean(dim=0)

    def degrees(self, path: Path) -> float:
        """The largest tilt of any world in the window."""
        return math.degrees(self.angle(path).max().item())

    def angle(self, path: Path) -> Tensor:
        """Inclination of the plane that was horizontal at rest, in 2D the angle of that line to rest [rad], shape (state, world)."""
        first, *second = self.turned(path)
        if second:
            normal = first.cross(second[0], dim=-1)
            rises = normal[..., self.up] * (1.0 if (self.up - self.along) % 3 == 2 else -1.0)
            runs = (normal.square().sum(dim=-1) - rises.square()).clamp(min=0.0).sqrt()
            return runs.atan2(rises)
        x, y = self.vectors[0, [self.along, self.up]]
        run, rise = first[..., self.along], first[..., self.up]
        return (x * rise - y * run).abs().atan2(x * run + y * rise)

    def turned(self, path: Path) -> list[Tensor]:
        """Vectors that were unit vectors along the horizontal axes at rest [-], shape (state, world, dim) each."""
        x = path.x[self.window(path)]
        vectors = x[..., self.on("parts", x), :].transpose(-1, -2) @ self.on("level", x)
        return list(vectors.unbind(dim=-1))

    def slope(self, path: Path) -> Tensor:
        """Change of the slope from back to front since rest, relative to their distance at rest [-], shape (state, world)."""
        x = path.x[self.window(path)]
        return x[..., self.up] @ self.on("lever", x) - float(self.lever @ self.rest[:, self.up])


@dataclass(frozen=True, kw_only=True)
class Stretch(Term):
    """Do not overstretch: mean over pairs of particles and states of max(0, λ − most)², with their distance over that at rest, λ [-].

    It sees a crack that opens, which :func:`softmpm.von_mises_strain` of the particles on its sides hardly does.
    """

    adds_up: ClassVar[Sum | None] = "states"
    pairs: np.ndarray
    """Indices of the particles of each pair, shape (pair, 2), such as :func:`softmpm.neighbour_pairs`."""
    rest: np.ndarray
    """Positions of all particles at rest [m], shape (particle, dim)."""
    most: float
    """Stretch that costs nothing."""

    def __post_init__(self):
        if not len(self.pairs):
            raise ValueError("Stretch needs pairs of particles, got none: leave the term out.")

    def value(self, path: Path) -> Tensor:
        """Squared stretch beyond ``most`` [-], mean over the states of the window and the pairs, shape (world,)."""
        x = path.x[self.window(path)]
        one, other = self.on("pairs", x).unbind(dim=1)
        stretch = (x[..., one, :] - x[..., other, :]).norm(dim=-1) / self.on("lengths", x)
        return (stretch - self.most).clamp(min=0.0).square().mean(dim=(0, -1))

    @functools.cached_property
    def lengths(self) -> np.ndarray:
        """Distance of each pair at rest [m], shape (pair,)."""
        one, other = self.rest[self.pairs.T]
        return np.linalg.norm(one - other, axis=1)


@dataclass(frozen=True, kw_only=True)
class AtMost(Term):
    """The constraint that another term's value is at most ``most``, as a penalty: the square of what is beyond it."""

    term: Term
    """Its weight and its window do not count."""
    most: float

    def value(self, path: Path) -> Tensor:
        """Squared excess of the other term's value, shape (world,), in the square of its unit."""
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
        check_terms(terms)
        object.__setattr__(self, "terms", terms)

    @property
    def names(self) -> list[str]:
        """Name of each term; a second one of a name has a number."""
        names = [term.name for term in self.terms]
        count = [names[: k + 1].count(name) for k, name in enumerate(names)]
        return [f"{name}_{n}" if n > 1 else name for name, n in zip(names, count, strict=True)]

    def __call__(self, path: Path) -> dict[str, Tensor]:
        """Each term with its weight, shape (world,), by its name; the loss is their sum."""
        values = [term.weight * term.value_of_each_world(path) for term in self.terms]
        return dict(zip(self.names, values, strict=True))

    def outcome(self, x: np.ndarray, body_length: float) -> str:
        """Outcome of the first term that has one, in words."""
        return next(filter(None, (term.outcome(x, body_length) for term in self.terms)), "")
