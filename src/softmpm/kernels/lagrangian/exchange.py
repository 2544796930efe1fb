"""Shared memory of a brick on a GPU: what the particles of a row give, then the sums of one field or two for the nodes (bricks.h)."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks
from softmpm.kernels.structs import types


@kernel_factory
def exchange(dim: int, dtype: str, bricks: Bricks, vectors: int, fields: int) -> SimpleNamespace:
    """Functions for ``vectors`` of each particle and so many fields of nodes."""
    t, count = types(dim, dtype), 3**dim
    vec, line = t.vec, wp.types.vector(count, t.real)
    size = bricks.terms(vectors * dim, fields)
    terms, (across, along) = f"{size}, {bricks.slots}", bricks.window[-2:]
    sizes = f"{size}, {bricks.nodes}, {bricks.threads}, {count}, {across}, {along}, {fields}"
    given = "total, first, second, world, brick, corner, component, lane"

    @wp.func_native(f"softmpm::give<{terms}>(number, lane, value);")
    def give(number: int, lane: int, value: vec): ...

    @wp.func_native(f"return softmpm::given<{terms}, {t.c_name}, {dim}>(number, lane);")
    def taken(number: int, lane: int) -> vec: ...

    @wp.func_native(f"softmpm::write_sums<{sizes}>({given});")
    def write(
        total: line,
        first: wp.array2d(dtype=vec),
        second: wp.array2d(dtype=vec),  # the first once more if there is one field
        world: int,
        brick: int,
        corner: int,
        component: int,
        lane: int,
    ): ...

    return SimpleNamespace(line=line, give=give, taken=taken, write=write)
