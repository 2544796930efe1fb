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


@kernel_factory
def displacements(dim: int, dtype: str) -> wp.Kernel:
    t, exact_vec, memory = types(dim, dtype), types(dim, "float64").vec, chunk(dim, dtype)
    real, vec, Constants, Chunk, moved = t.real, t.vec, t.Constants, memory.Chunk, memory.moved
    row = rows(dim, dtype)

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
            for s in range(at.length):
                d = between(at.shift[s, world], at.shift[s + 1, world])
                u, kept = moved(u, d, constants.dt, row(at.v, s + 1, world)[i], kept)
                row(at.u, s + 1, world)[i] = u

    return displacements
