"""Objectives: a loss of the final state of a simulation, and running costs of its control steps. Smaller is better."""

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softmpm import State


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


class Running(Placed, ABC):
    """A term that is averaged over the control steps of an episode."""

    @abstractmethod
    def __call__(self, x: Tensor, activation: Tensor) -> Tensor:
        """Cost of control steps, shape (..., world), from the positions [m] after them, (..., world, particle, dim), and the
        activations during them, (..., world, muscle)."""


@dataclass(frozen=True)
class Effort(Running):
    """Mean squared activation (Spielberg et al. 2021 use weights of about 1e-6)."""

    weight: float

    def __call__(self, x: Tensor, activation: Tensor) -> Tensor:
        return self.weight * activation.square().mean(dim=-1)


@dataclass(frozen=True)
class Height(Running):
    """Do not fall: weight · max(0, lowest − height)², of the particles' mean height and ``lowest`` [m]."""

    weight: float
    lowest: float
    axis: int = 1
    """Vertical axis."""

    def __call__(self, x: Tensor, activation: Tensor) -> Tensor:
        return self.weight * (self.lowest - x[..., self.axis].mean(dim=-1)).clamp(min=0.0).square()


@dataclass(frozen=True)
class Upright(Running):
    """Keep level: weight · (slope − slope at rest)², the slope that from the hind part of the robot to its front part."""

    weight: float
    front: np.ndarray
    back: np.ndarray
    """Indices of the particles of either part."""
    rest: np.ndarray
    """Rest positions of all particles [m], shape (particle, dim)."""

    @functools.cached_property
    def lever(self) -> np.ndarray:
        """Weight of each particle's height in the slope [1/m], shape (particle,)."""
        share = np.zeros(len(self.rest))
        share[self.front] += 1 / len(self.front)
        share[self.back] -= 1 / len(self.back)
        return share / (share @ self.rest[:, 0])

    def __call__(self, x: Tensor, activation: Tensor) -> Tensor:
        slope = x[..., 1] @ self.on("lever", x)
        return self.weight * (slope - float(self.lever @ self.rest[:, 1])).square()


class Objective(Placed, ABC):
    """A final loss and running terms."""

    terms: tuple[Running, ...] = ()

    @abstractmethod
    def final(self, start: State, end: State, goal: Tensor | None) -> Tensor:
        """Loss of each world, shape (world,). ``goal`` [m] of shape (world, dim) if the episode has one of its own."""

    def running(self, x: Tensor, activation: Tensor) -> Tensor:
        """Cost of control steps, shape (..., world); arguments as of :class:`Running`."""
        nothing = activation.new_zeros(activation.shape[:-1])
        return sum((term(x, activation) for term in self.terms), nothing)


@dataclass(frozen=True)
class Progress(Objective):
    """Go far: minus the distance [m] that the mean position travels along an axis."""

    axis: int = 0
    particles: np.ndarray | None = None
    """Indices of the particles that count, None for all."""
    terms: tuple[Running, ...] = ()

    def final(self, start: State, end: State, goal: Tensor | None) -> Tensor:
        moved = end.x[..., self.axis] - start.x[..., self.axis]
        return -(moved if self.particles is None else moved[:, self.on("particles", moved)]).mean(dim=-1)


@dataclass(frozen=True)
class Reach(Objective):
    """Bring a part to a place: squared distance [m²] between the mean position of the particles and the place."""

    particles: np.ndarray
    """Indices of the particles that should get there."""
    target: np.ndarray
    """Target position [m], shape (dim,); the goal of an episode, if it has one, takes its place."""
    terms: tuple[Running, ...] = ()

    def final(self, start: State, end: State, goal: Tensor | None) -> Tensor:
        place = self.on("target", end.x) if goal is None else goal
        return (end.x[:, self.on("particles", end.x)].mean(dim=1) - place).square().sum(dim=-1)
