"""The plan of what a call keeps, and the formula of its memory."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import busy_scene

import softmpm
from softmpm.planning.checkpointing import backward_schedule
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import Plan, Sizes, default_budget, memory, plan, price_of_chunk

SIZES = Sizes(inside=100, nodes=10, between=104, start=130, longest=64, price=4, calls=1)


def recomputations(chosen: Plan, horizon: Horizon) -> tuple[int, int]:
    """Number of substeps that are recomputed, and of chunks that run in all, counted along the schedule."""
    chunks = horizon.chunks(chosen.longest)
    moves = list(backward_schedule(len(chunks), chosen.checkpoints))
    substeps = sum(chunks[move.stage].length for move in moves if move.kind == "advance")
    return substeps, len(chunks) + sum(move.kind in ("advance", "vjp") for move in moves)


def seconds(chosen: Plan, horizon: Horizon, sizes: Sizes) -> int:
    """In substeps."""
    substeps, chunks = recomputations(chosen, horizon)
    return substeps + sizes.price * chunks


@pytest.mark.parametrize("derived, apart", [(0, 0), (40, 25)])
@pytest.mark.parametrize("calls", [1, 5])
@pytest.mark.parametrize("horizon", [Horizon(1, 1000), Horizon(1, 997), Horizon(25, 40), Horizon(7, 9)])
def test_a_plan_stays_within_its_budget_and_memory_buys_time(horizon, calls, derived, apart):
    """Stored and recomputed states of all calls fit, shorter last chunks included; more memory never costs time."""
    sizes = SIZES._replace(calls=calls, derived=derived, apart=apart, inside=SIZES.inside - derived)
    times = []
    for budget in np.geomspace(600 + 200 * calls, 100_000 * calls, 20).astype(int):
        chosen = plan(horizon, sizes, int(budget))
        if chosen.keep_all:
            break
        shapes = {chunk.shape: chunk.length for chunk in horizon.chunks(chosen.longest)}
        inside = sum((n + 1) * SIZES.inside + n * SIZES.nodes - derived + apart for n in shapes.values())
        assert (
            chosen.kept == chosen.checkpoints * SIZES.between and chosen.recomputed == inside + SIZES.between
        )
        starts = (calls - 1) * (SIZES.start - SIZES.between)  # the first state that is kept is the user's
        assert calls * chosen.kept + starts + chosen.recomputed <= budget
        times.append(seconds(chosen, horizon, SIZES))
    assert len(times) > 3 and times == sorted(times, reverse=True)


def test_what_is_derived_from_stored_states_is_needed_once():
    """Five calls of 99 substeps, in chunks of 50 and 49, store less where a part of each state is derived from the rest."""
    horizon, sizes = Horizon(1, 99), SIZES._replace(calls=5, inside=60, derived=40, apart=7)
    everything = 101 * 60 + 99 * 10 + 2 * 7
    needed = 5 * everything + 4 * 130 + 99 * 40
    assert plan(horizon, sizes, needed) == Plan(longest=64, checkpoints=0, kept=everything, recomputed=3960)
    assert not plan(horizon, sizes, needed - 1).keep_all


def test_calls_share_a_budget():
    """Five calls store all states with five times the memory of one and four initial states, not with less."""
    horizon, sizes = Horizon(1, 64), SIZES._replace(calls=5)
    everything = 5 * plan(horizon, SIZES, 10**9).kept + 4 * 130
    assert plan(horizon, sizes, everything).keep_all and not plan(horizon, sizes, everything - 1).keep_all
    with pytest.raises(ValueError, match="a gradient through 5 calls needs at least 938 bytes"):
        plan(horizon, sizes, 937)
    assert plan(horizon, sizes, 938) == Plan(longest=1, checkpoints=1, kept=104, recomputed=314)


@pytest.mark.parametrize("device, one, most", [("cpu", 2**26, 64), ("cuda", 10**9, 6)])
def test_without_a_budget_several_calls_may_keep_more(device, one, most, monkeypatch):
    """So often what one may, up to a limit; but all starts always leave as much as that."""
    gpu = SimpleNamespace(total_memory=16 * 10**9)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: gpu)
    for calls, want in ((1, one), (3, 3 * one), (1000, most * one), (10**8, one + (10**8 - 1) * SIZES.start)):
        assert default_budget(torch.device(device), SIZES._replace(calls=calls)) == want


def test_the_price_of_a_chunk_makes_chunks_longer():
    """If memory is short, many short chunks minimise recomputation, unless the overhead of each is large."""
    horizon, budget = Horizon(1, 64), 64 * 110 // 5
    free, dear = (plan(horizon, SIZES._replace(price=price), budget) for price in (0, 10))
    assert free.longest < dear.longest
    assert (
        recomputations(free, horizon)[0] < recomputations(dear, horizon)[0]
        and recomputations(free, horizon)[1] > recomputations(dear, horizon)[1]
    )
    for sizes, better, worse in (
        (SIZES._replace(price=0), free, dear),
        (SIZES._replace(price=10), dear, free),
    ):
        assert seconds(better, horizon, sizes) < seconds(worse, horizon, sizes)


def test_chunks_that_divide_a_control_step_save_the_memory_of_a_shorter_one():
    """1000 substeps: 25 at a time, where 32 would leave 8, with buffers of their own."""
    assert plan(Horizon(1, 1000), SIZES, 6_000).longest == 25
    assert plan(Horizon(1, 1024), SIZES, 6_000).longest == 32


def test_the_price_of_a_chunk_falls_with_the_particles():
    """48 substeps for few of them, 4 for many, never rising in between."""
    prices = [price_of_chunk(n) for n in (1, 62_500, 62_501, 300_000, 750_000, 10_000_000)]
    assert prices[:2] == [48, 48] and prices[-2:] == [4, 4] and prices == sorted(prices, reverse=True)


def test_sizes_of_both_schemes():
    """Between chunks the fast scheme keeps a state and an order; the plain one keeps no nodes."""
    fast, plain = (
        softmpm.build(busy_scene(3), device="cpu", scheme=name).sizes() for name in ("fast", "plain")
    )
    particles = softmpm.build(busy_scene(3), device="cpu").particle_count
    assert fast.between == fast.inside + 4 * particles and fast.nodes > 0
    assert plain.nodes == 0 and fast.price == plain.price == 1


def test_the_longest_call_is_planned_at_once():
    """Without its chunks, of which a hundred million substeps have too many for the memory."""
    for horizon in (Horizon(1, 10**8), Horizon(10**7, 10)):
        before = Horizon.chunks.cache_info().currsize
        assert plan(horizon, SIZES, 10**6).checkpoints > 0
        assert Horizon.chunks.cache_info().currsize == before


@pytest.mark.parametrize("formulation", ["moving", "reference"])
@pytest.mark.parametrize("budget", [None, 10_000_000])
def test_the_longest_call_is_described_at_once(formulation, budget, monkeypatch):
    """Its chunks, of which there are a million, are counted and not built."""
    model = softmpm.build(busy_scene(2), device="cpu", formulation=formulation, memory_budget=budget)

    def built(*_):
        raise AssertionError("chunks were built")

    monkeypatch.setattr(Horizon, "chunks", built)
    assert model.describe(10**8) and memory(model, Horizon(25, 10**6)).runs >= 1
