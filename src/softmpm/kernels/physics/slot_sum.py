"""Adjoints of an actuator: sums over the slots of its particles."""

from collections.abc import Sequence
from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.structs import Spec, types

COLLECTORS = 8_192
"""Threads that share the particles of a world: a million sums into one number would stand in a queue."""


def collectors(slots: Sequence[int]) -> tuple[int, int, int]:
    """Threads of :func:`collect_slots` for slots (world, particle, slot)."""
    worlds, particles, count = slots
    return worlds, min(particles, COLLECTORS), count


@kernel_factory
def collect_slots(spec: Spec):
    """Kernel that adds the adjoint of every particle and slot to that of its actuator, and clears it."""
    t = types(spec.dim, spec.dtype)

    @kernel()
    def collect(
        # In:
        muscle: wp.array3d(dtype=wp.int32),
        # In, cleared:
        adj_slot: wp.array3d(dtype=t.real),
        # Out, added into:
        adj_muscle: wp.array2d(dtype=t.real),
    ):
        world, n, slot = wp.tid()
        last = int(-1)
        total = t.real(0.0)
        for p in range(n, muscle.shape[1], COLLECTORS):
            k = muscle[world, p, slot]
            if k != last:
                if last >= 0:
                    wp.atomic_add(adj_muscle, world, last, total)
                last = k
                total = t.real(0.0)
            if k >= 0:
                total += adj_slot[world, p, slot]
                adj_slot[world, p, slot] = t.real(0.0)
        if last >= 0:
            wp.atomic_add(adj_muscle, world, last, total)

    return collect


PARTS = 256
"""Partial sums of an actuator, each of every 256th particle."""


@kernel_factory
def collect_slots_in_order(spec: Spec) -> SimpleNamespace:
    """As :func:`collect_slots`, in an order that is always the same: ``parts`` of each actuator, then their ``total``."""
    t = types(spec.dim, spec.dtype)

    @kernel()
    def parts(
        # In:
        muscle: wp.array3d(dtype=wp.int32),
        # In, cleared:
        adj_slot: wp.array3d(dtype=t.real),
        # Out:
        part: wp.array3d(dtype=t.real),
    ):
        world, k, n = wp.tid()
        total = t.real(0.0)
        for p in range(n, muscle.shape[1], PARTS):
            for slot in range(spec.muscle_slots):
                if muscle[world, p, slot] == k:
                    total += adj_slot[world, p, slot]
                    adj_slot[world, p, slot] = t.real(0.0)
        part[world, k, n] = total

    @kernel()
    def total(
        # In:
        part: wp.array3d(dtype=t.real),
        # Out, added into:
        adj_muscle: wp.array2d(dtype=t.real),
    ):
        world, k = wp.tid()
        for n in range(PARTS):
            adj_muscle[world, k] = adj_muscle[world, k] + part[world, k, n]

    return SimpleNamespace(parts=parts, total=total)
