"""Fixed-point sums over particles, identical from run to run: the deterministic replacement of ``scatter`` in the fast scheme.

The contribution of a particle is (b + A o, m), see scatter.h. The unit of the sums follows from the largest contribution
(fixed_point.h), so an additional pass is needed: ``give`` stores b and A and their magnitude, ``push`` accumulates, ``take`` reads a
node and clears it, ``leave`` stores the result for later readers.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import NATIVE, native
from softmpm.kernels.structs import types


@kernel_factory
def fixed(dim: int) -> SimpleNamespace:
    """Kernels and functions of the fixed-point sums, in single precision: double has more digits than these sums resolve."""
    t, n, s = types(dim, "float32"), native(dim, "float32"), stencil(dim, "float32")
    vec, mat, ivec, node_vec, Packed, Window = t.vec, t.mat, t.ivec, t.aligned, t.Packed, t.Window
    load_vec, load_mat, store_vec, store_mat = n.early.vector, n.early.matrix, n.store_vec, n.store_mat
    store_node = n.store_node
    first_node, unpack_base = s.first_node, s.unpack_base
    row_fx, row_v, row_C = t.row_fx, t.row_v, t.row_c

    @wp.struct
    class Shares:
        rows: wp.array(dtype=float)  # packed particles: b in the rows of v, A in those of C
        largest: wp.array(dtype=float)  # (world, 2), at least |b + A o| and m of any particle

    @wp.struct
    class Sums:
        nodes: int  # of one world
        particles: int  # of one world
        fixed: wp.array(dtype=wp.int64)  # (world, node, 4)
        largest: wp.array(dtype=float)  # as above
        other_largest: wp.array(dtype=float)  # that of the next sums
        node: wp.array(dtype=node_vec)  # the sums as floats, stored by ``leave``

    @wp.func_native("softmpm::raise_largest(largest.data, slot, value);")
    def raise_largest(largest: wp.array(dtype=float), slot: int, value: float): ...

    @wp.func_native(
        f"softmpm::Fixed<{dim}> sums{{ reinterpret_cast<long long*>(to.data), largest.data, nodes, particles }}; "
        "softmpm::scatter_fixed(sums, shape, first, g, b, A, m);"
    )
    def scatter(
        to: wp.array(dtype=wp.int64),
        largest: wp.array(dtype=float),
        nodes: int,
        particles: int,
        shape: ivec,
        first: int,
        g: vec,
        b: vec,
        A: mat,
        m: float,
    ): ...

    @wp.func_native(
        f"softmpm::Fixed<{dim}> sums{{ reinterpret_cast<long long*>(of.data), largest.data, nodes, particles }}; "
        "return softmpm::take_fixed(sums, i);"
    )
    def take_fixed(
        of: wp.array(dtype=wp.int64), largest: wp.array(dtype=float), nodes: int, particles: int, i: int
    ) -> node_vec: ...

    @wp.func
    def give(to: Shares, i: int, count: int, total: int, b: vec, A: mat) -> bool:
        """Store a particle's contribution for ``push``; False if it overflows. All lanes of a warp must call this together."""
        world = int(-1)
        size = float(0.0)
        if i < total:
            world = i / count
            for axis in range(dim):
                size += wp.abs(b[axis])
                for other in range(dim):
                    size += wp.abs(A[axis, other])
            store_vec(to.rows, i, row_v, b)
            store_mat(to.rows, i, row_C, A)
        raise_largest(to.largest, 2 * world, size)
        return wp.isfinite(size * float(count))  # else its world's sums are not numbers

    @wp.func
    def leave(sums: Sums, i: int, value: node_vec):
        store_node(sums.node, i, value)

    @wp.func
    def take(sums: Sums, i: int) -> node_vec:
        """Read the sum of node ``i``, store it as floats for later readers, and clear it."""
        if i < sums.other_largest.shape[0] / 2:
            sums.other_largest[2 * i] = float(0.0)  # the largest mass stays
        sum = take_fixed(sums.fixed, sums.largest, sums.nodes, sums.particles, i)
        leave(sums, i, sum)
        return sum

    @kernel(NATIVE, grid_stride=False)
    def push(
        # Parameters:
        window: Window,
        total: int,  # particles of all worlds
        # In:
        states: Packed,
        shares: Shares,
        mass: wp.array2d(dtype=float),  # empty: none
        # Out, added into:
        sums: Sums,
    ):
        i = wp.tid()
        await_previous()
        first = int(-1)
        g = vec()
        b = vec()
        A = mat()
        m = float(0.0)
        if i < total:
            world = i / sums.particles
            g = load_vec(states.rows, i, row_fx)
            for axis in range(dim):
                g[axis] -= 1.0
            b = load_vec(shares.rows, i, row_v)
            A = load_mat(shares.rows, i, row_C)
            if mass.shape[0] > 0:
                m = mass[world, i - world * sums.particles]
            first = world * window.count + first_node(
                unpack_base(states.base[i]), window.origin[world], window.shape
            )
        scatter(sums.fixed, sums.largest, sums.nodes, sums.particles, window.shape, first, g, b, A, m)

    return SimpleNamespace(Shares=Shares, Sums=Sums, give=give, take=take, leave=leave, push=push)
