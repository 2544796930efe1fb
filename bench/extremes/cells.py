"""One cell of a map: a scene is built, run and judged after every call. Its outcome is one of four.

*right*: every call returned, and every returned state passed the criteria of its row.
*refused*: ``build`` or a call raised ValueError, which names the rule.
*stopped*: a call raised UnstableError; its kind is the note.
*silent*: a returned state fails a criterion and no error was raised.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import torch

import softmpm

from .judges import Exact, Matter, exact, least_det

LEAST_DET = 0.05
"""Least det F: a body compressed to a twentieth of its volume is outside the range of its law."""
APART = 1.4
"""Largest distance of rest neighbours [cells]; beyond it numerical fracture occurs, since they share too few nodes."""
ENERGY = 1.05
"""Largest ratio of the mechanical energy to that of the initial state plus the work of the actuators, the only source of work."""
FLIGHT = 1e-3
"""Largest deviation of a free centre of mass from the discrete law of free fall [cells]."""


class Outcome(StrEnum):
    RIGHT = "right"
    REFUSED = "refused"
    STOPPED = "stopped"
    SILENT = "silent"


@dataclass(frozen=True)
class Verdict:
    outcome: Outcome
    note: str
    """Text for the picture: least det F, kind of the error, or the failed criterion."""
    detail: str = ""
    """The whole message of an error."""


class RefusedError(Exception):
    """The library raised ValueError."""


class CriterionError(Exception):
    """A returned state fails a criterion; the message is short enough for a picture."""


@dataclass(frozen=True)
class How:
    """Settings of a map: device, formulation, precision, alarms."""

    device: str = "cpu"
    formulation: str = "moving"
    dtype: torch.dtype = torch.float32
    alarms: bool = True
    longest: int = 10_000
    """Largest number of substeps, for the rows that vary the length of a run."""


NO_ALARMS = softmpm.Alarms(collapse=None, gap=None, step=None)


def make(scene: softmpm.Scene, how: How, worlds: int = 1, inputs: tuple[str, ...] = ()) -> softmpm.Model:
    alarms = None if how.alarms else NO_ALARMS
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", softmpm.StabilityWarning)  # a warning is no outcome
        try:
            settings = dict(device=how.device, dtype=how.dtype, worlds=worlds, alarms=alarms)
            settings |= dict(formulation=how.formulation)
            return softmpm.build(scene, inputs=inputs, **settings)
        except ValueError as error:
            raise RefusedError(str(error)) from error


def call(
    model: softmpm.Model, state: softmpm.State, activation, params, substeps: int, inputs=None
) -> softmpm.State:
    try:
        return softmpm.simulate(model, state, activation, params, substeps=substeps, inputs=inputs)
    except ValueError as error:
        raise RefusedError(str(error)) from error


def verdict(cell: Callable[[], str]) -> Verdict:
    """Outcome of a cell, a function that returns the note of a right outcome."""
    try:
        return Verdict(Outcome.RIGHT, cell())
    except softmpm.UnstableError as error:
        return Verdict(Outcome.STOPPED, error.kind, str(error))
    except RefusedError as error:
        return Verdict(Outcome.REFUSED, "refused", str(error))
    except CriterionError as error:
        return Verdict(Outcome.SILENT, str(error))


@dataclass
class Run:
    """Data that a criterion judges."""

    matter: Matter
    states: list[Exact] = field(default_factory=list)
    """The initial and the latest state."""
    substeps: int = 0
    """Substeps between them."""
    least: float = np.inf
    """Least det F so far."""
    work: float = 0.0
    """Largest work that the actuators have done so far [J]."""

    @property
    def start(self) -> Exact:
        return self.states[0]

    @property
    def now(self) -> Exact:
        return self.states[-1]


Criterion = Callable[[Run], None]
"""Raises CriterionError unless the last state is right."""


def whole(run: Run) -> None:
    """No rest neighbours more than 1.4 cells apart."""
    gap = run.matter.gap(run.now)
    if not gap <= APART:
        raise CriterionError(f"gap {short(gap)}")


def not_crushed(run: Run) -> None:
    """Least det F above 0.05."""
    det = least_det(run.now)
    if not det >= LEAST_DET:
        raise CriterionError(f"det {short(det)}")


def passive(run: Run) -> None:
    """Mechanical energy at most 1.05 (start + work of the actuators)."""
    start, now = run.matter.energy(run.start), run.matter.energy(run.now)
    run.work = max(run.work, start.actuators - now.actuators)
    most = start.mechanical + run.work
    if not now.mechanical <= ENERGY * most:
        raise CriterionError(f"E ×{short(now.mechanical / most)}" if most > 0 else "E > 0")


def falls_freely(run: Run) -> None:
    """Centre of mass on the discrete law of free fall, within 1e-3 cells for 10,000 substeps.

    For more substeps n, rounding makes the momentum drift as √n, hence the position as n √n.
    """
    scene, n = run.matter.scene, run.substeps
    velocity = run.matter.momentum(run.start) / run.matter.mass.sum()
    way = n * scene.dt * velocity + 0.5 * scene.dt**2 * n * (n + 1) * np.array(scene.gravity)
    off = run.matter.center(run.now) - run.matter.center(run.start) - way
    if not np.linalg.norm(off) <= FLIGHT * max(1.0, n / 1e4) ** 1.5 * run.matter.dx:
        raise CriterionError(f"off {short(np.linalg.norm(off) / run.matter.dx)}")


def turns_on(run: Run) -> None:
    """Angular momentum within 1e-3 of the start's."""
    before, now = (run.matter.angular_momentum(state) for state in (run.start, run.now))
    change = np.linalg.norm(now - before) / np.linalg.norm(before)
    if not change <= 1e-3:
        raise CriterionError(f"L {change:+.0e}")


