"""Particle order and grid window: sort keys, staleness of an order, permutation from one order to another, position of the window.

``order`` contains the particle of the world at each place in the packed particles.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import NATIVE, WARP, native
from softmpm.kernels.physics import status
from softmpm.kernels.structs import types

SAMPLES = 50_000
"""Approximate number of particles that are sampled to count changes of cell along the order."""


@kernel_factory
def sorting(dim: int, dtype: str) -> SimpleNamespace:
    t, n, s = types(dim, dtype), native(dim, dtype), stencil(dim, dtype)
    real, vec, ivec = t.real, t.vec, t.ivec
    Constants, Packed, Window = t.Constants, t.Packed, t.Window
    copy_rows, pack_base, unpack_base = n.copy_rows, s.pack_base, s.unpack_base
    report, left_window = status.report(dim, dtype).report, int(Kind.LEFT_WINDOW)

    @wp.func
    def kept_inside(words: wp.array(dtype=wp.int64), window: Window, world: int, p: int, base: ivec) -> ivec:
        """Base node of a particle, clamped to the window; a particle outside of it is reported and accesses no other memory."""
        inside = base
        for axis in range(dim):
            away = base[axis] - window.origin[world][axis]
            if away < 0 or away > window.shape[axis] - 3:
                inside[axis] = window.origin[world][axis]
                report(words, world, 0, left_window, p)
        return inside

    @kernel(NATIVE)
    def locate(
        # Parameters:
        constants: Constants,
        up: int,  # the axis along which bodies fall
        # In:
        x: wp.array2d(dtype=vec),
        sorted_x: wp.array2d(dtype=vec),  # positions to sort by
        # Out:
        # Increases with the cell, along the last axis first, and is odd in the upper half of a cell.
        key: wp.array2d(dtype=wp.int32),
        # Out, lowered and raised:
        low: wp.array2d(dtype=wp.int32),
        high: wp.array2d(dtype=wp.int32),
    ):
        """Compute the sort keys of the particles, and the first and last base node of each world along each axis."""
        world, p = wp.tid()
        cell = int(0)
        half = int(0)
        base = ivec()
        on_grid = bool(True)
        for axis in range(dim):
            last = constants.shape[axis] - 3
            there = wp.float64(sorted_x[world, p][axis]) / constants.exact_spacing - wp.float64(0.5)
            cell = cell * constants.shape[axis] + wp.clamp(int(wp.floor(there)), 0, last)
            if axis == up and there - wp.floor(there) >= wp.float64(0.5):
                half = 1
            here = wp.floor(wp.float64(x[world, p][axis]) / constants.exact_spacing - wp.float64(0.5))
            if here >= wp.float64(0.0) and here <= wp.float64(last):
                base[axis] = int(here)
            else:
                on_grid = False  # it will be refused; no memory is taken for it
        for axis in range(dim):
            if on_grid and base[axis] < low[world, axis]:
                wp.atomic_min(low, world, axis, base[axis])
            if on_grid and base[axis] > high[world, axis]:
                wp.atomic_max(high, world, axis, base[axis])
        key[world, p] = 2 * cell + half

    @kernel(NATIVE)
    def centre_window(
        # Parameters:
        constants: Constants,
        shape: ivec,  # nodes of the window
        # In:
        low: wp.array2d(dtype=wp.int32),
        high: wp.array2d(dtype=wp.int32),
        # Out:
        origin: wp.array2d(dtype=wp.int32),
    ):
        world, axis = wp.tid()
        middle = (low[world, axis] + high[world, axis] + 3 - shape[axis]) / 2
        origin[world, axis] = wp.clamp(middle, 0, constants.shape[axis] - shape[axis])

    @kernel(NATIVE)
    def survey(
        # Parameters:
        constants: Constants,
        window: Window,
        count: int,  # particles of one world
        # In:
        base: wp.array(dtype=wp.int32),
        # Out, added into:
        # Cells met going along the order; then whether a particle is near the window's edge.
        found: wp.array(dtype=wp.int64),
    ):
        """Count the changes of cell along the order, and detect a particle near the window's edge."""
        i = wp.tid()
        world = i / count
        sample = 1 + count * window.origin.shape[0] / SAMPLES  # all of few particles, some warps of many
        if (i / WARP) % sample == 0 and (i == world * count or base[i] != base[i - 1]):
            wp.atomic_add(found, 0, wp.int64(sample))
        here = unpack_base(base[i])
        for axis in range(dim):
            first = window.origin[world][axis]
            room = here[axis] - first
            if room < 2 and first > 0:
                found[1] = wp.int64(1)
            room = first + window.shape[axis] - 3 - here[axis]
            if room < 2 and first + window.shape[axis] < constants.shape[axis]:
                found[1] = wp.int64(1)

    @kernel(NATIVE)
    def invert(
        # In:
        order: wp.array2d(dtype=wp.int32),
        # Out:
        places: wp.array2d(dtype=wp.int32),  # where each particle stands
    ):
        world, place = wp.tid()
        places[world, order[world, place]] = place

    @kernel(NATIVE)
    def move(
        # Parameters:
        window: Window,
        order: wp.array2d(dtype=wp.int32),
        # In:
        places: wp.array2d(dtype=wp.int32),  # where each particle stood
        base: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=real),
        # Out:
        words: wp.array(dtype=wp.int64),
        packed: Packed,
    ):
        """Permute packed particles from one order to another."""
        world, place = wp.tid()
        start = world * order.shape[1]
        p = order[world, place]
        i = start + place
        j = start + places[world, p]
        packed.base[i] = pack_base(kept_inside(words, window, world, p, unpack_base(base[j])))
        copy_rows(rows, j, packed.rows, i)

    @kernel(NATIVE)
    def move_adj(
        # Parameters:
        order: wp.array2d(dtype=wp.int32),
        # In:
        places: wp.array2d(dtype=wp.int32),
        from_rows: wp.array(dtype=real),
        # Out:
        rows: wp.array(dtype=real),
    ):
        """Permute packed adjoints, which have no base nodes, from one order to another."""
        world, place = wp.tid()
        start = world * order.shape[1]
        copy_rows(from_rows, start + places[world, order[world, place]], rows, start + place)

    return SimpleNamespace(
        kept_inside=kept_inside,
        locate=locate,
        centre_window=centre_window,
        survey=survey,
        invert=invert,
        move=move,
        move_adj=move_adj,
    )
