"""State → features: centroids of hand-picked regions, of k-means clusters, a learned latent of the grid velocity, or nothing.

An observer works in two steps, ``observe`` (state → observation) and ``encode`` (observation → features), because a learned
observer also trains on the observations. Both are differentiable.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

import softmpm
from softmpm import Model, State
from softmpm_learn import register
from softmpm_learn.autoencoder import Autoencoder
from softmpm_learn.register import OBSERVERS
from softmpm_learn.settings import ObserverConf
from softmpm_learn.tasks.task import Task

THIN = 0.01
"""A node with this share of a full node's mass shows half its velocity. Otherwise what is seen would jump, and the gradient
miss the jump, whenever a node gains or loses its last particle. Our choice."""
STRETCH = 1.25
"""Stretch of the robot that the window of a learned observer has room for, in any direction. Our choice."""
PACE = 0.1
"""Displacements in a picture are divided by this time [s], of the order of that of a gait, so that they are as large as velocities. Our
choice."""
POSTURE = 0.1
"""Regions typically move by this much of a body length against each other; makes features of order one."""


class Observer(nn.Module, ABC):
    """Observation of the robot by the policy."""

    size: int
    """Number of features."""

    @abstractmethod
    def observe(self, model: Model, state: State) -> Tensor:
        """Observation of each world, shape (world, ...)."""

    @abstractmethod
    def encode(self, observation: Tensor) -> Tensor:
        """Features of order one, shape (world, size)."""

    def forward(self, model: Model, state: State) -> Tensor:
        return self.encode(self.observe(model, state))


class Centroids(Observer):
    """Mean position and velocity of each of some regions (the hand-picked features of Hu et al. 2019, "ChainQueen").

    Positions count from the centroid of the robot and from their rest values, in tenths of a body length; velocities in
    body lengths per second. So the features do not tell where the robot is.
    """

    mean: Tensor
    rest: Tensor

    def __init__(self, model: Model, regions: Sequence[np.ndarray], body_length: float):
        super().__init__()
        mean = torch.zeros(len(regions), model.particle_count, dtype=model.dtype)
        for row, region in zip(mean, regions, strict=True):
            row[torch.as_tensor(region)] = 1.0 / len(region)
        self.register_buffer("mean", mean.to(model.device), persistent=False)
        self.register_buffer("rest", self._posture(model.positions[None]), persistent=False)
        self.body_length = body_length
        self.size = 2 * model.dim * len(regions)

    def _posture(self, x: Tensor) -> Tensor:
        return self.mean @ x - x.mean(dim=1, keepdim=True)

    def observe(self, model: Model, state: State) -> Tensor:
        """Posture and velocity of each region, shape (world, region, 2 · dim)."""
        posture = (self._posture(state.x) - self.rest) / (POSTURE * self.body_length)
        return torch.cat([posture, self.mean @ state.v / self.body_length], dim=-1)

    def encode(self, observation: Tensor) -> Tensor:
        return observation.flatten(start_dim=1)


def clusters(positions: np.ndarray, count: int) -> list[np.ndarray]:
    """k-means clusters of points (particle, dim), the same in every run: a first centre is the point farthest from the others."""
    from scipy.cluster.vq import kmeans2

    if count > len(positions):
        raise ValueError(f"observer.clusters must not be above the {len(positions)} particles, got {count}.")
    chosen = [int(np.square(positions - positions.mean(axis=0)).sum(axis=1).argmax())]
    distance = np.full(len(positions), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.square(positions - positions[chosen[-1]]).sum(axis=1))
        chosen.append(int(distance.argmax()))
    _, label = kmeans2(positions, positions[chosen], minit="matrix", iter=20)
    return [np.flatnonzero(label == k) for k in np.unique(label)]


@dataclass(kw_only=True)
class _View:
    """Place of a window in a grid."""

    middle: Tensor
    """Node on which the centroid of the robot lies [m]."""
    low: Tensor
    high: Tensor
    """Limits of the particles [m]."""
    pad: list[int]
    """Nodes of the window before and after the grid, for each axis from the last; negative where the window is smaller."""

    @classmethod
    def of(cls, model: Model, window: Sequence[int], follow: bool) -> Self:
        """View of a window around the middle of the grid, or of the whole grid."""
        grid, place = model.scene.grid, {"dtype": model.dtype, "device": model.device}
        middle = [(n - 1) // 2 for n in grid.shape]
        first = [m - w // 2 for m, w in zip(middle, window, strict=True)] if follow else [0] * model.dim
        ends = [(-f, f + w - n) for f, w, n in zip(first, window, grid.shape, strict=True)]
        last = torch.tensor(grid.shape, **place) - 1
        return cls(
            middle=torch.tensor(middle, **place) * grid.spacing,
            low=torch.full_like(last, grid.spacing),
            high=(last - 1) * grid.spacing,
            pad=[nodes for pair in reversed(ends) for nodes in pair],
        )


class VelocityImage:
    """Grid velocity as a learned observer sees it: averaged over blocks of nodes, components first. With posture, the displacement from
    rest as well, that of the centroid left out: the velocity at which the robot would come from rest in :data:`PACE`.

    Args:
        model: Whose grid and robot.
        nodes: Most nodes of the picture along the longest axis, None for 32 in 2D and 16 in 3D if it follows, else for twice as many.
        follow: See a window around the robot, with its centroid on a node: the picture depends neither on the place nor on the size of
            the grid, so that what learned on one track can be used on another. False shows the whole grid as it is.
        posture: See the displacement too.

    Attributes:
        channels: Components of all that is seen.
        shape: Nodes of the picture.
    """

    def __init__(self, model: Model, nodes: int | None = None, follow: bool = True, posture: bool = False):
        grid = model.scene.grid
        self.follow, self.posture, self.channels = follow, posture, model.dim * (1 + posture)
        self._rest = model.positions - model.positions.mean(dim=0)
        self._window = (_window(model),) * model.dim if follow else grid.shape
        usual = (32 if model.dim == 2 else 16) * (1 if follow else 2)
        self.block = math.ceil(max(self._window) / (nodes or usual))
        self.shape = tuple(math.ceil(n / self.block) for n in self._window)
        mass = (model.params().density * model.volume).sum() / model.volume.sum() * grid.spacing**model.dim
        self._thin = THIN * mass.item()
        self._spacing, self._views = grid.spacing, dict[tuple[int, ...], _View]()
        self._view(model)  # while a graph is captured nothing can be copied to a GPU

    def __call__(self, model: Model, state: State) -> Tensor:
        """Velocity [m/s], then the displacement over :data:`PACE`, shape (world, channels, *shape).

        Args:
            model: The one of the picture, or the same robot on another track.

        Raises:
            ValueError: The cells are of another size, or the whole grid is shown and has another shape.
        """
        view = self._view(model)
        centred = state.x - state.x.mean(dim=1, keepdim=True)
        if self.follow:
            state = state._replace(x=(centred + view.middle).clamp(view.low, view.high))
        if not self.posture:
            return self._seen(model, state, view)
        away = state._replace(v=(centred - self._rest) / PACE, C=torch.zeros_like(state.C))
        return torch.cat([self._seen(model, state, view), self._seen(model, away, view)], dim=1)

    def _view(self, model: Model) -> _View:
        """View of the grid of a model."""
        grid = model.scene.grid
        if not math.isclose(grid.spacing, self._spacing):
            raise ValueError(
                f"the observer was built for cells of {self._spacing:.5g} m, of which its window has a fixed number; got a model with "
                f"cells of {grid.spacing:.5g} m. Build the observer again with this model."
            )
        if grid.shape not in self._views:
            if not self.follow and self._views:
                raise ValueError(
                    f"an observer with follow=False sees the whole grid, of {self._window} nodes; got a model with {grid.shape}. Take "
                    "follow=True, whose window follows the robot on any track."
                )
            self._views[grid.shape] = _View.of(model, self._window, self.follow)
        return self._views[grid.shape]

    def _seen(self, model: Model, state: State, view: _View) -> Tensor:
        """Picture of the velocities of a state."""
        field = softmpm.rasterize(model, state)
        velocity = field.velocity * (field.mass / (field.mass + self._thin))[..., None]
        seen = functional.pad(velocity.movedim(-1, 1), view.pad)  # negative where the window is smaller
        pool, size = functional.avg_pool2d if model.dim == 2 else functional.avg_pool3d, self.block
        # The blocks at the far ends reach beyond the window, where there is nothing:
        return pool(seen, size, ceil_mode=True, divisor_override=size**model.dim)


def _window(model: Model) -> int:
    """Nodes along each side of a cube around a node that holds the robot in any direction, stretched by :data:`STRETCH`."""
    away = (model.positions - model.positions.mean(dim=0)).norm(dim=-1).max().item()
    half = (
        round(STRETCH * away / model.scene.grid.spacing) + 2
    )  # a particle reaches nodes up to 1.5 cells away
    return 2 * half + 1


class Latent(Observer):
    """Features that an encoder finds in the picture of the grid velocity; which encoder is not this class's business.

    Attributes:
        trained: False if learning phases leave the encoder its weights and only standardise what it finds.
    """

    def __init__(self, picture: VelocityImage, encoder: nn.Module, size: int):
        super().__init__()
        self.picture, self.encoder, self.size, self.trained = picture, encoder, size, True

    def observe(self, model: Model, state: State) -> Tensor:
        """The picture, shape (world, channels, *nodes) [m/s]."""
        return self.picture(model, state)

    def encode(self, observation: Tensor) -> Tensor:
        return self.encoder(observation)


class Nothing(Observer):
    """No view of the robot: one feature that is always 0. A policy with a clock acts by the time alone, one without is constant."""

    size = 1

    def observe(self, model: Model, state: State) -> Tensor:
        """Zeros, shape (world, 1)."""
        return state.x.new_zeros(len(state.x), self.size)

    def encode(self, observation: Tensor) -> Tensor:
        return observation


@register.observer("latent")
def latent(conf: ObserverConf, model: Model, task: Task) -> Latent:
    """Learned; its encoder is an autoencoder yet to be trained, whose own encoder the learner puts in its place."""
    picture = VelocityImage(model, conf.nodes, conf.follow, conf.posture)
    autoencoder = Autoencoder(
        model.dim,
        picture.shape,
        conf.latent_size,
        conf.channels,
        scale=task.body_length,
        seen=picture.channels,
    )
    return Latent(picture, autoencoder, conf.latent_size)


@register.observer("centroids")
def centroids(conf: ObserverConf, model: Model, task: Task) -> Centroids:
    """Centroids of the task's regions."""
    return Centroids(model, list(task.regions.values()), task.body_length)


@register.observer("kmeans")
def kmeans(conf: ObserverConf, model: Model, task: Task) -> Centroids:
    """Centroids of clusters at rest."""
    found = clusters(model.positions.cpu().double().numpy(), conf.clusters)
    return Centroids(model, found, task.body_length)


@register.observer("untrained")
def untrained(conf: ObserverConf, model: Model, task: Task) -> Latent:
    """Random features: as :func:`latent`, with the first weights of the encoder."""
    observer = latent(conf, model, task)
    observer.trained = False
    return observer


@register.observer("nothing")
def nothing(conf: ObserverConf, model: Model, task: Task) -> Nothing:
    """The control of all others."""
    return Nothing()


def make_observer(conf: ObserverConf, model: Model, task: Task) -> Observer:
    """The observer that the settings name."""
    made = OBSERVERS.build(conf.name, conf.options, conf, model, task)
    if not (isinstance(made, Observer) and isinstance(getattr(made, "size", None), int)):
        raise ValueError(
            f"observer {conf.name} must be a softmpm_learn.observe.Observer with its size, got {type(made).__name__}."
        )
    return made