BODY = (not_crushed, whole, passive)
FREE = (*BODY, falls_freely)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A run: scene, initial state, loads and criteria."""

    scene: softmpm.Scene
    substeps: int
    start: Callable[[softmpm.State], softmpm.State] = lambda state: state
    activation: float = 0.0
    young_factor: float = 1.0
    """Young's modulus of the call over that of the scene."""
    inputs: Callable[[int, int], dict[str, np.ndarray]] | None = None
    """Inputs of the call between two substeps, such as the poses of a wall at both; None if the scene has all."""
    criteria: tuple[Criterion, ...] = BODY
    calls: int = 20
    """Number of calls of the run; the state after each is judged."""

    @property
    def length(self) -> int:
        """Substeps of a call."""
        return max(1, self.substeps // self.calls)


def criteria_of(case: Case, how: How) -> tuple[Criterion, ...]:
    """Criteria of a run. Neighbours in the reference formulation share their nodes for good, however far apart they are."""
    return tuple(one for one in case.criteria if one is not whole or how.formulation == "moving")


def states(case: Case, how: How) -> Iterator[softmpm.State]:
    """The initial state and the state after each call."""
    model = make(case.scene, how, inputs=() if case.inputs is None else tuple(case.inputs(0, 1)))
    params = model.params()
    params = params._replace(young=params.young * case.young_factor)
    activation = None
    if model.muscle_count:
        activation = torch.full((1, 1, model.muscle_count), case.activation).to(params.young)
    state = case.start(model.rest())
    yield state
    for k in range(case.calls):
        given = None
        if case.inputs is not None:
            arrays = case.inputs(k * case.length, (k + 1) * case.length)
            given = softmpm.Inputs(**{name: _tensor(model, name, array) for name, array in arrays.items()})
        state = call(model, state, activation, params, case.length, given)
        yield state


def _tensor(model: softmpm.Model, name: str, array: np.ndarray) -> torch.Tensor:
    dtype = torch.float64 if name in ("wall_offset", "wall_normal") else model.dtype
    return torch.as_tensor(array, dtype=dtype, device=model.device)


def judged(case: Case, how: How) -> Run:
    """Run a case and judge the state after each call."""
    run, length = Run(Matter(case.scene, case.activation, case.young_factor)), case.length
    for k, state in enumerate(states(case, how)):
        run.states = [*run.states[:1], exact(state)]
        run.substeps = k * length
        if k > 0:
            for criterion in criteria_of(case, how):
                criterion(run)
        run.least = min(run.least, least_det(run.now))
    return run


def play(case: Case, how: How) -> str:
    """Least det F of a run whose outcome is right."""
    return short(judged(case, how).least)


def short(number: float) -> str:
    """At most five characters."""
    number = float(number)
    if not np.isfinite(number) or number == 0:
        return f"{number:g}"
    if 0.01 <= abs(number) < 1000:
        text = f"{number:.2g}" if abs(number) < 100 else f"{number:.0f}"
        return text.replace("0.", ".", 1) if text.lstrip("-").startswith("0.") else text
    return f"{number:.0e}".replace("e-0", "e-").replace("e+0", "e")
