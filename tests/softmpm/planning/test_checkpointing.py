"""The schedule of binomial checkpointing is possible, and no other computes less."""

from collections import deque
from functools import cache
from itertools import combinations, pairwise
from math import comb

import pytest

from softmpm.planning.checkpointing import _split, backward_schedule, initial_checkpoints, recomputed

SMALL = [(stages, slots) for stages in range(1, 31) for slots in range(1, 9)]
LARGE = [
    (1000, 1),
    (1000, 7),
    (1000, 999),
    (1000, 1001),
    (10_000, 3),
    (10_000, 20),
    (10_000, 9_999),
    (10_000, 20_000),
]


def simulate(stages: int, slots: int) -> int:
    """Executes the schedule on states that are just their place in the chain; the number of advances."""
    kept, hand, left, advances = set(initial_checkpoints(stages, slots)), None, stages, 0
    assert 0 in kept and len(kept) <= slots
    for kind, stage in backward_schedule(stages, slots):
        if kind == "restore":
            assert stage in kept
            hand = stage
        elif kind == "advance":
            assert hand == stage
            hand = stage + 1
            advances += 1
        elif kind == "keep":
            assert hand == stage and stage not in kept
            kept.add(stage)
            assert len(kept) <= slots
        elif kind == "vjp":
            assert hand == stage == left - 1
            hand, left = None, stage
        else:
            assert kind == "drop" and stage >= left
            kept.remove(stage)
    assert left == 0 and not kept
    return advances


@cache
def segment(stages: int, slots: int) -> int:
    """Fewest advances for a chain that starts with nothing but its first state: (N3), all m tried."""
    if stages == 1:
        return 0
    if slots == 1:
        return stages * (stages - 1) // 2
    return min(m + segment(m, slots) + segment(stages - m, slots - 1) for m in range(1, stages))


@cache
def optimum(stages: int, slots: int) -> int:
    """The same after a first sweep, not counted, that has kept states: the next one before stage m."""
    if slots == 1:
        return segment(stages, 1)
    keeping = (segment(m, slots) + optimum(stages - m, slots - 1) for m in range(1, stages))
    return min([segment(stages, slots), *keeping])


def shortest(stages: int, slots: int) -> int:
    """Fewest advances of any order of actions: a shortest path; an advance has length 1, the rest 0."""
    starts = [frozenset(kept) for kept in combinations(range(stages), min(slots, stages))]
    todo = deque((0, kept, stages, stages) for kept in starts)  # advances, kept, in hand, stages left
    done = set()
    while todo:
        advances, kept, hand, left = todo.popleft()
        if left == 0:
            return advances
        if (kept, hand, left) in done:
            continue
        done.add((kept, hand, left))
        todo.extendleft((advances, kept, stage, left) for stage in kept)
        todo.extendleft((advances, kept - {stage}, hand, left) for stage in kept)
        if len(kept) < slots:
            todo.appendleft((advances, kept | {hand}, hand, left))
        if hand == left - 1:
            todo.appendleft((advances, kept, hand, left - 1))
        if hand < stages:
            todo.append((advances + 1, kept, hand + 1, left))
    raise AssertionError("no schedule")


def test_small_chains_are_pulled_back_at_the_least_cost():
    for stages, slots in SMALL:
        assert simulate(stages, slots) == recomputed(stages, slots) == optimum(stages, slots), (stages, slots)


@pytest.mark.parametrize("stages", range(1, 8))
def test_nothing_beats_the_recursion(stages):
    """Neither (N3) nor a rule about what is kept when enters the search."""
    for slots in range(1, 6):
        assert recomputed(stages, slots) == shortest(stages, slots), slots


@pytest.mark.parametrize("stages, slots", LARGE)
def test_long_chains(stages, slots):
    assert simulate(stages, slots) == recomputed(stages, slots)


def test_binomial_formula():
    """(N2) is the optimum of (N3), (N4) follows from it, and the split of each length attains it."""
    for stages, slots in SMALL:
        r = next(r for r in range(stages) if comb(slots + r, r) >= stages)  # β(s, r-1) < l ≤ β(s, r)
        least = segment(stages, slots)
        assert least == (r * stages - comb(slots + r, r - 1) if r else 0), (stages, slots)
        if stages > 1:
            assert recomputed(stages - 1, slots) == least - (stages - 1), (stages, slots)
        if stages > 1 and slots > 1:
            m = _split(stages, slots)
            assert least == m + segment(m, slots) + segment(stages - m, slots - 1), (stages, slots)


@pytest.mark.parametrize("stages", [1, 2, 9, 1000])
@pytest.mark.parametrize("more", [0, 1, 50])
def test_a_slot_for_each_stage_recomputes_nothing(stages, more):
    slots = stages + more
    assert initial_checkpoints(stages, slots) == tuple(range(stages))
    assert recomputed(stages, slots) == simulate(stages, slots) == 0


@pytest.mark.parametrize("stages", [1, 2, 9, 1000])
def test_one_slot_starts_over_for_each_stage(stages):
    assert initial_checkpoints(stages, 1) == (0,)
    assert recomputed(stages, 1) == stages * (stages - 1) // 2


@pytest.mark.parametrize("stages, slots", LARGE)
def test_the_first_sweep_keeps_in_order_and_fills_the_slots(stages, slots):
    kept = initial_checkpoints(stages, slots)
    assert kept[0] == 0 and kept[-1] < stages and len(kept) == min(stages, slots)
    assert all(a < b for a, b in pairwise(kept))


def test_a_schedule_in_full():
    assert initial_checkpoints(4, 2) == (0, 2)
    assert [f"{kind} {stage}" for kind, stage in backward_schedule(4, 2)] == [
        *["restore 2", "advance 2", "vjp 3", "restore 2", "vjp 2", "drop 2"],
        *["restore 0", "advance 0", "vjp 1", "restore 0", "vjp 0", "drop 0"],
    ]


@pytest.mark.parametrize("function", [initial_checkpoints, backward_schedule, recomputed])
def test_arguments(function):
    with pytest.raises(ValueError, match="stages must be at least 1, got 0; an empty chain"):
        function(0, 3)
    with pytest.raises(
        ValueError, match="slots must be at least 1, got 0; the state before stage 0 takes one"
    ):
        function(3, 0)
