"""Struct of the nodes and cells at rest, and the gradient of their splines."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import types

UNROLLED = 27
"""Loops over the nodes of a cell are unrolled, so that their sums stay in registers."""


def lagrangian_module(name: str) -> str:
    """Set the compile options of the Warp module of this name; returns the name."""
    wp.set_module_options({"max_unroll": UNROLLED, "enable_backward": False}, module=wp.get_module(name))
    return name


@kernel_factory
def rest(dim: int, dtype: str) -> SimpleNamespace:
    t, s = types(dim, dtype), spline(dim, dtype)
    real, vec = t.real, t.vec
    weight, offset, position = s.weight, s.offset, s.position
    table = wp.types.matrix((3, dim), real)

    class Rest:
        """See :class:`softmpm.rest_grid.RestGrid`."""

        nodes: wp.array(dtype=t.ivec)
        fraction: wp.array(dtype=vec)
        particles: wp.array(dtype=wp.int32)
        first: wp.array(dtype=wp.int32)
        cell_nodes: wp.array2d(dtype=wp.int32)
        node_cells: wp.array2d(dtype=wp.int32)

    @wp.func
    def slope(w: table, n: int, fx: vec, rate: real) -> vec:
        """g of (Q1) [1/m] at node ``n`` of the cell; ``rate`` is 4/dx."""
        o = offset(n)
        return (rate * weight(w, o)) * (position(o) - fx)

    return SimpleNamespace(
        Rest=wp.struct(Rest, module=f"softmpm.types.d{dim}.{dtype}"),
        sums=wp.types.matrix((s.count, dim), real),
        count=s.count,
        slope=slope,
        weights=s.weights,
        weight=weight,
        offset=offset,
    )
