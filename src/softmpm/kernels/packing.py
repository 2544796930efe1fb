"""Between what users hold and the packed, sorted particles of the fast scheme. Exact to the last digit, as boundary.py.

``order`` names, for each place in the packed particles, the particle of its world that stands there.
"""

import functools
from types import SimpleNamespace

import warp as wp

from softmpm.kernels import failure
from softmpm.kernels.boundary import boundary
from softmpm.kernels.native import WARP, native, native_module
from softmpm.kernels.stencil import stencil
from softmpm.kernels.types import types
from softmpm.watch import Kind

SAMPLES = 50_000
"""Particles of which it is counted whether their cell is another one than that of the particle before."""


@functools.lru_cache(maxsize=None)
def packing(dim: int, dtype: str) -> SimpleNamespace:
    t, b, n, s = types(dim, dtype), boundary(dim, dtype), native(dim, dtype), stencil(dim, dtype)
    real, vec, mat, ivec = t.real, t.vec, t.mat, t.ivec
    Scale, Packed, Window = t.Scale, t.Packed, t.Window
    entered, left = b.entered, b.left
    load_vec, load_mat, store_vec, store_mat = n.load_vec, n.load_mat, n.store_vec, n.store_mat
    pack_base, unpack_base, report = s.pack_base, s.unpack_base, failure.report(dim, dtype).report
    row_fx, row_low, row_v, row_H, row_C = t.row_fx, t.row_low, t.row_v, t.row_h, t.row_c
    bad_start, left_window = int(Kind.START), int(Kind.LEFT_WINDOW)
    module = native_module(f"softmpm.packing.d{dim}.{dtype}")

    @wp.kernel(module=module, enable_backward=False)
    def enter(
        # Parameters:
        scale: Scale,
        window: Window,
        order: wp.array2d(dtype=wp.int32),
        # In:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
        low_x: wp.array2d(dtype=vec),
        low_F: wp.array2d(dtype=mat),
        # Out:
        watch: wp.array(dtype=wp.int64),
        packed: Packed,
    ):
        world, place = wp.tid()
        i = world * order.shape[1] + place
        p = order[world, place]
        at = entered(
            scale, x[world, p], v[world, p], C[world, p], F[world, p], low_x[world, p], low_F[world, p]
        )
        if not at.sound:
            report(watch, world, 0, bad_start, p)
        base = at.base
        for axis in range(dim):
            away = base[axis] - window.origin[world][axis]
            if away < 0 or away > window.shape[axis] - 3:
                base[axis] = window.origin[world][axis]
                if at.sound:
                    report(watch, world, 0, left_window, p)
        packed.base[i] = pack_base(base)
        store_vec(packed.rows, i, row_fx, at.fx)
        store_vec(packed.rows, i, row_low, at.low)
        store_vec(packed.rows, i, row_v, v[world, p])
        store_mat(packed.rows, i, row_H, at.H)
        store_mat(packed.rows, i, row_C, C[world, p])

    @wp.kernel(module=module, enable_backward=False)
    def leave(
        # Parameters:
        scale: Scale,
        window: Window,
        order: wp.array2d(dtype=wp.int32),
        # In:
        packed: Packed,
        # Out:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
        low_x: wp.array2d(dtype=vec),
        low_F: wp.array2d(dtype=mat),
        # Out, added into:
        state_of_order: wp.array(
            dtype=wp.int64
        ),  # cells met going along the order; particles near the window's edge
    ):
        world, place = wp.tid()
        i = world * order.shape[1] + place
        p = order[world, place]
        base = unpack_base(packed.base[i])
        out = left(
            scale,
            base,
            load_vec(packed.rows, i, row_fx),
            load_vec(packed.rows, i, row_low),
            load_mat(packed.rows, i, row_H),
        )
        x[world, p] = out.x
        v[world, p] = load_vec(packed.rows, i, row_v)
        C[world, p] = load_mat(packed.rows, i, row_C)
        F[world, p] = out.F
        if wp.static(dtype == "float32"):
            low_x[world, p] = out.low_x
            low_F[world, p] = out.low_f
        sample = 1 + order.shape[0] * order.shape[1] / SAMPLES  # all of few particles, some warps of many
        if (i / WARP) % sample == 0 and (place == 0 or packed.base[i] != packed.base[i - 1]):
            wp.atomic_add(state_of_order, 0, wp.int64(sample))
        for axis in range(dim):
            first = window.origin[world][axis]
            room = base[axis] - first
            if room < 2 and first > 0:
                state_of_order[1] = wp.int64(1)
            room = first + window.shape[axis] - 3 - base[axis]
            if room < 2 and first + window.shape[axis] < scale.shape[axis]:
                state_of_order[1] = wp.int64(1)

    @wp.kernel(module=module, enable_backward=False)
    def locate(
        # Parameters:
        scale: Scale,
        up: int,  # the axis along which bodies fall
        # In:
        x: wp.array2d(dtype=vec),
        sorted_x: wp.array2d(dtype=vec),  # what the order follows
        # Out:
        key: wp.array2d(
            dtype=wp.int32
        ),  # grows with the cell, along the last axis first; odd in its upper half
        # Out, lowered and raised:
        low: wp.array2d(dtype=wp.int32),
        high: wp.array2d(dtype=wp.int32),
    ):
        """Where particles are: keys to sort by, and the first and last base node of each world along each axis."""
        world, p = wp.tid()
        cell = int(0)
        half = int(0)
        base = ivec()
        on_grid = bool(True)
        for axis in range(dim):
            last = scale.shape[axis] - 3
            there = wp.float64(sorted_x[world, p][axis]) / scale.exact_spacing - wp.float64(0.5)
            cell = cell * scale.shape[axis] + wp.clamp(int(wp.floor(there)), 0, last)
            if axis == up and there - wp.floor(there) >= wp.float64(0.5):
                half = 1
            here = wp.floor(wp.float64(x[world, p][axis]) / scale.exact_spacing - wp.float64(0.5))
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

    @wp.kernel(module=module, enable_backward=False)
    def centre_window(
        # Parameters:
        scale: Scale,
        shape: ivec,  # nodes of the window
        # In:
        low: wp.array2d(dtype=wp.int32),
        high: wp.array2d(dtype=wp.int32),
        # Out:
        origin: wp.array2d(dtype=wp.int32),
    ):
        world, axis = wp.tid()
        middle = (low[world, axis] + high[world, axis] + 3 - shape[axis]) / 2
        origin[world, axis] = wp.clamp(middle, 0, scale.shape[axis] - shape[axis])

    @wp.kernel(module=module, enable_backward=False)
    def enter_adj(
        # Parameters:
        scale: Scale,
        order: wp.array2d(dtype=wp.int32),
        # In:
        adj_x: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        adj_C: wp.array2d(dtype=mat),
        adj_F: wp.array2d(dtype=mat),
        # Out:
        adj: wp.array(dtype=real),
    ):
        """Adjoint of ``leave``."""
        world, place = wp.tid()
        i = world * order.shape[1] + place
        p = order[world, place]
        store_vec(adj, i, row_fx, scale.spacing * adj_x[world, p])
        store_vec(adj, i, row_v, adj_v[world, p])
        store_mat(adj, i, row_H, adj_F[world, p])
        store_mat(adj, i, row_C, adj_C[world, p])

    @wp.kernel(module=module, enable_backward=False)
    def leave_adj(
        # Parameters:
        scale: Scale,
        order: wp.array2d(dtype=wp.int32),
        # In:
        adj: wp.array(dtype=real),
        # Out:
        adj_x: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        adj_C: wp.array2d(dtype=mat),
        adj_F: wp.array2d(dtype=mat),
    ):
        """Adjoint of ``enter``."""
        world, place = wp.tid()
        i = world * order.shape[1] + place
        p = order[world, place]
        adj_x[world, p] = load_vec(adj, i, row_fx) / scale.spacing
        adj_v[world, p] = load_vec(adj, i, row_v)
        adj_F[world, p] = load_mat(adj, i, row_H)
        adj_C[world, p] = load_mat(adj, i, row_C)

    return SimpleNamespace(
        enter=enter,
        leave=leave,
        locate=locate,
        centre_window=centre_window,
        enter_adj=enter_adj,
        leave_adj=leave_adj,
    )
