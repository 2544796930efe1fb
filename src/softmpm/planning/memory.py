"""Memory plan of a differentiable call: which states are checkpointed and which are recomputed. Formula: docs/memory.md.

A call is divided into chunks. The backward pass of a chunk needs all of its intermediate states and the mass and momentum of the
nodes. With N substeps, chunks of L, S bytes of a state inside, G of the nodes and B of a state between chunks, U bytes
that are derived from a state inside, A bytes of other buffers of each chunk, and E of a state that one chunk passes on to the next
beside those that it stores:

    store all: all intermediate states of all chunks, N (S + G), S + A for each chunk and E between two of them; no substep is
               recomputed, but U is derived for one chunk at a time, L U for each shape that chunks have
    schedule:  one chunk at a time is recomputed, L (S + U + G) + S + A for each shape; of the ⌈N/L⌉ states between
               chunks, s are stored, s B, and the others are recomputed with as few chunks as possible (checkpointing.py)

In a closed loop one backward pass covers many calls, each of which also stores its initial state, the final state of the previous
call. The backward pass visits the calls one after the other.
"""

import functools
import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple, Protocol

import torch

from softmpm.devices import memory_of
from softmpm.inputs import differentiable, present
from softmpm.planning.checkpointing import recomputed

LONGEST = 128
"""Maximum number of substeps of a chunk: enough to hide the host's overhead per chunk, few enough to re-sort particles in time."""
MANY, LONGEST_OF_MANY = 30_000, 64
"""From ``MANY`` particles on the host's overhead is hidden in any case and sorting matters more: chunks are shorter."""

MARGIN = {2: 6, 3: 3}
"""Smallest margin of the window around the particles' stencils, in nodes on each side, in 2D and 3D."""


def grown_margin(margin: int) -> int:
    """Margin of the window after it proved too small."""
    return 2 * margin + 1


def window_shape(grid: Sequence[int], reach: Sequence[int], margin: int, least: int) -> tuple[int, ...]:
    """Nodes along each axis of the window, the part of the grid that is allocated.

    Args:
        grid: Nodes of the whole grid.
        reach: Distance between the outermost base nodes of the particles along each axis.
        margin: Nodes around their stencils on each side.
        least: Nodes that there must be, of those of the grid; the margin grows until there are.
    """
    wide = [apart + 3 + 2 * margin for apart in reach]
    wide[-1] = 4 * math.ceil(wide[-1] / 4)  # so that columns are aligned for memory reads
    shape = tuple(min(nodes, w) for nodes, w in zip(grid, wide, strict=True))
    if math.prod(shape) < min(least, math.prod(grid)):
        return window_shape(grid, reach, grown_margin(margin), least)
    return shape


def longest_chunk(particles: int) -> int:
    """Maximum number of substeps of a chunk, given the particles of all worlds."""
    return LONGEST if particles < MANY else LONGEST_OF_MANY


