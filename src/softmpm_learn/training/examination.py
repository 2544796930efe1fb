"""Examination of a finished run: does the motion last, survive a kick and another floor, and agree with a finer grid?

Each answer compares the first term of the objective with what it was in the episode, see :meth:`softmpm_learn.objective.Term.verdict`:

    later          three times as long: from T to 3T against from T/2 to T, in closed loop
    kicked         the worse of two starts with ±0.1 m/s, in closed loop
    friction       the worse of 0.75 and 1.25 times the friction of every wall, in closed loop
    finer          the same activations on the next finer grid
    largest_tilt   until 3T [degrees]
    largest_miss   of what should reach a goal: distance from it from T − 0.3 s to T + 0.5 s [m]
    largest_speed  of what should come to rest: speed in that time [m/s]

Beside them stands ``end``: the loss, or the evaluation, of the best motion, simulated once more, of a walker from other starts.

A simulation that fails has no answer, and the log says why. The robot goes on from rest, so that it does not fail again in every
control step.
"""

import dataclasses
import logging
import math
from typing import Any

import numpy as np
import torch

import softmpm
from softmpm import Failures, State
from softmpm_learn.distributed import in_full
from softmpm_learn.episode import Frame, kicked, note_of, run_episode
from softmpm_learn.objective import Reach, Still, Tilt
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.storage.sweep import EXAMINED
from softmpm_learn.tasks.task import Task
from softmpm_learn.term import Path, Term

LONGER = 3
"""Length of the continued motion over that of an episode."""
KICK = 0.1
"""Speed of the start along the first axis [m/s]."""
FRICTION = 0.75, 1.25
BEFORE, AFTER = 0.3, 0.5
"""Durations before and after the end of an episode during which a held goal must be kept at rest [s]."""

logger = logging.getLogger("softmpm_learn")


@torch.no_grad()
def examine(runs: Runs, finer: Task | None = None) -> list[dict[str, float]]:
    """The answers of each run by their names; nan where there is none.

    Args:
        runs: With the policies and the designs that are examined.
        finer: The same task on a finer grid, None to leave that out.
    """
    task = runs.task
    longer = dataclasses.replace(task, control_steps=LONGER * task.control_steps)
    own = motion(runs, task, "the episode itself")
    motions = {
        "long": [motion(runs, longer, "later")],
        "kicked": [motion(runs, task, "kicked", kick=v) for v in (KICK, -KICK)],
        "friction": [motion(runs, rubbed(task, f), "friction") for f in FRICTION],
        "finer": [replayed(runs, finer, own)] if finer is not None else [],
    }
    each = [{name: [paths[k] for paths in found] for name, found in motions.items()} for k in range(len(own))]
    return [_answers(task, finer, *of_run) for of_run in zip(own, each, strict=True)]


def _answers(
    task: Task, finer: Task | None, own: Path | None, motions: dict[str, list[Path | None]]
) -> dict[str, float]:
    """Answers of one run, from its motion in the episode and from the others by their names."""
    found = dict.fromkeys(EXAMINED, math.nan)
    if own is None:
        return found
    term, T, (long,) = task.objective.terms[0], task.seconds, motions["long"]

    def against(paths: list[Path | None], like: Term = term) -> float:
        """Verdict on the worst, nan if one is not known."""
        rates = [math.nan if path is None else like.rate(path) for path in paths]
        return math.nan if any(map(math.isnan, rates)) else term.verdict(term.rate(own), max(rates))

    if long is not None:
        late, then = (dataclasses.replace(term, begin=a, end=b) for a, b in ((T / 2, T), (T, LONGER * T)))
        found["later"] = term.verdict(late.rate(own), then.rate(long))
    for name in ("kicked", "friction"):
        found[name] = against(motions[name])
    if finer is not None:
        found["finer"] = against(motions["finer"], finer.objective.terms[0])
    if long is not None:
        found |= _extremes(task, long)
    return found


