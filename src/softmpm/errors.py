"""Run-time failures: how a kernel reports one, and how it reaches the user.

A kernel that meets a failure lowers one 64-bit word of its world, ``words[world]``, to (substep, kind, particle); the first
failure has the smallest word and stays. From then on that world is left as it is, so the offending value is still there when the
word is read, and nothing is written out of bounds. Other worlds go on, unchanged.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from enum import IntEnum
from typing import Any

import torch

from softmpm.state import Low, State

NEVER = 2**63 - 1
FROZEN = NEVER - 1
"""Word of a world that takes no part: it stays as it is, and is no failure."""
SUBSTEP_SHIFT, KIND_SHIFT = 36, 32
MAX_SUBSTEP = 2 ** (63 - SUBSTEP_SHIFT) - 1


class Kind(IntEnum):
    """Kinds of failure; of several within a substep, the smallest kind of a world is reported."""

    START = 0
    NOT_FINITE = 1
    LEFT_GRID = 2
    GRADIENT = 4
    LEFT_WINDOW = 5
    """Not the grid but the part of it that is in memory: the call starts again with a larger one."""
    STEP = 6
    TORN = 7
    COLLAPSED = 8
    IN_WALL = 9
    OVERLAP = 10


_PLACE: ContextVar[str] = ContextVar("place", default="")


def place() -> str:
    """The notes of the blocks of :func:`noted` around, empty outside."""
    return _PLACE.get()


@contextmanager
def at(place: str) -> Iterator[None]:
    """Make errors in the block with these notes, and no others."""
    token = _PLACE.set(place)
    try:
        yield
    finally:
        _PLACE.reset(token)


@contextmanager
def noted(note: str) -> Iterator[None]:
    """Add a note, such as the place of a call among others, to every :class:`UnstableError` of the calls that are made in the block:
    raised, collected, or met in a backward pass later.

    Example:
        >>> with softmpm.noted("In control step 3."):
        ...     state = softmpm.simulate(model, state, activation, params, substeps=10)
    """
    with at(f"{note} {place()}".strip()):
        yield


class UnstableError(RuntimeError):
    """A particle became non-finite, collapsed or left the grid, numerical fracture, too large a dt, or a gradient that overflowed.

    Attributes:
        kind: One of ``start``, ``not_finite``, ``left_grid``, ``inverted`` (det F ≤ 0), ``collapsed`` (det F below its limit),
            ``torn`` (neighbours at rest too far apart), ``step`` (dt above the running stable step), ``in_wall`` (a surface point is
            deep inside a wall), ``overlap`` (bodies, or parts of one, pass through each other), ``gradient``; and in the learner
            ``activation``.
        world, particle: Where. In a backward pass ``particle`` is the one whose adjoint is not finite, for ``in_wall`` the one next to
            the surface point, and -1 for ``activation``.
        substep: Substep of the call, counted from 0; in a backward pass the one being differentiated.
        value: The offending value.
        limit: The limit that it violates.
        state: State of every world at the end of the chunk (at most 128 substeps, docs/memory.md) in which one failed; that one
            stopped where it failed. None in a backward pass.
    """

    def __init__(
        self,
        message: str,
        *,
        kind: str,
        world: int,
        particle: int,
        substep: int,
        value,
        limit: str,
        state=None,
    ):
        super().__init__(message)
        self.kind = kind
        self.world, self.particle, self.substep = world, particle, substep
        self.value, self.limit, self.state = value, limit, state
        if place():
            self.add_note(place())

    def __reduce__(self):
        """For pickle and copy, so that a failure in another process arrives whole; the state arrives on the CPU."""
        about = self.__dict__ | {
            "state": None if self.state is None else _arrays(self.state.detach().to("cpu"))
        }
        return _restored, (type(self), self.args, about)


def _restored(kind: type[UnstableError], args: tuple, about: dict[str, Any]) -> UnstableError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(about)
    if error.state is not None:
        *tensors, low = error.state
        x, v, C, F = map(torch.from_numpy, tensors)
        error.state = State(x, v, C, F, None if low is None else Low(*map(torch.from_numpy, low)))
    return error


def _arrays(state: State) -> tuple:
    """As NumPy arrays: PyTorch would send tensors as handles on memory of the sender, which may have ended by then."""
    low = None if state.low is None else tuple(tensor.numpy() for tensor in state.low)
    return *(tensor.numpy() for tensor in state[:4]), low


def decode(word: int) -> tuple[int, Kind, int]:
    """(substep, kind, particle) of a status word."""
    return word >> SUBSTEP_SHIFT, Kind((word >> KIND_SHIFT) & 0xF), word & 0xFFFFFFFF
