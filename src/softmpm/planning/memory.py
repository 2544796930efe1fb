"""Memory plan of a differentiable call: which states are checkpointed and which are recomputed. Formula: docs/memory.md.

A call is divided into chunks. The backward pass of a chunk needs all of its intermediate states and the mass and momentum of the
nodes. With N substeps, chunks of L, S bytes of a state inside, G of the nodes and B of a state between chunks:

    keep all:  everything inside all chunks, N (S + G) and one S for each; nothing runs twice
    schedule:  one chunk at a time is run again, L (S + G), for each shape that chunks have; of the ⌈N/L⌉ states between
               chunks, s are kept, s B, and the others are found by running chunks again, as few as possible (checkpointing.py)

In a closed loop one backward pass goes through many calls, each of which also holds its start, the end of the one before. The
backward pass visits them one after the other.
"""

import functools
import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple, Protocol

import torch

from softmpm.devices import memory_of
from softmpm.planning.checkpointing import recomputed

LONGEST = 128
"""Substeps of a chunk, at most: long enough to hide what a chunk costs the host, short enough to sort particles again in time."""
MANY, LONGEST_OF_MANY = 30_000, 64
"""From so many particles on the host has time enough, and sorting in time is worth more."""

MARGIN = {2: 6, 3: 3}
"""Nodes of a window around the particles' stencils, on each side, in 2D and 3D, until they leave it."""


def window_shape(grid: Sequence[int], reach: Sequence[int], margin: int) -> tuple[int, ...]:
    """Nodes along each axis of the part of the grid that is in memory.

    Args:
        grid: Nodes of the whole grid.
        reach: How far the particles' base nodes lie apart.
        margin: Nodes around their stencils on each side.
    """
    wide = [apart + 3 + 2 * margin for apart in reach]
    wide[-1] = 4 * math.ceil(wide[-1] / 4)  # so that columns begin where reads from memory do
    return tuple(min(nodes, w) for nodes, w in zip(grid, wide, strict=True))


def longest_chunk(particles: int) -> int:
    """Substeps of a chunk, at most, for so many particles in all worlds."""
    return LONGEST if particles < MANY else LONGEST_OF_MANY


