"""Binomial checkpointing: which states a long gradient stores, and which stages it recomputes.

Griewank & Walther 2000, "Algorithm 799: revolve". The backward pass visits a chain of l stages from the last to the
first; stage i needs the state before it, and s of these states can be kept at once, the first one included.
The longest chain of which no stage runs more than r times before its own adjoint is

    β(s, r) = (s + r)! / (s! r!)                                                                     (B1)

and if β(s, r-1) < l ≤ β(s, r), then t(l, s) runs are needed, the sweep up to the last stage included:

    t(l, s) = r l - β(s + 1, r - 1)                                                                  (B2)
            = min over m of  m + t(m, s) + t(l - m, s - 1)     keep the state before stage m         (B3)

Our first sweep runs every stage, for the result, and ends with the state after the last one. The turn is thus
one more stage, whose adjoint costs nothing; the backward pass recomputes

    t(l + 1, s) - l                                                                                  (B4)
"""

from collections.abc import Iterator
from math import comb
from typing import Literal, NamedTuple


class Action(NamedTuple):
    """One move of the backward pass. Besides the kept states it has one in hand, which takes no slot."""

    kind: Literal["restore", "advance", "keep", "vjp", "drop"]
    """``restore``: the kept state comes into the hand; it stays kept, so nothing may write into it.
    ``advance``: the stage runs once; the state after it is in hand.
    ``keep``: the state in hand is also put into a free slot.
    ``vjp``: the adjoint goes through the stage, with the state before it in hand.
    ``drop``: the state is kept no longer; its slot is free."""
    stage: int
    """The stage itself, or the state before it."""


def initial_checkpoints(stages: int, slots: int) -> tuple[int, ...]:
    """Stages whose initial state the forward sweep checkpoints; the first of them is 0.

    Args:
        stages: Length of the chain.
        slots: States that can be kept at once, the one before stage 0 included.

    Raises:
        ValueError: ``stages`` or ``slots`` is less than 1.
    """
    _check(stages, slots)
    kept, at = [0], 0
    while len(kept) < slots:
        at += _split(stages + 1 - at, slots - len(kept) + 1)  # the turn is one more stage
        if at == stages:
            break
        kept.append(at)
    return tuple(kept)


def backward_schedule(stages: int, slots: int) -> Iterator[Action]:
    """Actions of the backward pass on the states of :func:`initial_checkpoints`, in order; at the end none is stored.

    No schedule for as many slots has fewer ``advance``. Arguments and errors as in :func:`initial_checkpoints`.
    """
    return _going_back(list(initial_checkpoints(stages, slots)), stages, slots)


def recomputed(stages: int, slots: int) -> int:
    """Number of ``advance`` actions in :func:`backward_schedule` (B4); 0 if each stage has a slot."""
    _check(stages, slots)
    r = _repeats(stages + 1, slots)
    return r * (stages + 1) - _reach(slots + 1, r - 1) - stages


def _going_back(kept: list[int], stages: int, slots: int) -> Iterator[Action]:
    for stage in reversed(range(stages)):
        at = kept[-1]
        yield Action("restore", at)
        while at < stage:
            ahead = at + _split(stage + 1 - at, slots - len(kept) + 1)
            yield from (Action("advance", i) for i in range(at, ahead))
            at = ahead
            if at < stage:  # the state before the stage itself is used at once
                kept.append(at)
                yield Action("keep", at)
        yield Action("vjp", stage)
        if kept[-1] == stage:
            yield Action("drop", kept.pop())


def _split(length: int, slots: int) -> int:
    """The smallest m that attains (B3), for 2 stages or more; the largest one would keep more often."""
    r = _repeats(length, slots)
    return max(_reach(slots, max(r - 2, 0)), length - _reach(slots - 1, r))


def _repeats(length: int, slots: int) -> int:
    """The smallest r with length ≤ β(slots, r)."""
    r, reach = 0, 1
    while reach < length:
        r += 1
        reach = reach * (slots + r) // r
    return r


def _reach(slots: int, repeats: int) -> int:
    """β of (B1)."""
    return comb(slots + repeats, repeats)


def _check(stages: int, slots: int) -> None:
    if stages < 1:
        raise ValueError(f"stages must be at least 1, got {stages}; an empty chain needs no schedule.")
    if slots < 1:
        raise ValueError(
            f"slots must be at least 1, got {slots}; the state before stage 0 takes one, so raise it."
        )
