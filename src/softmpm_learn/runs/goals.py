"""Goals of the simulations of a run: drawn from a box, at fixed points of it for evaluations, or the task's own."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from softmpm import Model
from softmpm_learn.policy import Goal
from softmpm_learn.seeding import stream
from softmpm_learn.settings import TrainConf
from softmpm_learn.tasks.task import Task


class Goals:
    """Goals of the worlds of one process [m]; every method gives None, or nothing, where the task's own goal is that of all.

    Every process draws for all worlds of the run and takes its own, so that goals do not depend on the number of processes.

    Attributes:
        box: Where goals are drawn, None: they are not.
        stream: The random numbers.
    """

    def __init__(self, task: Task, model: Model, conf: TrainConf, worlds: range):
        """``worlds`` are those of this process, of all of the run."""
        self._conf, self._worlds, self._model = conf, worlds, model
        self.stream = stream(conf.seed, "goals")
        self.box = _box(task, model, conf.goal_spread)

    def draw(self) -> Tensor | None:
        """A goal for each world, shape (world, dim)."""
        if self.box is None:
            return None
        size = self._conf.worlds, self._model.dim
        return self._at(self.box, torch.rand(size, generator=self.stream, dtype=self._model.dtype))

    def fixed(self) -> list[Tensor]:
        """Goals to evaluate at, as :meth:`draw`, one tensor for each simulation of all worlds.

        The points of a Sobol sequence: they fill the box evenly, begin with its middle, and are the same in every run.
        """
        if self.box is None:
            return []
        conf = self._conf
        rounds = math.ceil(conf.evaluation_goals / conf.worlds)
        sobol = torch.quasirandom.SobolEngine(self._model.dim)
        sobol.fast_forward(1)  # past the corner
        places = sobol.draw(rounds * conf.worlds, dtype=self._model.dtype)
        return [self._at(self.box, place) for place in places.split(conf.worlds)]

    def middle(self) -> Tensor | None:
        """As :meth:`draw`, without chance: the middle of the box."""
        return None if self.box is None else self.box.centre.expand(len(self._worlds), -1)

    def _at(self, box: Goal, place: Tensor) -> Tensor:
        """Goals of this process's worlds at places in the box, shape (world, dim), each in [0, 1]."""
        spread = torch.tensor(list(self._conf.goal_spread)).to(box.centre)
        mine = place[self._worlds.start : self._worlds.stop].to(spread.device)
        return box.centre + spread * (2 * mine - 1)


def _box(task: Task, model: Model, spread: Sequence[float]) -> Goal | None:
    if not any(spread):
        return None
    if task.goal is None or len(spread) != model.dim:
        raise ValueError(
            f"train.goal_spread needs a task with a goal and {model.dim} lengths; task {task.name} has goal {task.goal}, "
            f"train.goal_spread is {list(spread)}."
        )
    centre, width = (torch.tensor(np.asarray(v), dtype=model.dtype) for v in (task.goal, spread))
    return Goal(centre, width).to(model.device)
