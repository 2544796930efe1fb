"""Binomial checkpointing: which states the backward pass of a long rollout stores, and which stages it recomputes.

Griewank & Walther 2000, "Algorithm 799: revolve". The backward pass visits a chain of l stages from the last to the
first; stage i needs the state before it, and s of these states can be stored at once, the first one included.
The longest chain of which no stage runs more than r times before its own adjoint is

    β(s, r) = (s + r)! / (s! r!)                                                                     (N1)

and if β(s, r-1) < l ≤ β(s, r), then t(l, s) runs are needed, the sweep up to the last stage included:

    t(l, s) = r l - β(s + 1, r - 1)                                                                  (N2)
            = min over m of  m + t(m, s) + t(l - m, s - 1)     store the state before stage m        (N3)

Here the forward pass runs every stage, for the result, and ends with the state after the last one. The reversal is thus
one more stage, whose adjoint costs nothing; the backward pass recomputes

    t(l + 1, s) - l                                                                                  (N4)
"""

from collections.abc import Iterator
from math import comb
from typing import Literal, NamedTuple


class Action(NamedTuple):
    """One action of the backward pass. Besides the checkpoints there is a current state, which takes no slot."""

    kind: Literal["restore", "advance", "keep", "vjp", "drop"]
    """``restore``: the checkpoint becomes the current state; it remains stored, so nothing may write into it.
    ``advance``: the stage runs once; the state after it becomes the current one.
    ``keep``: the current state is also stored in a free slot.
    ``vjp``: the adjoint is propagated through the stage, from the current state before it.
    ``drop``: the checkpoint is freed, and with it its slot."""
    stage: int
    """The stage itself, or the state before it."""


def initial_checkpoints(stages: int, slots: int) -> tuple[int, ...]:
    """Stages whose initial state the forward sweep checkpoints; the first of them is 0.

    Args:
        stages: Length of the chain.
        slots: States that can be stored at once, the one before stage 0 included.

    Raises:
        ValueError: ``stages`` or ``slots`` is less than 1.
    """
    _check(stages, slots)
    kept, at = [0], 0
    while len(kept) < slots:
        at += _split(stages + 1 - at, slots - len(kept) + 1)  # the reversal is one more stage
        if at == stages:
            break
        kept.append(at)
    return tuple(kept)


def backward_schedule(stages: int, slots: int) -> Iterator[Action]:
    """Actions of the backward pass on the states of :func:`initial_checkpoints`, in order; at the end none is stored.

    No schedule for as many slots has fewer ``advance``. Arguments and errors as in :func:`initial_checkpoints`.
    """
    return _backward_actions(list(initial_checkpoints(stages, slots)), stages, slots)


def recomputed(stages: int, slots: int) -> int:
    """Number of ``advance`` actions in :func:`backward_schedule` (N4); 0 if each stage has a slot."""
    _check(stages, slots)
    r = _repeats(stages + 1, slots)
    return r * (stages + 1) - _reach(slots + 1, r - 1) - stages


def _backward_actions(kept: list[int], stages: int, slots: int) -> Iterator[Action]:
    """Actions for all stages from the last to the first; ``kept`` lists the stages whose initial state is stored."""
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
    """The smallest m that attains (N3), for 2 stages or more; the largest one would store states more often."""
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
    """β of (N1)."""
    return comb(slots + repeats, repeats)


def _check(stages: int, slots: int) -> None:
    if stages < 1:
        raise ValueError(f"stages must be at least 1, got {stages}; an empty chain needs no schedule.")
    if slots < 1:
        raise ValueError(
            f"slots must be at least 1, got {slots}; the state before stage 0 takes one, so raise it."
        )
