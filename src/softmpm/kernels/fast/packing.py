"""Conversion between a user's state and the packed particles of the fast scheme. Exact to the last digit, as in kernels/convert.py.

``order`` contains the particle of the world at each place in the packed particles.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.convert import conversion
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import NATIVE, native
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.physics import status
from softmpm.kernels.structs import types


@kernel_factory
def packing(dim: int, dtype: str) -> SimpleNamespace:
    t, b, n, s = types(dim, dtype), conversion(dim, dtype), native(dim, dtype), stencil(dim, dtype)
    real, vec, mat = t.real, t.vec, t.mat
    Constants, Packed, Window = t.Constants, t.Packed, t.Window
    entered, left = b.entered, b.left
    load_vec, load_mat, store_vec, store_mat = n.early.vector, n.early.matrix, n.store_vec, n.store_mat
    spread_vec, spread_mat = n.spread_vec, n.spread_mat
    pack_base, unpack_base, report = s.pack_base, s.unpack_base, status.report(dim, dtype).report
    row_fx, row_low, row_v, row_H, row_C = t.row_fx, t.row_low, t.row_v, t.row_h, t.row_c
    kept_inside, bad_start = sorting(dim, dtype).kept_inside, int(Kind.START)

    @kernel(NATIVE)
    def enter(
        # Parameters:
        constants: Constants,
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
        words: wp.array(dtype=wp.int64),
        packed: Packed,
    ):
        world, place = wp.tid()
        i = world * order.shape[1] + place
        p = order[world, place]
        at = entered(
            constants, x[world, p], v[world, p], C[world, p], F[world, p], low_x[world, p], low_F[world, p]
        )
        if not at.valid:
            report(words, world, 0, bad_start, p)
        packed.base[i] = pack_base(kept_inside(words, window, world, p, at.base))
        store_vec(packed.rows, i, row_fx, at.fx)
        store_vec(packed.rows, i, row_low, at.low)
        store_vec(packed.rows, i, row_v, v[world, p])
        store_mat(packed.rows, i, row_H, at.H)
        store_mat(packed.rows, i, row_C, C[world, p])

    @kernel(NATIVE)
    def leave(
        # Parameters:
        constants: Constants,
        order: wp.array2d(dtype=wp.int32),
        # In:
        base: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=real),
        # Out:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
        low_x: wp.array2d(dtype=vec),
        low_F: wp.array2d(dtype=mat),
    ):
        world, place = wp.tid()
        total = order.shape[0] * order.shape[1]
        i = world * order.shape[1] + place
        row = world * order.shape[1] + order[world, place]
        out = left(
            constants,
            unpack_base(base[i]),
            load_vec(rows, i, row_fx),
            load_vec(rows, i, row_low),
            load_mat(rows, i, row_H),
        )
        spread_vec(x, row, out.x, i, total)
        spread_vec(v, row, load_vec(rows, i, row_v), i, total)
        spread_mat(C, row, load_mat(rows, i, row_C), i, total)
        spread_mat(F, row, out.F, i, total)
        if wp.static(dtype == "float32"):
            spread_vec(low_x, row, out.low_x, i, total)
            spread_mat(low_F, row, out.low_f, i, total)

    @kernel(NATIVE)
    def positions(
        # Parameters:
        constants: Constants,
        order: wp.array2d(dtype=wp.int32),
        # In:
        base: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=real),
        # Out:
        x: wp.array2d(dtype=vec),
    ):
        """The positions alone, as in ``leave``, from which particles are re-sorted."""
        world, place = wp.tid()
        i = world * order.shape[1] + place
        at = left(
            constants, unpack_base(base[i]), load_vec(rows, i, row_fx), load_vec(rows, i, row_low), mat()
        )
        x[world, order[world, place]] = at.x

    @kernel(NATIVE)
    def enter_adj(
        # Parameters:
        constants: Constants,
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
        store_vec(adj, i, row_fx, constants.spacing * adj_x[world, p])
        store_vec(adj, i, row_v, adj_v[world, p])
        store_mat(adj, i, row_H, adj_F[world, p])
        store_mat(adj, i, row_C, adj_C[world, p])

    @kernel(NATIVE)
    def leave_adj(
        # Parameters:
        constants: Constants,
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
        total = order.shape[0] * order.shape[1]
        i = world * order.shape[1] + place
        row = world * order.shape[1] + order[world, place]
        spread_vec(adj_x, row, load_vec(adj, i, row_fx) / constants.spacing, i, total)
        spread_vec(adj_v, row, load_vec(adj, i, row_v), i, total)
        spread_mat(adj_F, row, load_mat(adj, i, row_H), i, total)
        spread_mat(adj_C, row, load_mat(adj, i, row_C), i, total)

    return SimpleNamespace(
        enter=enter,
        leave=leave,
        positions=positions,
        enter_adj=enter_adj,
        leave_adj=leave_adj,
    )
