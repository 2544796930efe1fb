"""How much a differentiable call keeps, and what it runs again instead. Formula and figures: docs/memory.md.

A call is cut into chunks. To pull a chunk back, what is inside it must be there: its states and the mass and momentum of the
nodes. With N substeps, chunks of L, S bytes of a state inside, G of the nodes and B of a state between chunks:

    keep all:  everything inside all chunks, N (S + G); nothing runs twice
    schedule:  one chunk at a time is run again, L (S + G); of the ⌈N/L⌉ states between chunks, s are kept, s B,
               and the others are found by running chunks again, as few as possible (schedule.py)
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

from softmpm.schedule import recomputed

LONGEST = 128
"""Substeps of a chunk, at most: long enough to hide what a chunk costs the host, short enough to sort particles again in time."""
MANY, LONGEST_OF_MANY = 200_000, 64
"""From so many particles on the host has time enough, and sorting in time is worth more."""
CPU_BUDGET = 64 * 2**20
"""Without a budget, what a call on the CPU may keep; on a GPU it is a sixteenth of its memory."""


MARGIN = {2: 6, 3: 3}
"""Nodes of a window around the particles' stencils, on each side, in 2D and 3D."""


def window_shape(grid: Sequence[int], reach: Sequence[int]) -> tuple[int, ...]:
    """Nodes along each axis of the part of the grid that is in memory.

    Args:
        grid: Nodes of the whole grid.
        reach: How far the particles' base nodes lie apart.
    """
    wide = (apart + 3 + 2 * MARGIN[len(grid)] for apart in reach)
    return tuple(min(nodes, 4 * math.ceil(w / 4)) for nodes, w in zip(grid, wide, strict=True))


def longest_chunk(particles: int) -> int:
    """Substeps of a chunk, at most, for so many particles in all worlds."""
    return LONGEST if particles < MANY else LONGEST_OF_MANY


class Sizes(NamedTuple):
    """Bytes of what a call may keep."""

    inside: int
    """State of all worlds inside a chunk."""
    nodes: int
    """What is kept of the nodes of all worlds for each substep."""
    between: int
    """State of all worlds between chunks."""
    longest: int
    """Substeps of a chunk, at most."""


class Plan(NamedTuple):
    """What is kept of a call."""

    longest: int
    """Substeps of a chunk, at most."""
    slots: int
    """States between chunks that are kept; 0 if everything is."""
    kept: int
    """Bytes kept by the forward pass."""
    recomputed: int
    """Bytes of what the backward pass runs again at a time."""

    @property
    def keep_all(self) -> bool:
        return self.slots == 0


@functools.lru_cache(maxsize=256)
def plan(horizon, sizes: Sizes, budget: int) -> Plan:
    """The plan that runs least again within the budget [B].

    Args:
        horizon: A :class:`softmpm.horizon.Horizon`.

    Raises:
        ValueError: Not even one substep at a time fits.
    """
    chunks = len(horizon.chunks(sizes.longest))
    everything = horizon.total * (sizes.inside + sizes.nodes) + chunks * sizes.inside
    if everything <= budget or horizon.total == 0:
        return Plan(sizes.longest, 0, everything, 0)
    best, least = None, math.inf
    for longest in (2**k for k in range(sizes.longest.bit_length() - 1, -1, -1)):
        chunks = horizon.chunks(longest)
        length = max(chunk.length for chunk in chunks)
        inside = (length + 1) * sizes.inside + length * sizes.nodes
        slots = min(len(chunks), (budget - inside - sizes.between) // sizes.between)
        if slots >= 1 and (again := recomputed(len(chunks), slots) * length) < least:
            best, least = Plan(longest, slots, slots * sizes.between, inside + sizes.between), again
    if best is None:
        smallest = 2 * (sizes.inside + sizes.between) + sizes.nodes
        raise ValueError(
            f"a gradient needs at least {smallest / 2**20:.1f} MiB for states, memory_budget is {budget / 2**20:.1f} MiB: "
            "raise it, or make the scene smaller."
        )
    return best


class Memory(NamedTuple):
    """Bytes that a call takes at its peak, besides what the model itself holds."""

    forward: int
    """A call without gradient."""
    kept: int
    """What a call with gradient keeps until its backward pass."""
    backward: int
    """Peak of the backward pass, kept states included."""


def memory(model, horizon) -> Memory:
    """Evaluates (memory) for one call, all gradients wanted."""
    real, sizes = model.dtype.itemsize, model.sizes()
    particles = model.worlds * model.particle_count
    state = particles * real * (2 * model.dim + 2 * model.dim**2)  # x, v, C, F of the end, or their adjoints
    low = state // 2 if real == 4 else 0
    material = 4 * particles * real
    pull = particles * model.spec.muscle_slots * real
    chosen = plan(horizon, sizes, model.budget)
    forward = (
        sizes.inside * (1 if model.scheme == "fast" else 2) + 3 * sizes.nodes + 2 * material + state + low
    )
    adjoints = 2 * state + 2 * material + pull + 3 * sizes.nodes + sizes.inside
    kept = chosen.kept
    if model.spec.deterministic:  # each program adds up in fixed point, and so does the backward pass
        own = sizes.inside + 2 * sizes.nodes
        forward += own
        kept += own * (len(horizon.chunks(chosen.longest)) if chosen.keep_all else 1)
        adjoints += 2 * sizes.nodes
    return Memory(forward, kept + 2 * material, kept + chosen.recomputed + 2 * material + state + adjoints)
