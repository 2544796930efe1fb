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
    row, vecs, ahead = rows(dim, dtype), wp.types.matrix((AHEAD, dim), t.real), AHEAD

    @wp.func
    def difference(a: exact_vec, b: exact_vec) -> vec:
        """a − b of two shifts, which is exact if they are multiples of the quantum of (Q9)."""
        d = vec()
        for axis in range(dim):
            d[axis] = real(a[axis] - b[axis])
        return d

    @kernel(LAGRANGIAN)
    def displacements(constants: Constants, low: wp.array2d(dtype=vec), at: Chunk):
        """Displacements before each substep but the first. ``low`` is what rounding has kept from the first ones; it is overwritten."""
        world, k = wp.tid()
        last = at.length - 1
        for first in range(0, last, ahead):  # outside, so that a CPU reads few rows at a time
            d = vecs()
            for n in range(ahead):
                s = wp.min(first + n, last)
                d[n] = difference(at.shift[s + 1, world], at.shift[s, world])
            for i in range(first_of(k), end_of(k, low.shape[1])):
                u = row(at.u, first, world)[i]
                lost = row(low, world)[i]
                v = vecs()
                for n in range(ahead):
                    v[n] = row(at.v, wp.min(first + n, last) + 1, world)[i]
                for n in range(ahead):
                    if first + n < last:
                        u, lost = moved(u, d[n], constants.dt, v[n], lost)
                        row(at.u, first + n + 1, world)[i] = u
                row(low, world)[i] = lost

    return displacements
