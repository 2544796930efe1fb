"""Terms of an objective: what all have in common, and the motion that they see."""

import functools
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from softmpm import State
from softmpm_learn.unchanged import need_unchanged, versions

Sum = Literal["states", "steps", "way"]
"""Sum that a term's value is, see :attr:`Term.adds_up`."""


class Path:
    """Motion in an episode, as terms see it: states at the beginning and at the end of every control step, one more than steps.

    A term has a window of time: :meth:`Term.window` gives the states that lie in it, as in ``path.x[self.window(path)]``, and
    :meth:`Term.steps` the control steps, as in ``path.activation[self.steps(path)]``.

    Attributes:
        x: Positions [m], shape (state, world, particle, dim). Differentiable.
        v: Velocities [m/s], shape (state, world, particle, dim). Differentiable.
        times: Times of the states [s], a list: 0, the control period, and so on.
        states: The states themselves, a list of :class:`softmpm.State`, whose tensors have no axis ``state``. Differentiable.
        activation: Activations during the control steps [-], shape (step, world, muscle). Differentiable.
        goal: Goal of each world [m], shape (world, dim), or None if it is the task's own.
    """

    def __init__(
        self, times: Sequence[float], states: Sequence[State], activation: Tensor, goal: Tensor | None = None
    ):
        self.times, self.states, self.activation, self.goal = list(times), list(states), activation, goal

    @functools.cached_property
    def x(self) -> Tensor:
        """Positions [m], shape (state, world, particle, dim). Differentiable."""
        return torch.stack([state.x for state in self.states])

    @functools.cached_property
    def v(self) -> Tensor:
        """Velocities [m/s], shape (state, world, particle, dim). Differentiable."""
        return torch.stack([state.v for state in self.states])

    @property
    def versions(self) -> list[int]:
        """Changes of each part in place, a number each; 0 for a part that no term has read."""
        stacks = vars(self).get("x"), vars(self).get("v")
        return versions(
            [*stacks, self.activation, self.goal, *(part for one in self.states for part in one[:4])]
        )


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


@dataclass(frozen=True, kw_only=True)
class Term(Placed, ABC):
    """A term of an objective: its weight times its value. Smaller is better."""

    adds_up: ClassVar[Sum | None] = None
    """Shares of a control step in the value, by which environments give rewards (docs/gym.md): "states" if the value is a mean over
    the states of the window, each seen alone, "steps" if over its control steps, "way" if a sum over the control steps that lie in it.
    None, for all other values, costs more: a step has the change of the value of the episode so far. A class with a ``value`` of its
    own does not inherit it."""
    weight: float = 1.0
    begin: float = 0.0
    """The window begins here [s]; the state of that time counts."""
    end: float = math.inf
    """The window ends here [s]; the state of that time counts."""

    def __init_subclass__(cls, **settings: Any):
        super().__init_subclass__(**settings)
        if "value" in vars(cls) and "adds_up" not in vars(cls):
            cls.adds_up = None
        if cls.adds_up not in (None, *get_args(Sum)):
            raise ValueError(
                f"adds_up of {cls.__name__} must be one of {', '.join(get_args(Sum))} or None, got {cls.adds_up!r}."
            )

    @abstractmethod
    def value(self, path: Path) -> Tensor:
        """Value of each world without the weight, shape (world,), in a unit of the term's own. Differentiable.

        Args:
            path: All of the episode; the term counts what lies in its :meth:`window`.
        """

    def value_of_each_world(self, path: Path) -> Tensor:
        """The value, shape (world,).

        Raises:
            ValueError: It was computed in place, or has another shape. One number for all would add to the loss of each world, and to
                the gradients of others.
        """
        before, value = path.versions, self.value(path)
        need_unchanged(f"the objective's term {self.name}", "the motion", before, path.versions)
        wanted = tuple(path.states[0].x.shape[:1])
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        if got != wanted:
            raise ValueError(
                f"the value of the objective's term {self.name} must be a tensor of shape (world,) = {wanted}, a number for each "
                f"world, got {got}; path.x has the axes (state, world, particle, dim)."
            )
        return value

    @property
    def name(self) -> str:
        """Column of metrics.csv."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(self).__name__).lower()

    def window(self, path: Path) -> slice:
        """The states of the window, for the axis ``state`` of :class:`Path`.

        Raises:
            ValueError: There is none.
        """
        near = (
            1e-3 * path.times[:2][-1]
        )  # of a control step: the first part of an episode has the windows of all of it
        inside = [k for k, time in enumerate(path.times) if self.begin - near <= time <= self.end + near]
        if not inside:
            raise ValueError(
                f"the objective's term {self.name} has a window from {self.begin:g} to {self.end:g} s without a state; the episode "
                f"ends at {path.times[-1]:g} s."
            )
        return slice(inside[0], inside[-1] + 1)

    def steps(self, path: Path) -> slice:
        """The control steps between these states, or the one that ends in a single state; for the axis ``step`` of the activation."""
        states = self.window(path)
        stop = max(states.stop - 1, 1)
        return slice(min(states.start, stop - 1), stop)

    def rate(self, path: Path) -> float:
        """Value that windows of different lengths can be compared by, in the mean of the worlds."""
        return self.value(path).mean().item()

    def verdict(self, own: float, other: float) -> float:
        """Quotient of another :meth:`rate` and that of the episode, 1 if they agree."""
        return other / own if own else math.nan

    def outcome(self, x: np.ndarray, body_length: float) -> str:
        """Outcome in words, from the positions of a recorded episode, shape (frame, particle, dim); or nothing."""
        return ""


def check_terms(terms: Sequence[Any]) -> None:
    """Terms of an objective: one or more, each with a finite weight and a window that begins before it ends.

    Raises:
        TypeError: One is not a term, such as a list of terms, or the class of one.
        ValueError: There is none, a weight is not finite, or a window ends before it begins.
    """
    if not terms:
        raise ValueError("an objective needs a term, such as Objective(Progress()).")
    for term in terms:
        if not isinstance(term, Term):
            got = f"the class {term.__name__}" if isinstance(term, type) else type(term).__name__
            raise TypeError(
                f"an objective takes terms one by one, such as Objective(Progress(), Effort()), got {got}."
            )
        if not math.isfinite(term.weight):
            raise ValueError(
                f"the weight of the objective's term {term.name} must be finite, got {term.weight}."
            )
        if not term.begin <= term.end:
            raise ValueError(
                f"the window of the objective's term {term.name} must not end before it begins, got begin={term.begin:g} and "
                f"end={term.end:g} [s]."
            )
