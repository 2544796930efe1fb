"""Rows of arrays: the numbers along the last axis, as of all nodes in one state of one world.

A thread finds an entry of a row with one instruction. In an array with several axes this took about ten, and such instructions were
more than half of those for a node on a GPU (rows.h).
"""

from pathlib import Path

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types

ROWS_HEADER = Path(__file__).with_name("rows.h")


@kernel_factory
def rows(dim: int, dtype: str) -> wp.Function:
    """``row(values, i, ...)`` of an array of numbers or vectors whose last axis is contiguous; kernels need ``ROWS_HEADER`` for it."""
    real, vec = types(dim, dtype).real, types(dim, dtype).vec

    @wp.func_native("return softmpm::row(values, i);")
    def row(values: wp.array2d(dtype=real), i: int) -> wp.array(dtype=real): ...

    @wp.func_native("return softmpm::row(values, i);")
    def row(values: wp.array2d(dtype=vec), i: int) -> wp.array(dtype=vec): ...

    @wp.func_native("return softmpm::row(values, i, j);")
    def row(values: wp.array3d(dtype=vec), i: int, j: int) -> wp.array(dtype=vec): ...

    @wp.func_native("return softmpm::row(values, i, j, k);")
    def row(values: wp.array4d(dtype=vec), i: int, j: int, k: int) -> wp.array(dtype=vec): ...

    return row
