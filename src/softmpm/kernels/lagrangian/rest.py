"""Struct of the nodes, bricks and particles at rest."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.rows import ROWS_HEADER
from softmpm.kernels.parts import in_parts
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import types

UNROLLED = 27
"""Loops over the nodes of a cell are unrolled, so that their sums stay in registers."""


LAGRANGIAN = {"max_unroll": UNROLLED, "extra_build_options": in_parts(ROWS_HEADER.read_text())}
"""Compile options of kernels with rows of arrays, which a CPU may launch in parts."""


@kernel_factory
def rest(dim: int, dtype: str) -> SimpleNamespace:
    t, s = types(dim, dtype), spline(dim, dtype)

    class Rest:
        """See :class:`softmpm.rest_grid.RestGrid`."""

        nodes: wp.array(dtype=t.ivec)
        shares: wp.array2d(dtype=wp.int32)
        window: wp.array2d(dtype=wp.int32)
        rows: wp.array(dtype=wp.int32)
        places: wp.array2d(dtype=wp.int32)
        corners: wp.array2d(dtype=wp.int32)
        order: wp.array(dtype=wp.int32)
        touched: wp.array(dtype=wp.int32)  # number of each node among those that surface points act on, or -1
        fraction: wp.array(dtype=t.vec)

    real, vec = t.real, t.vec
    table = wp.types.matrix((3, dim), real)

    @wp.func
    def lean(w: table, fx: vec) -> table:
        """w (o − f) of each node o along each axis."""
        out = table()
        for axis in range(dim):
            out[0, axis] = -w[0, axis] * fx[axis]
            out[1, axis] = w[1, axis] * (real(1.0) - fx[axis])
            out[2, axis] = w[2, axis] * (real(2.0) - fx[axis])
        return out

    return SimpleNamespace(
        lean=lean,
        Rest=wp.struct(Rest, module=f"softmpm.types.d{dim}.{dtype}"),
        count=s.count,
        weights=s.weights,
    )
