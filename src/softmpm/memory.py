"""How much a differentiable call keeps, and what it recomputes instead. Formula and figures: docs/memory.md.

With N substeps, S bytes of one stored state (all worlds) and G bytes of the grid:

    keep all:   N + 1 states are kept by the forward pass, nothing is computed twice
    segments:   ⌈N/L⌉ states are kept, L = ⌈√N⌉; the backward pass recomputes one segment at a time into L + 1 states

    backward peak = kept + recomputed + 2 S' + 2 G + gradients                                       (memory)
"""

import math
from typing import NamedTuple

KEEP_ALL_BYTES = 64 * 2**20
"""Without a budget, a call keeps all its states up to this size; a closed loop makes a hundred such calls."""


class Plan(NamedTuple):
    """What is kept of a call."""

    segment: int
    """Substeps from one kept state to the next."""
    kept: int
    """States that the forward pass keeps."""
    recomputed: int
    """States of one recomputed segment; 0 if all are kept."""


def plan(substeps: int, state_bytes: int, budget: int | None) -> Plan:
    """The plan that computes least within the budget [B].

    Raises:
        ValueError: Not even segments of √N fit.
    """
    everything = Plan(segment=1, kept=substeps + 1, recomputed=0)
    if everything.kept * state_bytes <= (KEEP_ALL_BYTES if budget is None else budget):
        return everything
    length = max(1, math.isqrt(max(substeps - 1, 0)) + 1)
    segments = Plan(segment=length, kept=math.ceil(substeps / length), recomputed=length + 1)
    least = (segments.kept + segments.recomputed) * state_bytes
    if budget is not None and least > budget:
        raise ValueError(
            f"a gradient through {substeps} substeps needs at least {least / 2**20:.1f} MiB of states, memory_budget is "
            f"{budget / 2**20:.1f} MiB: raise it, or cut the call into several and wrap them in torch.utils.checkpoint."
        )
    return segments


class Memory(NamedTuple):
    """Bytes that a call takes at its peak, besides what the model itself holds."""

    forward: int
    """A call without gradient."""
    kept: int
    """What a call with gradient keeps until its backward pass."""
    backward: int
    """Peak of the backward pass, kept states included."""


def memory(model, substeps: int) -> Memory:
    """Evaluates (memory) for one call of ``substeps`` substeps in one control step, all gradients wanted."""
    state, grid, real = model.state_bytes(), model.node_bytes(), model.dtype.itemsize
    particles = model.worlds * model.particle_count
    boundary = (
        particles * real * (2 * model.dim + 2 * model.dim**2)
    )  # x, v, C, F of the end or their adjoints
    low = boundary // 2 if real == 4 else 0
    material = 3 * particles * real
    pull = particles * model.spec.muscle_slots * real
    chosen = plan(substeps, state, model.memory_budget)
    forward = 2 * state + grid + material + boundary + low
    kept = chosen.kept * state + material
    adjoints = 2 * boundary + 2 * material + pull
    return Memory(
        forward, kept, kept + boundary + low + chosen.recomputed * state + 2 * grid + adjoints + boundary
    )
