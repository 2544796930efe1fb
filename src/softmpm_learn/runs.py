"""Runs side by side in one simulation: each has worlds of its own, and none of them sees the others.

On a GPU one robot of a few thousand particles leaves most of the device idle, so many seeds in one simulation cost far less than one
after another.
Policies and encoders of all runs are evaluated at once (:mod:`softmpm_learn.stacking`). What is learned, drawn at random and saved
belongs to the runs, as if each were alone; a single run is the case of one.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from softmpm import Failures, Inputs, Model, Params, State, UnstableError
from softmpm_learn.design import Design
from softmpm_learn.episode import ClosedLoop, Policy
from softmpm_learn.observe import Observer
from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.run import Run
from softmpm_learn.settings import Settings
from softmpm_learn.stacking import Stacked

ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-12}
"""Largest difference of two equal observations, relative to the largest value: a GPU adds up the particles at a node in any order."""


class AlsoFailedError(RuntimeError):
    """The robot of a run failed in the same replay as that of another run, whose error says how."""

    def __init__(self, run: Run):
        super().__init__(f"the robot of seed {run.settings.train.seed} failed in the same simulation.")


class Runs:
    """Runs of one task in the worlds of one model: run k has the k-th share of them.

    Settings may differ in the seed and in the numbers of the optimiser, but for its fading, which is part of the simulation.

    Attributes:
        all: The runs.
        errors: Why those that failed ended, by their number.
        loop: Simulates and differentiates all of them as they are.
        observer, policy, design: Those of all runs, for all worlds.
    """

    def __init__(self, runs: Sequence[Run]):
        self.all, first = list(runs), runs[0]
        self.task, self.model, self.group = first.task, first.model, first.group
        self.share = self.model.worlds // len(runs)
        self.errors: dict[int, Exception] = {}
        for run in runs:
            need_equal(first.settings, run.settings)
        alone = len(runs) == 1
        self._resting = torch.zeros(len(runs), dtype=torch.bool, device=self.model.device)
        self._stacks = [] if alone else [self._encoders(), self._policies()]
        self.observer = first.observer if alone else _Observers(runs, self._stacks[0])
        self.policy: Policy = first.policy if alone else _Policies(self._stacks[1], self._resting)
        self.design = first.design if alone else _Designs(runs, self._resting, self.share)
        self.loop = ClosedLoop(
            self.task,
            self.model,
            self.observer,
            self.policy,
            self.design,
            list(first.policy.parameters()) if alone else self._stacks[1].weights,
            [p for run in runs for p in run.design.parameters()],
            runs=len(runs),
            keep_every=first.settings.learning.frame_every if first.learner else 0,
            fade=first.settings.optimizer.fade or math.inf,
        )

    def _encoders(self) -> Stacked:
        with torch.no_grad():
            seen = self.all[0].observer.observe(self.model, _probe(self.model))
        return Stacked(
            [_Encoder(run.observer) for run in self.all], (0,), (seen.unflatten(0, (len(self.all), -1)),)
        )

    def _policies(self) -> Stacked:
        first, place = self.all[0], {"dtype": self.model.dtype, "device": self.model.device}
        shape = len(self.all), self.share, first.observer.size
        features = torch.linspace(-1.0, 1.0, math.prod(shape), **place).view(shape)
        goal = first.middle_goals()
        goals = None if goal is None else goal.expand(len(self.all), *goal.shape)
        probe = features, torch.tensor(0.3, **place), goals
        return Stacked([run.policy for run in self.all], (0, None, 0), probe)

    @property
    def active(self) -> list[int]:
        """Numbers of the runs that go on: not at their last iteration, not failed."""
        last = self.all[0].settings.train.iterations
        return [k for k, run in enumerate(self.all) if run.iteration < last and k not in self.errors]

    def worlds(self, k: int) -> slice:
        """Worlds of a run in the model."""
        return slice(k * self.share, (k + 1) * self.share)

    def move(self, moving: Sequence[int]) -> None:
        """Let the robots of these runs move; the others stay at rest, with the scene's material, which cannot fail."""
        rests = [k not in moving for k in range(len(self.all))]
        self._resting.copy_(torch.tensor(rests))
        for stack in self._stacks:
            stack.attach()

    def owner(self, error: UnstableError) -> int:
        """Number of the run in whose world a simulation failed."""
        return error.world // self.share

    def blamed(self, error: UnstableError) -> dict[int, Exception]:
        """Runs that a failure is of, by their number: the one that it names, and those whose robots failed in the same replay."""
        first = self.owner(error)
        others = {world // self.share for world in self.loop.failed} - {first}
        found: dict[int, Exception] = {first: error}
        return found | {k: AlsoFailedError(self.all[k]) for k in sorted(others)}

    def failed(self, failures: Failures) -> dict[int, UnstableError]:
        """The first of some failures in the worlds of each run that has one, by its number."""
        return {self.owner(error): error for error in reversed(failures.errors)}

    @contextlib.contextmanager
    def failing_together(self) -> Iterator[None]:
        """A simulation that fails in one process fails in every one; the message has the world's number within its run."""
        with self.group.fail_together(UnstableError):
            try:
                yield
            except UnstableError as error:
                if self.group.size > 1:
                    world = self.all[0].worlds[error.world]
                    error.add_note(
                        f"This was in process {self.group.rank}, whose world {error.world} is world {world} of the run."
                    )
                elif len(self.all) > 1:
                    seed = self.all[self.owner(error)].settings.train.seed
                    error.add_note(f"World {error.world} is world {error.world % self.share} of seed {seed}.")
                raise

    def goals(self, drawing: Sequence[int]) -> Tensor | None:
        """Goals of all worlds [m], shape (world, dim), drawn by these runs, for the others without chance; None for the task's own."""
        found = [run.draw_goals() if k in drawing else run.middle_goals() for k, run in enumerate(self.all)]
        return _joined(found)

    def middle_goals(self) -> Tensor | None:
        """As :meth:`goals`, without chance: the middle of the box."""
        return self.goals([])

    def evaluation_goals(self) -> list[Tensor]:
        """Goals to evaluate at, one tensor for each simulation of all worlds."""
        rounds = zip(*(run.evaluation_goals() for run in self.all), strict=True)
        return [torch.cat(goals) for goals in rounds]

    def split(self, gradients: Sequence[Tensor]) -> list[list[Tensor]]:
        """Gradients with respect to policy and design of each run, from what :attr:`loop` gives."""
        if len(self.all) == 1:
            return [list(gradients)]
        count = len(self.loop.weights)
        parts, rest = self._stacks[1].split(gradients[:count]), iter(gradients[count:])
        return [
            part + [next(rest) for _ in run.design.parameters()]
            for part, run in zip(parts, self.all, strict=True)
        ]


def need_equal(one: Settings, other: Settings) -> None:
    """Raise ValueError unless two settings differ only in what runs of one simulation may have of their own."""

    def shared(settings: Settings) -> dict[str, dict]:
        found = dataclasses.asdict(settings)
        found["optimizer"] = {"fade": settings.optimizer.fade}
        found["train"] = found["train"] | {"seed": None}
        return found

    for group, values in shared(one).items():
        for name, value in values.items():
            if shared(other)[group][name] != value:
                own = ", ".join(f.name for f in dataclasses.fields(OptimizerConf) if f.name != "fade")
                raise ValueError(
                    f"runs side by side share {group}.{name}; here it is {value} and {shared(other)[group][name]}. Only "
                    f"train.seed and these of the optimizer may differ: {own}."
                )


class _Encoder(nn.Module):
    """The second step of an observer, as a module."""

    def __init__(self, observer: Observer):
        super().__init__()
        self.observer = observer

    def forward(self, observation: Tensor) -> Tensor:
        return self.observer.encode(observation)


class _Observers(Observer):
    """Observers of all runs. What they see before they encode it is the same for equal observers, up to rounding, and computed once."""

    def __init__(self, runs: Sequence[Run], encoders: Stacked):
        super().__init__()
        self.runs, self.encoders = len(runs), encoders
        self.size = runs[0].observer.size
        self._each = [run.observer for run in runs]
        state = _probe(runs[0].model)
        with torch.no_grad():
            first, *others = (one.observe(runs[0].model, state) for one in self._each)
        near = ROUNDING[first.dtype] * first.abs().max()
        if all(bool((other - first).abs().max() <= near) for other in others):
            self._each = self._each[:1]

    def observe(self, model: Model, state: State) -> Tensor:
        if len(self._each) == 1:
            return self._each[0].observe(model, state)
        seen = [one.observe(model, state).unflatten(0, (self.runs, -1)) for one in self._each]
        return torch.cat([one[k] for k, one in enumerate(seen)])

    def encode(self, observation: Tensor) -> Tensor:
        return self.encoders(observation.unflatten(0, (self.runs, -1))).flatten(end_dim=1)


class _Policies:
    """Policies of all runs for all worlds; those of runs at rest give no activation."""

    def __init__(self, stack: Stacked, resting: Tensor):
        self.stack, self.resting, self.runs = stack, resting, len(stack.modules)

    def __call__(self, z: Tensor, time: Tensor, goal: Tensor | None = None) -> Tensor:
        goals = None if goal is None else goal.unflatten(0, (self.runs, -1))
        features = z.unflatten(-2, (self.runs, -1)).movedim(-3, 0)
        resting = self.resting.view(-1, *(1,) * (features.dim() - 1))
        # The weights of a run that failed may be nan, and nothing of them may reach its simulation or the gradient of it:
        found = self.stack(features.masked_fill(resting, 0.0), time, goals)
        return found.masked_fill(resting, 0.0).movedim(0, -3).flatten(-3, -2)


class _Designs:
    """Designs of all runs for all worlds; runs at rest have the scene's material."""

    def __init__(self, runs: Sequence[Run], resting: Tensor, share: int):
        self.each: list[Design] = [run.design for run in runs]
        self.resting, self.share = resting, share

    def __call__(self) -> tuple[Params, Inputs]:
        """Shape (world, particle) or (world, muscle) where it is designed."""
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
        start = self.each[0].start.get(name)
        if start is None:
            return values[0]
        chosen = torch.where(self.resting[:, None], start, torch.stack(values))
        return chosen[:, None].expand(-1, self.share, -1).flatten(end_dim=1)


def _probe(model: Model) -> State:
    """A state in which robots of different worlds move differently."""
    state = model.rest()
    wave = torch.linspace(0.0, 9.0, state.v.numel(), dtype=state.v.dtype, device=state.v.device).sin()
    return state._replace(v=wave.view_as(state.v))


def _joined(goals: Sequence[Tensor | None]) -> Tensor | None:
    """Goals of all worlds of the model from those of each run."""
    known = [goal for goal in goals if goal is not None]
    return torch.cat(known) if known else None