def _extremes(task: Task, long: Path) -> dict[str, float]:
    """Largest tilt, and largest distance and speed around the end of the episode, as far as the objective has such terms."""
    window, found = dict(begin=task.seconds - BEFORE, end=task.seconds + AFTER), {}
    for term in reversed(task.objective.terms):  # of several of a kind the first counts
        if isinstance(term, Tilt):
            found["largest_tilt"] = dataclasses.replace(term, begin=0.0, end=math.inf).degrees(long)
        elif isinstance(term, Reach):
            found["largest_miss"] = dataclasses.replace(term, **window).farthest(long)
        elif isinstance(term, Still):
            found["largest_speed"] = dataclasses.replace(term, **window).fastest(long)
    return found


def motion(runs: Runs, task: Task, name: str, kick: float = 0.0) -> list[Path | None]:
    """Motion of each run under its policy in a task with the same robot; None where its simulation failed.

    Args:
        name: Of the question, for the log.
        kick: Speed of the start along the first axis [m/s].
    """
    model, (params, inputs) = runs.all[0].model_of(task, runs.model.worlds), runs.design()
    start = model.rest()
    start = kicked(start, start.v.new_full((model.worlds,), kick))
    frames, failures = list[Frame](), Failures("reset")
    settings: dict[str, Any] = dict(inputs=inputs, goal=runs.middle_goals(), start=start, failures=failures)
    run_episode(task, model, runs.observer, runs.policy, params, **settings, on_frame=frames.append)
    activation = torch.stack([frame.activation for frame in frames if frame.activation is not None])
    times, states = [frame.time for frame in frames], [frame.state for frame in frames]
    return _each(runs, name, failures, Path(times, states, activation, runs.middle_goals()))


def replayed(runs: Runs, task: Task, own: list[Path | None]) -> list[Path | None]:
    """Motion of the robots of another task, with the same muscles, under the activations of these motions and the runs' designs."""
    model, (params, inputs) = runs.all[0].model_of(task, runs.model.worlds), transferred(runs, task)
    known = next((path.activation for path in own if path is not None), None)
    if known is None:
        return own
    rows = torch.cat([torch.zeros_like(known) if path is None else path.activation for path in own], dim=1)
    states, failures = [model.rest()], Failures("reset")
    settings: dict[str, Any] = dict(substeps=task.substeps, inputs=inputs, failures=failures)
    for step, row in enumerate(rows):
        with softmpm.noted(note_of(step, task)):
            states.append(softmpm.simulate(model, states[-1], row[None], params, **settings))
    times = [task.control_period * k for k in range(len(states))]
    return _each(runs, "finer", failures, Path(times, states, rows, runs.middle_goals()))


def _each(runs: Runs, name: str, failures: Failures, path: Path) -> list[Path | None]:
    """The part of a motion that each run has, None where one of its worlds failed, which the log tells."""
    failed = runs.failed(failures.errors)
    for k, error in failed.items():
        of = f" of {runs.all[k].name}" if runs.all[k].name else ""
        logger.warning("Examination%s, %s: %s", of, name, in_full(error))
    return [None if k in failed else _in_worlds(path, runs.worlds(k)) for k in range(len(runs.all))]


def _in_worlds(path: Path, worlds: slice) -> Path:
    """The motion in some of the worlds."""
    states = [State.of([tensor[worlds] for tensor in state[:4]]) for state in path.states]
    return Path(
        path.times, states, path.activation[:, worlds], None if path.goal is None else path.goal[worlds]
    )


def rubbed(task: Task, factor: float) -> Task:
    """The task with so many times the friction."""
    walls = [dataclasses.replace(wall, friction=factor * wall.friction) for wall in task.scene.walls]
    return dataclasses.replace(task, scene=dataclasses.replace(task.scene, walls=walls))


def transferred(run: Run | Runs, task: Task) -> tuple[softmpm.Params, softmpm.Inputs]:
    """The design of a run, or of several, on the particles of a task of the same robot: values of the particle at the nearest place."""
    from scipy.spatial import KDTree

    places = run.task.scene.positions, task.scene.positions
    old, new = ((place - place.min(axis=0)) / np.ptp(place, axis=0) for place in places)
    nearest = torch.as_tensor(KDTree(old).query(new)[1], device=run.model.device)
    params, inputs = run.design()
    found = {}
    for name, value in inputs._asdict().items():
        if value is not None and value.shape[-1] == run.model.particle_count:
            value = value[..., nearest]
        found[name] = value
    return softmpm.Params(*(value[..., nearest] for value in params)), softmpm.Inputs(**found)
