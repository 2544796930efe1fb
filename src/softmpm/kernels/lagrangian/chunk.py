"""Structs of the memory of a chunk, and of one substep in it."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


@kernel_factory
def chunk(dim: int, dtype: str) -> SimpleNamespace:
    t, exact_vec = types(dim, dtype), types(dim, "float64").vec
    real, vec, module = t.real, t.vec, f"softmpm.types.d{dim}.{dtype}"

    class Chunk:
        """See :class:`softmpm.schemes.lagrangian.buffers.ChunkBuffers`. The first axis of u, v, anchor and shift counts states, that of
        w substeps (record.py); without ``keep`` two states take turns, and w has none; without ``keep_u`` two displacements do."""

        length: int
        keep: int
        keep_u: int
        words: wp.array(dtype=wp.int64)
        mass: wp.array2d(dtype=real)
        partial: wp.array2d(dtype=vec)
        shift: wp.array2d(dtype=exact_vec)
        low: wp.array3d(dtype=vec)  # of u and of v
        u: wp.array3d(dtype=vec)
        v: wp.array3d(dtype=vec)
        w: wp.array3d(dtype=vec)
        # Of surface contact:
        rate: wp.array(dtype=real)  # 1/T
        D: wp.array2d(dtype=real)
        free: wp.array2d(dtype=vec)
        impulse: wp.array2d(dtype=vec)
        force: wp.array3d(dtype=vec)
        anchor: wp.array4d(dtype=vec)

    class Adjoint:
        """See :class:`softmpm.schemes.lagrangian.buffers.SharedAdjoint`: adjoints of a state, of what follows from it in a substep, and
        of the masses."""

        held: int  # accumulators of one world in the adjoints of the inputs
        u: wp.array2d(dtype=vec)
        v: wp.array2d(dtype=vec)
        f: wp.array2d(dtype=vec)
        mass: wp.array2d(dtype=real)
        partial_u: wp.array2d(dtype=vec)
        partial_v: wp.array2d(dtype=vec)
        # Of surface contact:
        anchor: wp.array3d(dtype=vec)
        force: wp.array3d(dtype=vec)
        shared: wp.array2d(dtype=vec)
        x: wp.array2d(dtype=vec)
        free: wp.array2d(dtype=vec)
        D: wp.array2d(dtype=real)

    Chunk, Adjoint = wp.struct(Chunk, module=module), wp.struct(Adjoint, module=module)

    @wp.func
    def state_of(of: Chunk, s: int) -> int:
        """Number of the state before substep ``s``."""
        if of.keep == 1:
            return s
        else:
            return s % 2

    @wp.func
    def u_of(of: Chunk, s: int) -> int:
        """Number of the displacements before substep ``s``."""
        if of.keep_u == 1:
            return s
        else:
            return s % 2

    @wp.func
    def lost(a: vec, b: vec) -> vec:
        """Rounding error of a + b, where b is small."""
        return b - ((a + b) - a)

    @wp.func
    def moved(u: vec, d: vec, dt: real, v: vec, low: vec):
        """u' of (Q4), and what rounding keeps from it; ``low`` is what it kept from u."""
        here = u - d
        du = dt * v + low
        return here + du, lost(here, du)

    return SimpleNamespace(Chunk=Chunk, Adjoint=Adjoint, state_of=state_of, u_of=u_of, lost=lost, moved=moved)
