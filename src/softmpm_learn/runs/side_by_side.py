"""Observers, policies and designs of runs side by side, each evaluated as one for all worlds.

Runs of one kind, which differ in nothing but the values of their weights, are evaluated at once (:mod:`softmpm_learn.runs.stacking`),
and one kind after another. What kinds have in different numbers, features and what is observed, is filled up with zeros.
"""

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from softmpm import Inputs, Model, Params, State
from softmpm_learn.design import Design
from softmpm_learn.likeness import alike
from softmpm_learn.observe import Latent, Observer
from softmpm_learn.observer_check import probe
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.stacking import Stacked

ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-12}
"""Largest difference of two equal observations, relative to the largest value: a GPU adds up the particles at a node in any order."""


class Kinds:
    """Runs sorted by kind, and the worlds of each.

    Args:
        of: Kind of each run, of any type that can be compared.
        share: Worlds of each run.

    Attributes:
        members: Numbers of the runs of each kind.
        worlds: Numbers of the worlds of each kind, shape (world of the kind,).
    """

    def __init__(self, of: Sequence[Any], share: int, device: torch.device):
        self._of, self._share, self._device = of, share, device
        first = [k for k, kind in enumerate(of) if kind not in of[:k]]
        self.members = [[k for k, kind in enumerate(of) if kind == of[f]] for f in first]
        self.worlds = [
            torch.tensor([k * share + world for k in runs for world in range(share)], device=device)
            for runs in self.members
        ]
        self._places = torch.cat(self.worlds).argsort()

    def widened(self, times: int) -> "Kinds":
        """With so many times the worlds for each run."""
        return Kinds(self._of, self._share * times, self._device)

    def split(self, values: Tensor, dim: int) -> list[Tensor]:
        """Part of each kind, of values with the worlds along an axis."""
        if len(self.members) == 1:
            return [values]
        return [values.index_select(dim, worlds) for worlds in self.worlds]

    def join(self, parts: Sequence[Tensor], dim: int) -> Tensor:
        """Values of all worlds from those of each kind."""
        return parts[0] if len(parts) == 1 else torch.cat(list(parts), dim).index_select(dim, self._places)


class Observers(Observer):
    """Observers of all runs. What observers that are alike see before they encode it is the same, up to rounding, and computed once.

    Attributes:
        size: Number of features of the observer that has most of them; those of a run come first.
        stacks: Encoders of each kind.
    """

    def __init__(self, runs: Sequence[Run], share: int):
        super().__init__()
        model, device = runs[0].model, runs[0].model.device
        state = probe(model)
        self._eyes: list[Observer] = []
        seen: list[Tensor] = []
        eyes = [_known(self._eyes, seen, run.observer, model, state) for run in runs]
        self._shapes = [one.shape[1:] for one in seen]
        self._shape_of = [self._shapes[eye] for eye in eyes]
        self._numbers = max(map(math.prod, self._shapes))
        self._seeing = Kinds(eyes, share, device)
        self._encoding = Kinds([run.settings.observer for run in runs], share, device)
        parts = zip(self._encoding.members, self._encoding.worlds, strict=True)
        self.stacks = [
            Stacked(
                [_Encoder(runs[k].observer) for k in members],
                (0,),
                (seen[eyes[members[0]]][worlds].unflatten(0, (len(members), -1)),),
            )
            for members, worlds in parts
        ]
        self.size = max(run.observer.size for run in runs)

    def widened(self, times: int) -> "Observers":
        """The same observers for so many times the worlds of each run."""
        wide = copy.copy(self)
        wide._seeing, wide._encoding = self._seeing.widened(times), self._encoding.widened(times)
        return wide

    def observe(self, model: Model, state: State) -> Tensor:
        seen = [eye.observe(model, state) for eye in self._eyes]
        if len(seen) == 1:
            return seen[0]
        own = [one.flatten(1)[worlds] for one, worlds in zip(seen, self._seeing.worlds, strict=True)]
        return self._seeing.join([_filled_up(one, self._numbers) for one in own], 0)

    def shown(self, k: int, observation: Tensor) -> Tensor:
        """The observation of some worlds of a run, shape (..., world, ...), as its own observer gives it."""
        if len(self._eyes) == 1:
            return observation
        shape = self._shape_of[k]
        return observation[..., : math.prod(shape)].unflatten(-1, shape)

    def encode(self, observation: Tensor) -> Tensor:
        parts = zip(self.stacks, self._encoding.members, self._encoding.split(observation, 0), strict=True)
        found = [
            stack(self.shown(members[0], part).unflatten(0, (len(members), -1))).flatten(end_dim=1)
            for stack, members, part in parts
        ]
        return self._encoding.join([_filled_up(one, self.size) for one in found], 0)


