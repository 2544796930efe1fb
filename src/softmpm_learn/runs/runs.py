"""Runs side by side in one simulation: each has worlds of its own, and none of them sees the others.

On a GPU one robot of a few thousand particles leaves most of the device idle, so many runs in one simulation cost far less than one
after another. Policies and encoders are evaluated at once (:mod:`softmpm_learn.runs.side_by_side`). What is learned, drawn at random
and saved belongs to the runs, as if each were alone; a single run is the case of one.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from softmpm import UnstableError
from softmpm_learn.design import declared_inputs
from softmpm_learn.runs.loops import ClosedLoop, Evaluator, starts_at_once
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.side_by_side import Designs, Observers, Policies
from softmpm_learn.runs.stacking import Stacked
from softmpm_learn.settings import Settings


class Runs:
    """Runs of one task in the worlds of one model: run k has the k-th share of them.

    Settings may differ in what is no part of the simulation or of the loop, see :func:`shared`.

    Attributes:
        all: The runs.
        errors: Why those that failed ended, by their number.
        loop: Simulates and differentiates all of them as they are.
        evaluator: Simulates them for an evaluation, ``train.endurance`` times as long as an episode.
        observer, policy, design: Those of all runs, for all worlds.
    """

    def __init__(self, runs: Sequence[Run]):
        self.all, first = list(runs), runs[0]
        self.task, self.model, self.group = first.task, first.model, first.group
        self.share = self.model.worlds // len(runs)
        self.errors: dict[int, Exception] = {}
        for run in runs:
            need_equal(first.settings, run.settings)
        self._resting = torch.zeros(len(runs), dtype=torch.bool, device=self.model.device)
        self.observer, self.policy, self.design = first.observer, first.policy, first.design
        self._together: tuple[Observers, Policies, Designs] | None = None
        if len(runs) > 1:
            for k, run in enumerate(runs):
                run.name = self.name(k)
                if run.learner is not None:
                    run.learner.name = run.name
            about = self.share, self._resting
            self._together = Observers(runs, self.share), Policies(runs, *about), Designs(runs, *about)
            self.observer, self.policy, self.design = self._together
        self.evaluator = self._make_evaluator()
        self.loop = ClosedLoop(
            self.task,
            self.model,
            self.observer,
            self.policy,
            self.design,
            self._together[1].weights
            if self._together
            else [p for p in first.policy.parameters() if p.requires_grad],
            [p for run in runs for p in run.design.parameters()],
            runs=len(runs),
            keep_every=first.settings.learning.frame_every if any(run.learner for run in runs) else 0,
            fade=first.settings.optimizer.fade or math.inf,
            records=any(run.settings.train.record_every for run in runs),
        )

    def _make_evaluator(self) -> Evaluator:
        first = self.all[0]
        episodes = first.settings.train.endurance or 1
        task = dataclasses.replace(self.task, control_steps=episodes * self.task.control_steps)
        if episodes == 1:
            task = dataclasses.replace(task, lasting=None)
        times = starts_at_once(task)
        model = first.model_of(task, times * self.model.worlds) if times > 1 else self.model
        if not self._together:
            return Evaluator(task, model, self.observer, self.policy, self.design)
        observers, policies, designs = self._together
        wide = observers.widened(times), policies.widened(times), designs.widened(times)
        return Evaluator(task, model, *wide)

    @property
    def stacks(self) -> list[Stacked]:
        """Encoders and policies that are evaluated at once, of each kind."""
        if self._together is None:
            return []
        observers, policies, _ = self._together
        return [*observers.stacks, *policies.stacks]

    @property
    def active(self) -> list[int]:
        """Numbers of the runs that go on: not at their last iteration, not failed."""
        last = self.all[0].settings.train.iterations
        return [k for k, run in enumerate(self.all) if run.iteration < last and k not in self.errors]

    def name(self, k: int) -> str:
        """Name of a run: its seed, and its folder where several have that seed."""
        run = self.all[k]
        alike = sum(one.settings.train.seed == run.settings.train.seed for one in self.all) > 1
        return f"seed {run.settings.train.seed}" + (f" in {run.out}" if alike else "")

    def worlds(self, k: int) -> slice:
        """Worlds of a run in the model."""
        return slice(k * self.share, (k + 1) * self.share)

    def move(self, moving: Sequence[int]) -> None:
        """Let the robots of these runs move; the others stay at rest, with the scene's material, which cannot fail."""
        rests = [k not in moving for k in range(len(self.all))]
        self._resting.copy_(torch.tensor(rests))
        for stack in self.stacks:
            stack.attach()

    def owner(self, error: UnstableError, times: int = 1) -> int:
        """Number of the run in whose world a simulation failed, of a model with so many times the worlds."""
        return error.world // (times * self.share)

    def failed(self, errors: Sequence[UnstableError], times: int = 1) -> dict[int, UnstableError]:
        """The first of some failures in the worlds of each run that has one, by its number."""
        return {self.owner(error, times): error for error in reversed(errors)}

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
                for one in self.loop.errors if len(self.all) > 1 else ():
                    name = self.name(self.owner(one))
                    one.add_note(f"World {one.world} is world {one.world % self.share} of {name}.")
                raise

    def goals(self, drawing: Sequence[int]) -> Tensor | None:
        """Goals of all worlds [m], shape (world, dim), drawn by these runs, for the others without chance; None for the task's own."""
        found = [run.goals.draw() if k in drawing else run.goals.middle() for k, run in enumerate(self.all)]
        return _joined(found)

    def middle_goals(self) -> Tensor | None:
        """As :meth:`goals`, without chance: the middle of the box."""
        return self.goals([])

    def evaluation_goals(self) -> list[Tensor]:
        """Goals to evaluate at, one tensor for each simulation of all worlds."""
        rounds = zip(*(run.goals.fixed() for run in self.all), strict=True)
        return [torch.cat(goals) for goals in rounds]

    def observations(self, k: int, pictures: Tensor) -> Tensor:
        """Those of a run, shape (frame, world, ...), out of the observations of all worlds."""
        if self._together is None:
            return pictures  # of several processes those of all
        return self._together[0].shown(k, pictures[:, self.worlds(k)])

    def split(self, gradients: Sequence[Tensor]) -> list[list[Tensor]]:
        """Gradients with respect to policy and design of each run, from what :attr:`loop` gives."""
        if self._together is None:
            return [list(gradients)]
        count = len(self.loop.weights)
        parts, rest = self._together[1].split(gradients[:count]), iter(gradients[count:])
        return [
            part + [next(rest) for _ in run.design.parameters()]
            for part, run in zip(parts, self.all, strict=True)
        ]


def shared(settings: Settings) -> dict[str, object]:
    """Settings that runs of one simulation have in common, by their names: those that are part of the simulation, or of the loop."""
    train = {f"train.{name}": value for name, value in vars(settings.train).items() if name != "seed"}
    return train | {
        "optimizer.fade": settings.optimizer.fade,
        "learning.frame_every": settings.learning.frame_every,
        "design's inputs": declared_inputs(settings.design),
    }


def need_equal(one: Settings, other: Settings) -> None:
    """Raise ValueError unless two settings differ only in what runs of one simulation may have of their own."""
    for name, value in shared(one).items():
        if shared(other)[name] != value:
            raise ValueError(
                f"runs side by side share {name}; here it is {value} and {shared(other)[name]}. What may differ is train.seed and the "
                "settings of observer, policy, design, learning and optimizer, except for design.strength, design.viscosity, "
                "learning.frame_every and optimizer.fade."
            )


def _joined(goals: Sequence[Tensor | None]) -> Tensor | None:
    """Goals of all worlds of the model from those of each run."""
    known = [goal for goal in goals if goal is not None]
    return torch.cat(known) if known else None
