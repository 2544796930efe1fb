"""What a sceptic would ask of a finished run: does the motion last, does it survive a kick and another floor, does a finer grid agree?

Each answer compares the first term of the objective with what it was in the episode, see :meth:`softmpm_learn.objective.Term.verdict`:

    later     three times as long: from T to 3T against from T/2 to T, in closed loop
    kicked    the worse of two starts with ±0.1 m/s, in closed loop
    friction  the worse of 0.75 and 1.25 times the friction of every wall, in closed loop
    finer     the same activations on the next finer grid
    tilt      largest tilt until 3T [degrees]

A simulation that fails has no answer, and the log says why.
"""

import dataclasses
import logging
import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

import softmpm
from softmpm import Model
from softmpm_learn.design import declared_inputs
from softmpm_learn.episode import Frame, run_episode
from softmpm_learn.objective import Tilt
from softmpm_learn.run import Run
from softmpm_learn.tasks.task import Task
from softmpm_learn.term import Path, Term

LONGER = 3
"""Length of the continued motion over that of an episode."""
KICK = 0.1
"""Speed of the start along the first axis [m/s]."""
FRICTION = 0.75, 1.25
NAMES = ["later", "kicked", "friction", "finer", "tilt"]
"""Columns of metrics.csv."""

logger = logging.getLogger("softmpm_learn")


@torch.no_grad()
def examine(run: Run, finer: Task | None = None) -> dict[str, float]:
    """The answers by their names; nan where there is none.

    Args:
        run: With the policy and the design that are examined.
        finer: The same task on a finer grid, None to leave that out.
    """
    term, task = run.task.objective.terms[0], run.task
    T = task.seconds
    own = _asked(lambda: motion(run, task), "the episode itself")
    if own is None:
        return dict.fromkeys(NAMES, math.nan)
    found = {}

    def against(path: Path | None, like: Term = term) -> float:
        return math.nan if path is None else term.verdict(term.rate(own), like.rate(path))

    long = _asked(
        lambda: motion(run, dataclasses.replace(task, control_steps=LONGER * task.control_steps)), "later"
    )
    late, then = (dataclasses.replace(term, begin=a, end=b) for a, b in ((T / 2, T), (T, LONGER * T)))
    found["later"] = math.nan if long is None else term.verdict(late.rate(own), then.rate(long))
    kicks = [_asked(lambda v=v: motion(run, task, kick=v), "kicked") for v in (KICK, -KICK)]
    found["kicked"] = term.worst([against(path) for path in kicks])
    rough = [_asked(lambda f=f: motion(run, rubbed(task, f)), "friction") for f in FRICTION]
    found["friction"] = term.worst([against(path) for path in rough])
    found["finer"] = math.nan
    if finer is not None:
        path = _asked(lambda: replayed(run, finer, own.activation), "finer")
        found["finer"] = against(path, finer.objective.terms[0])
    tilts = [one for one in task.objective.terms if isinstance(one, Tilt)]
    found["tilt"] = tilts[0].degrees(long) if tilts and long is not None else math.nan
    return found


def _asked(question: Callable[[], Path], name: str) -> Path | None:
    """The motion, or None if its simulation failed."""
    try:
        return question()
    except softmpm.UnstableError as error:
        logger.warning("Examination, %s: %s", name, error)
        return None


def motion(run: Run, task: Task, kick: float = 0.0) -> Path:
    """Motion under the policy of a run in a task with the same robot.

    Args:
        kick: Speed of the start along the first axis [m/s].
    """
    model, (params, inputs) = built(task, run, run.model.worlds), run.design()
    start = model.rest()
    start = start._replace(v=start.v + kick * torch.eye(model.dim, dtype=model.dtype, device=model.device)[0])
    frames: list[Frame] = []
    policy, goal = run.policy, run.middle_goals()
    settings = dict(inputs=inputs, goal=goal, start=start, on_frame=frames.append)
    run_episode(task, model, run.observer, policy, params, **settings)
    activation = torch.stack([frame.activation for frame in frames if frame.activation is not None])
    return Path([frame.time for frame in frames], [frame.state for frame in frames], activation, goal)


def replayed(run: Run, task: Task, activation: Tensor) -> Path:
    """Motion of the robot of another task, with the same muscles, under these activations and the design of the run."""
    model, (params, inputs) = built(task, run, run.model.worlds), transferred(run, task)
    states = [model.rest()]
    for row in activation:
        states.append(
            softmpm.simulate(model, states[-1], row[None], params, substeps=task.substeps, inputs=inputs)
        )
    goal = run.middle_goals()
    return Path([task.control_period * k for k in range(len(states))], states, activation, goal)


def rubbed(task: Task, factor: float) -> Task:
    """The task with so many times the friction."""
    walls = [dataclasses.replace(wall, friction=factor * wall.friction) for wall in task.scene.walls]
    return dataclasses.replace(task, scene=dataclasses.replace(task.scene, walls=walls))


def built(task: Task, run: Run, worlds: int = 1) -> Model:
    """Model of a task on the device of a run, with the inputs that its design gives."""
    settings = task.build | {"inputs": declared_inputs(run.settings.design), "worlds": worlds}
    return softmpm.build(task.scene, device=run.model.device, dtype=run.model.dtype, **settings)


def transferred(run: Run, task: Task) -> tuple[softmpm.Params, softmpm.Inputs]:
    """The design of a run on the particles of a task of the same robot: values of the particle at the nearest place in the robot."""
    from scipy.spatial import KDTree

    places = [
        np.concatenate([body.particles.positions for body in scene.bodies])
        for scene in (run.task.scene, task.scene)
    ]
    old, new = ((place - place.min(axis=0)) / np.ptp(place, axis=0) for place in places)
    nearest = torch.as_tensor(KDTree(old).query(new)[1], device=run.model.device)
    params, inputs = run.design()
    found = {}
    for name, value in inputs._asdict().items():
        if value is not None and value.shape[-1] == run.model.particle_count:
            value = value[..., nearest]
        found[name] = value
    return softmpm.Params(*(value[..., nearest] for value in params)), softmpm.Inputs(**found)