def price_of_chunk(particles: int) -> int:
    """Estimated cost of a chunk on a GPU besides its substeps, in substeps.

    With few particles it is the host's time, with many that of sorting and moving them.
    """
    least, most = 4, 48
    return max(least, min(most, 3_000_000 // particles))


def state_bytes(particles: int, dim: int, real: int) -> int:
    """Bytes of a :class:`softmpm.State`, its low-order parts included; ``real`` is the size of a number."""
    state = particles * real * (2 * dim + 2 * dim * dim)
    return state + state // 2 if real == 4 else state


class Sizes(NamedTuple):
    """Bytes of what a call may keep, and what decides how long its chunks are."""

    inside: int
    """State of all worlds inside a chunk."""
    nodes: int
    """What is kept of the nodes of all worlds for each substep."""
    between: int
    """State of all worlds between chunks."""
    start: int
    """State of all worlds in the user's order, as a call begins or ends, with what rounding took."""
    longest: int
    """Substeps of a chunk, at most."""
    price: int
    """What each chunk costs besides its substeps, in substeps."""
    calls: int
    """How many calls share the budget."""


def default_budget(device: torch.device, sizes: Sizes) -> int:
    """Bytes that all calls may keep where nobody says how many.

    For one call a sixteenth of a GPU's memory, or 64 MiB on the CPU. For several as often as much, but at most 6 times, or 64 times on
    the CPU: a :class:`softmpm.Graph` of them holds its own beside what the same calls keep outside of it, and there must be room for
    both. The starts are there anyway: they never take what one call would have.
    """
    one, most = 64 * 2**20, 64
    if device.type == "cuda":
        one, most = torch.cuda.get_device_properties(device).total_memory // 16, 6
    return max(min(sizes.calls, most) * one, one + (sizes.calls - 1) * sizes.start)


class Plan(NamedTuple):
    """Memory plan of a call."""

    longest: int
    """Substeps of a chunk, at most."""
    slots: int
    """States between chunks that are kept; 0 if everything is."""
    kept: int
    """Bytes kept by the forward pass, of one call."""
    recomputed: int
    """Bytes of what the backward pass runs again at a time."""

    @property
    def keep_all(self) -> bool:
        return self.slots == 0


@functools.lru_cache(maxsize=256)
def plan(horizon, sizes: Sizes, budget: int) -> Plan:
    """The plan that takes the least time within the budget [B] of all calls.

    Args:
        horizon: A :class:`softmpm.planning.chunks.Horizon`.

    Raises:
        ValueError: Not even one substep at a time fits.
    """
    chunks = len(horizon.chunks(sizes.longest))
    everything = horizon.total * (sizes.inside + sizes.nodes) + chunks * sizes.inside
    others = sizes.calls - 1
    if sizes.calls * everything + others * sizes.start <= budget or horizon.total == 0:
        return Plan(sizes.longest, 0, everything, 0)
    room = budget - others * (sizes.start - sizes.between)  # the first state that is kept is the start
    best, least = None, math.inf
    for longest in _lengths(horizon.substeps, sizes.longest):
        chunks = horizon.chunks(longest)
        inside = sum((n + 1) * sizes.inside + n * sizes.nodes for n, _ in {chunk.shape for chunk in chunks})
        slots = min(len(chunks), (room - inside - sizes.between) // (sizes.calls * sizes.between))
        if slots < 1:
            continue
        runs = recomputed(len(chunks), slots)
        length = max(chunk.length for chunk in chunks)
        # Each chunk runs forward and backward; some are recomputed in between.
        if (cost := runs * length + (2 * len(chunks) + runs) * sizes.price) < least:
            best, least = Plan(longest, slots, slots * sizes.between, inside + sizes.between), cost
    if best is None:
        smallest = 2 * (sizes.inside + sizes.between) + sizes.nodes + others * sizes.start
        raise ValueError(
            f"a gradient {f'through {sizes.calls} calls ' if sizes.calls > 1 else ''}needs at least {smallest:,} bytes for states, "
            f"memory_budget is {budget:,} bytes: raise it, or make the scene smaller."
        )
    return best


def _lengths(substeps: int, longest: int) -> list[int]:
    """Lengths of chunks to try, the longest first: halved again and again, and those that divide a control step.

    These leave no shorter chunk, which would need buffers of its own.
    """
    halved = (longest >> k for k in range(longest.bit_length()))
    even = (n for n in range(1, longest + 1) if substeps % n == 0)
    return sorted({*halved, *even}, reverse=True)


class Footprint(Protocol):
    """Memory of one scheme. Models come without a type, since they stand above this module."""

    numbers_per_node: ClassVar[dict[int, int]]
    """Numbers of a node that a call takes at least, in 2D and 3D."""

    def obstacle(self, shape: Sequence[int], particles: int) -> str | None:
        """Reason why a grid of this shape, with this number of particles in all worlds, does not fit the scheme; else None."""
        ...

    def node_count(self, model) -> int:
        """Nodes of one world in memory."""
        ...

    def sizes(self, model) -> Sizes:
        """Bytes of what a call may keep."""
        ...

    def buffers(self, model, horizon, chosen: Plan) -> "Buffers":
        """Bytes of the buffers that run calls of this length, besides states that are kept."""
        ...


class Buffers(NamedTuple):
    """Bytes of the buffers that run calls."""

    forward: int
    """Of a call without gradient."""
    kept: int
    """Of all calls until the backward pass."""
    backward: int
    """Of the backward pass: adjoints that are passed from chunk to chunk, and what runs chunks again."""


class Memory(NamedTuple):
    """Bytes that the calls of one gradient take at their peak, besides what the model itself holds, and how often they run."""

    forward: int
    """A call without gradient."""
    kept: int
    """What all calls keep until the backward pass."""
    backward: int
    """Peak of the backward pass, kept states included."""
    runs: float
    """How often a substep runs forward, in the mean; with little memory the backward pass takes so much longer."""


def memory(model, horizon) -> Memory:
    """Evaluates the formula of docs/memory.md for calls of one length, all gradients wanted."""
    real, sizes, calls = model.dtype.itemsize, model.sizes(), model.calls
    particles = model.worlds * model.particle_count
    state = particles * real * (2 * model.dim + 2 * model.dim**2)  # adjoints of x, v, C, F
    material, pull = 4 * particles * real, particles * model.spec.muscle_slots * real
    chosen = plan(horizon, sizes, model.budget)
    buffers = model.footprint.buffers(model, horizon, chosen)
    # Each call but the first holds its start besides, which is one of the states that are kept if those inside are not.
    starts = (calls - 1) * (sizes.start - (0 if chosen.keep_all else sizes.between))
    kept = calls * (chosen.kept + material) + buffers.kept + starts
    adjoints = 2 * state + material + pull + 3 * sizes.nodes + buffers.backward
    if model.spec.deterministic:
        adjoints += 2 * sizes.nodes
    chunks = len(horizon.chunks(chosen.longest))
    runs = 1.0 if chosen.keep_all else 2 + recomputed(chunks, chosen.slots) / chunks
    return Memory(
        buffers.forward + material + sizes.start, kept, kept + chosen.recomputed + state + adjoints, runs
    )


def check_room(model) -> None:
    """Raise ValueError if the start, the end and the grid of a call alone are more than the device has."""
    room = memory_of(model.device)
    nodes = model.footprint.node_count(model)
    per_node = model.footprint.numbers_per_node[model.dim]
    per_world = 2 * model.particle_count * 2 * (model.dim + model.dim**2) + nodes * per_node
    needed = model.worlds * per_world * model.dtype.itemsize
    if room is not None and needed > room:
        raise ValueError(
            f"a call takes at least {needed:,} bytes for {model.worlds:,} world(s) of {model.particle_count:,} particles and "
            f"{nodes:,} nodes, but {model.device} has {room:,}: take fewer worlds, fewer nodes or fewer particles."
        )