def price_of_chunk(particles: int) -> int:
    """Estimated overhead of a chunk on a GPU, in substeps.

    With few particles it is the host's time, with many that of sorting and permuting them.
    """
    least, most = 4, 48
    return max(least, min(most, 3_000_000 // particles))


def state_bytes(particles: int, dim: int, real: int) -> int:
    """Bytes of a :class:`softmpm.State`, its low-order parts included; ``real`` is the size of a number."""
    state = particles * real * (2 * dim + 2 * dim * dim)
    return state + state // 2 if real == 4 else state


class Sizes(NamedTuple):
    """Bytes of the states that a call may store, and the numbers that determine the length of its chunks."""

    inside: int
    """State of all worlds inside a chunk [B]."""
    nodes: int
    """Nodal mass and momentum of all worlds that are stored for each substep [B]."""
    between: int
    """State of all worlds between chunks [B]."""
    start: int
    """Initial or final state of a call for all worlds, in the user's order, with its low-order parts [B]."""
    longest: int
    """Maximum number of substeps of a chunk."""
    price: int
    """Overhead of each chunk, in substeps."""
    calls: int
    """Number of calls that share the budget."""
    derived: int = 0
    """Part of a state inside a chunk that is not stored: the backward pass of the chunk computes it from the rest [B]."""
    apart: int = 0
    """Other buffers of each chunk that stores its states [B]."""
    passed_on: int = 0
    """State that each chunk of a call that stores its states passes on to the next one, if that is not among these states [B]."""


def default_budget(device: torch.device, sizes: Sizes) -> int:
    """Default memory budget of all calls [B].

    One call has a sixteenth of a GPU's memory, or 64 MiB on the CPU. Several calls have that for each, but at most 6 times as much on a
    GPU and 64 times on the CPU: a :class:`softmpm.Graph` stores its own states beside those of the same calls outside of it, and there
    must be room for both. The initial states exist in any case, so they never reduce the share of one call.
    """
    one, most = 64 * 2**20, 64
    if device.type == "cuda":
        one, most = torch.cuda.get_device_properties(device).total_memory // 16, 6
    return max(min(sizes.calls, most) * one, one + (sizes.calls - 1) * sizes.start)


def sizes_of(model, *, inside: int, nodes: int, between: int) -> Sizes:
    """Sizes of a scheme whose states take these numbers of bytes; the rest does not depend on the scheme."""
    particles = model.worlds * model.particle_count
    start = state_bytes(particles, model.dim, model.dtype.itemsize)
    price = 1 if model.device.type == "cpu" else price_of_chunk(particles)
    longest = longest_chunk(particles)
    return Sizes(inside, nodes, between, start, longest, price, model.calls)


class Plan(NamedTuple):
    """Memory plan of a call."""

    longest: int
    """Maximum number of substeps of a chunk."""
    checkpoints: int
    """Number of states between chunks that are stored; 0 if all intermediate states are stored."""
    kept: int
    """Bytes that the forward pass of one call stores."""
    recomputed: int
    """Bytes that the backward pass recomputes for one chunk at a time."""

    @property
    def keep_all(self) -> bool:
        """True if all intermediate states are stored and no substep is recomputed."""
        return self.checkpoints == 0


@functools.lru_cache(maxsize=256)
def plan(horizon, sizes: Sizes, budget: int) -> Plan:
    """The fastest plan within the budget [B] of all calls.

    Args:
        horizon: A :class:`softmpm.planning.chunks.Horizon`.

    Raises:
        ValueError: Not even one substep at a time fits.
    """
    count, lengths = horizon.counted(sizes.longest)
    everything = horizon.total * (sizes.inside + sizes.nodes) + count * (sizes.inside + sizes.apart)
    everything += max(count - 1, 0) * sizes.passed_on
    derived = sizes.derived * sum(lengths)
    others = sizes.calls - 1
    if sizes.calls * everything + derived + others * sizes.start <= budget or horizon.total == 0:
        return Plan(sizes.longest, 0, everything, derived)
    room = budget - others * (sizes.start - sizes.between)  # the first checkpoint is the initial state
    best, least = None, math.inf
    for longest in _lengths(horizon.substeps, sizes.longest):
        count, lengths = horizon.counted(longest)
        step, once = sizes.inside + sizes.derived + sizes.nodes, sizes.inside + sizes.apart
        inside = sum(n * step + once for n in lengths)
        stored = min(count, (room - inside - sizes.between) // (sizes.calls * sizes.between))
        if stored < 1:
            continue
        runs = recomputed(count, stored)
        # Each chunk runs forward and backward; some are recomputed in between.
        if (cost := runs * max(lengths) + (2 * count + runs) * sizes.price) < least:
            best, least = Plan(longest, stored, stored * sizes.between, inside + sizes.between), cost
    if best is None:
        one = 2 * sizes.inside + sizes.derived + sizes.nodes + sizes.apart
        smallest = one + 2 * sizes.between + others * sizes.start
        raise ValueError(
            f"a gradient {f'through {sizes.calls} calls ' if sizes.calls > 1 else ''}needs at least {smallest:,} bytes for states, "
            f"memory_budget is {budget:,} bytes: raise it, or make the scene smaller."
        )
    return best


def _lengths(substeps: int, longest: int) -> list[int]:
    """Candidate chunk lengths, the longest first: ``longest`` halved repeatedly, and the divisors of a control step.

    Divisors leave no shorter last chunk, which would need separate buffers.
    """
    halved = (longest >> k for k in range(longest.bit_length()))
    even = (n for n in range(1, longest + 1) if substeps % n == 0)
    return sorted({*halved, *even}, reverse=True)


class Footprint(Protocol):
    """Memory of one scheme. Models are passed without a type, since their module is above this one."""

    numbers_per_node: ClassVar[dict[int, int]]
    """Minimum count of stored numbers per node, in 2D and 3D."""

    def obstacle(self, shape: Sequence[int], particles: int) -> str | None:
        """Reason why a grid of this shape, with this number of particles in all worlds, does not fit the scheme; else None."""
        ...

    def node_count(self, model) -> int:
        """Allocated nodes of one world."""
        ...

    def sizes(self, model) -> Sizes:
        """Sizes of the states that a call may store."""
        ...

    def buffers(self, model, horizon, chosen: Plan) -> "Buffers":
        """Bytes of the buffers that calls of this length use, besides the stored states."""
        ...


class Buffers(NamedTuple):
    """Bytes of the buffers that calls use."""

    forward: int
    """Buffers of a call without gradient."""
    kept: int
    """Buffers that all calls retain until the backward pass."""
    backward: int
    """Buffers of the backward pass: adjoints that are passed from chunk to chunk, and those of recomputed chunks."""


class Memory(NamedTuple):
    """Peak memory of the calls of one gradient [B], besides that of the model itself, and how often each substep runs."""

    forward: int
    """Memory of a call without gradient [B]."""
    kept: int
    """Memory that all calls retain until the backward pass [B]."""
    backward: int
    """Peak memory of the backward pass, stored states included [B]."""
    runs: float
    """Mean number of forward runs of a substep: 1 if none is recomputed, more if memory is short."""


def memory(model, horizon) -> Memory:
    """Evaluate the formula of docs/memory.md for calls of one length with all gradients requested."""
    real, sizes, calls = model.dtype.itemsize, model.sizes(), model.calls
    particles = model.worlds * model.particle_count
    state = particles * real * (2 * model.dim + 2 * model.dim**2)  # adjoints of x, v, C, F
    material, given = input_bytes(model, horizon.control_steps), adjoint_bytes(model, horizon.control_steps)
    chosen = plan(horizon, sizes, model.budget)
    buffers = model.footprint.buffers(model, horizon, chosen)
    # Each call but the first also stores its initial state, which is one of the checkpoints if intermediate states are not stored.
    starts = (calls - 1) * (sizes.start - (0 if chosen.keep_all else sizes.between))
    kept = calls * (chosen.kept + material) + buffers.kept + starts
    adjoints = 2 * state + given + 3 * sizes.nodes + buffers.backward
    if model.spec.deterministic:
        adjoints += 2 * sizes.nodes
    chunks, _ = horizon.counted(chosen.longest)
    runs = 1.0 if chosen.keep_all else 2 + recomputed(chunks, chosen.checkpoints) / chunks
    return Memory(
        buffers.forward + material + sizes.start, kept, kept + chosen.recomputed + state + adjoints, runs
    )


def input_bytes(model, control_steps: int) -> int:
    """Bytes of the inputs of particles in a call or a chunk of this number of control steps."""
    numbers = 0
    for one in present(model.spec):
        if one.per == "particle" and one.kind != "index":
            numbers += (model.dim if one.kind == "vector" else 1) * (control_steps if one.rows else 1)
    return model.worlds * model.particle_count * numbers * model.dtype.itemsize


def surface_bytes(model) -> int:
    """Bytes of the anchors of the surface points that particles carry on the moving grid, if there are any."""
    return 0 if model.surface is None else math.prod(model.anchor_shape) * model.dtype.itemsize


def adjoint_bytes(model, control_steps: int) -> int:
    """Bytes of the adjoints of all inputs, in the user's order and in the accumulators of the kernels."""
    nodes, particles, size = model.held_nodes, model.particle_count, 0
    for one in differentiable(model.spec):
        numbers = (model.dim if one.kind == "vector" else 1) * (control_steps if one.rows else 1)
        if one.per == "muscle":  # summed at the end of each control step
            numbers = model.dim if one.kind == "vector" else 1
        places = {"particle": particles, "muscle": particles * model.spec.muscle_slots, "world": nodes}
        size += numbers * places.get(one.per, nodes * model.wall_count if one.per == "wall" else 0)
    return model.worlds * size * model.dtype.itemsize


def check_room(model) -> None:
    """Raise ValueError if the initial state, the final state and the grid of a call alone exceed the device's memory."""
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
