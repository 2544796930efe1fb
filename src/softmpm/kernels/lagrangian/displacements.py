"""Displacements of a chunk once more, from its first ones and its velocities, so that a gradient stores velocities only (record.py).

They have the same bits: (Q4) is computed as in the forward pass, with d of (Q9) from the shifts.
"""

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.portions import end_of, first_of
from softmpm.kernels.lagrangian.rest import LAGRANGIAN
from softmpm.kernels.lagrangian.rows import rows
from softmpm.kernels.structs import types

AHEAD = 8
"""Substeps whose velocities and shifts are loaded together: on a GPU a thread has one node, and would wait for the memory in each."""


@kernel_factory
def displacements(dim: int, dtype: str) -> wp.Kernel:
    t, exact_vec, memory = types(dim, dtype), types(dim, "float64").vec, chunk(dim, dtype)
    real, vec, Constants, Chunk, moved = t.real, t.vec, t.Constants, memory.Chunk, memory.moved
    row, vecs, several = rows(dim, dtype), wp.types.matrix((AHEAD, dim), t.real), AHEAD

    @wp.func
    def between(a: exact_vec, b: exact_vec) -> vec:
        """b − a of two shifts, which is exact."""
        d = vec()
        for axis in range(dim):
            d[axis] = real(b[axis] - a[axis])
        return d

    @kernel(LAGRANGIAN)
    def displacements(constants: Constants, low: wp.array2d(dtype=vec), at: Chunk):
        """All but the first; ``low`` is what rounding has kept from these."""
        world, k = wp.tid()
        for i in range(first_of(k), end_of(k, low.shape[1])):
            u = row(at.u, 0, world)[i]
            kept = row(low, world)[i]
            for first in range(0, at.length, several):
                v = vecs()
                d = vecs()
                for n in range(several):
                    s = wp.min(first + n, at.length - 1)
                    v[n] = row(at.v, s + 1, world)[i]
                    d[n] = between(at.shift[s, world], at.shift[s + 1, world])
                for n in range(several):
                    if first + n < at.length:
                        u, kept = moved(u, d[n], constants.dt, v[n], kept)
                        row(at.u, first + n + 1, world)[i] = u

    return displacements