class Policies:
    """Policies of all runs for all worlds; those of runs at rest give no activation.

    Args:
        resting: Whether each run is at rest, shape (run,); may change.

    Attributes:
        stacks: Policies of each kind.
    """

    def __init__(self, runs: Sequence[Run], share: int, resting: Tensor):
        model, self._resting = runs[0].model, resting
        kinds = [
            (dataclasses.replace(run.settings.policy, gain=None, feature_gain=None), run.observer.size)
            for run in runs
        ]
        self._kinds = Kinds(kinds, share, model.device)
        self._numbers = [torch.tensor(members, device=model.device) for members in self._kinds.members]
        self._sizes = [runs[members[0]].observer.size for members in self._kinds.members]
        self.stacks = [
            Stacked([runs[k].policy for k in members], (0, None, 0), _example(runs, members, share))
            for members in self._kinds.members
        ]

    def widened(self, times: int) -> "Policies":
        """The same policies for so many times the worlds of each run."""
        wide = copy.copy(self)
        wide._kinds = self._kinds.widened(times)
        return wide

    def __call__(self, z: Tensor, time: Tensor, goal: Tensor | None = None) -> Tensor:
        features = self._kinds.split(z, -2)
        goals = [None] * len(features) if goal is None else self._kinds.split(goal, 0)
        return self._kinds.join(
            [self._of_kind(n, features[n], time, goals[n]) for n in range(len(features))], -2
        )

    def _of_kind(self, n: int, z: Tensor, time: Tensor, goal: Tensor | None) -> Tensor:
        count = len(self._numbers[n])
        goals = None if goal is None else goal.unflatten(0, (count, -1))
        features = z[..., : self._sizes[n]].unflatten(-2, (count, -1)).movedim(-3, 0)
        resting = self._resting[self._numbers[n]].view(-1, *(1,) * (features.dim() - 1))
        # The weights of a run that failed may be nan, and nothing of them may reach its simulation or the gradient of it:
        found = self.stacks[n](features.masked_fill(resting, 0.0), time, goals)
        return found.masked_fill(resting, 0.0).movedim(0, -3).flatten(-3, -2)

    @property
    def weights(self) -> list[Tensor]:
        """Parameters with respect to which a gradient is taken; :meth:`split` gives each run its part."""
        return [weight for stack in self.stacks for weight in stack.weights]

    def split(self, gradients: Sequence[Tensor]) -> list[list[Tensor]]:
        """Gradients with respect to the parameters of each run's policy, from those with respect to :attr:`weights`."""
        rest, found = iter(gradients), dict[int, list[Tensor]]()
        for stack, members in zip(self.stacks, self._kinds.members, strict=True):
            parts = stack.split([next(rest) for _ in stack.weights])
            found |= dict(zip(members, parts, strict=True))
        return [found[k] for k in range(len(found))]


class Designs:
    """Designs of all runs for all worlds; runs at rest have the scene's material."""

    def __init__(self, runs: Sequence[Run], share: int, resting: Tensor):
        self.each: list[Design] = [run.design for run in runs]
        self.resting, self.share = resting, share
        self._start: dict[str, Tensor] = {}
        for design in self.each:
            self._start |= design.start

    def widened(self, times: int) -> "Designs":
        """The same designs for so many times the worlds of each run."""
        wide = copy.copy(self)
        wide.share = self.share * times
        return wide

    def __call__(self) -> tuple[Params, Inputs]:
        """Shape (world, particle) or (world, muscle) where a run designs it."""
        found = [design() for design in self.each]
        params, inputs = found[0]
        own = {name: self._for_worlds(name, [getattr(p, name) for p, _ in found]) for name in params._fields}
        given = {
            name: self._for_worlds(name, [getattr(i, name) for _, i in found])
            for name, value in inputs._asdict().items()
            if value is not None
        }
        return params._replace(**own), inputs._replace(**given)

    def _for_worlds(self, name: str, values: list[Tensor]) -> Tensor:
        if name not in self._start:
            return values[0]
        chosen = torch.where(self.resting[:, None], self._start[name], torch.stack(values))
        return chosen[:, None].expand(-1, self.share, -1).flatten(end_dim=1)


class _Encoder(nn.Module):
    """The second step of an observer, as a module."""

    def __init__(self, observer: Observer):
        super().__init__()
        self.observer = observer

    def forward(self, observation: Tensor) -> Tensor:
        return self.observer.encode(observation)


@torch.no_grad()
def _known(eyes: list[Observer], seen: list[Tensor], observer: Observer, model: Model, state: State) -> int:
    """Number of the observer that is alike in its first step and sees the same; a new one is added, with what it saw."""
    found = observer.observe(model, state)
    for n, (eye, other) in enumerate(zip(eyes, seen, strict=True)):
        near = ROUNDING[other.dtype] * other.abs().max()
        same = other.shape == found.shape and bool((found - other).abs().max() <= near)
        if same and alike(_first_step(eye), _first_step(observer)):
            return n
    eyes.append(observer)
    seen.append(found)
    return len(eyes) - 1


def _first_step(observer: Observer) -> tuple[type, dict[str, Any]]:
    """Class and attributes of an observer, of a learned one without those of its second step."""
    second = {"encoder", "size", "trained"} if isinstance(observer, Latent) else set()
    parts = vars(observer) | observer._modules
    return type(observer), {name: parts[name] for name in parts if name not in {"_modules", *second}}


def _example(runs: Sequence[Run], members: Sequence[int], share: int) -> tuple:
    """Inputs for policies of one kind: features, time and goals."""
    first, model = runs[members[0]], runs[0].model
    place = {"dtype": model.dtype, "device": model.device}
    shape = len(members), share, first.observer.size
    goal = first.goals.middle()
    goals = None if goal is None else goal.expand(len(members), *goal.shape)
    features = torch.linspace(-1.0, 1.0, math.prod(shape), **place).view(shape)
    return features, torch.tensor(0.3, **place), goals


def _filled_up(values: Tensor, size: int) -> Tensor:
    """With zeros along the last axis up to a size."""
    return values if values.shape[-1] == size else functional.pad(values, (0, size - values.shape[-1]))
