"""Sums over particles on the CPU, whose threads must not add to the same node. Derivation: docs/math/scatter.md.

The contribution of a particle is (b + A o, m), see scatter.h. ``give`` stores b and A, and ``collect``, a launch of its own, adds them
up. A thread of ``collect`` has the nodes of a slab, those between two places along the first axis, and takes the particles in their
order: the sum of a node has the same terms in the same order whatever the slabs are. Particles are mostly sorted along the first axis,
so most blocks of them have none near a slab, and are skipped.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import NATIVE, WARP, native
from softmpm.kernels.structs import types

WIDTH = 4
"""Nodes of a slab along the first axis."""
LINE = 16
"""Numbers of 32 bits in a cache line, one for each block: threads that write next to each other would wait for each other."""


@kernel_factory
def slabs(dim: int, dtype: str) -> SimpleNamespace:
    t, n, s = types(dim, dtype), native(dim, dtype), stencil(dim, dtype)
    real, vec, mat, node_vec, Packed, Window = t.real, t.vec, t.mat, t.aligned, t.Packed, t.Window
    load_vec, load_mat, store_vec, store_mat = n.early.vector, n.early.matrix, n.store_vec, n.store_mat
    scatter_planes = n.scatter_planes
    first_node, unpack_base = s.first_node, s.unpack_base
    row_fx, row_v, row_C = t.row_fx, t.row_v, t.row_c

    @wp.struct
    class Shares:
        rows: wp.array(dtype=real)  # packed particles: b in the rows of v, A in those of C
        # Least and greatest place of a block's stencils along the first axis, of each block in a line of its own:
        ends: wp.array(dtype=wp.int32)

    @wp.func
    def give(to: Shares, i: int, plane: int, b: vec, A: mat):
        """Store a particle's contribution to the nodes from ``plane`` on. A block is that of one thread, from its first particle on."""
        store_vec(to.rows, i, row_v, b)
        store_mat(to.rows, i, row_C, A)
        least = i / WARP * LINE
        if i % WARP == 0:
            to.ends[least] = plane
            to.ends[least + 1] = plane
        else:
            to.ends[least] = wp.min(to.ends[least], plane)
            to.ends[least + 1] = wp.max(to.ends[least + 1], plane)

    @kernel(NATIVE)
    def collect(
        # Parameters:
        window: Window,
        count: int,  # particles of one world
        # In:
        states: Packed,
        shares: Shares,
        mass: wp.array2d(dtype=real),  # empty: none
        # Out, added into:
        node: wp.array(dtype=node_vec),
    ):
        world, slab = wp.tid()
        low = slab * WIDTH
        high = wp.min(low + WIDTH, window.shape[0])
        origin = window.origin[world]
        begin = world * count
        end = begin + count
        for block in range(begin / WARP, (end + WARP - 1) / WARP):
            if shares.ends[LINE * block] < high and shares.ends[LINE * block + 1] + 3 > low:
                for i in range(wp.max(begin, block * WARP), wp.min(end, (block + 1) * WARP)):
                    base = unpack_base(states.base[i])
                    plane = base[0] - origin[0]
                    if plane < high and plane + 3 > low:
                        g = load_vec(states.rows, i, row_fx)
                        for axis in range(dim):
                            g[axis] = g[axis] - real(1.0)
                        m = real(0.0)
                        if mass.shape[0] > 0:
                            m = mass[world, i - begin]
                        first = world * window.count + first_node(base, origin, window.shape)
                        b = load_vec(shares.rows, i, row_v)
                        A = load_mat(shares.rows, i, row_C)
                        planes = wp.max(0, low - plane)
                        scatter_planes(node, window.shape, first, g, b, A, m, planes, wp.min(3, high - plane))

    return SimpleNamespace(Shares=Shares, give=give, collect=collect)
