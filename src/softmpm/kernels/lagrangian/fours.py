"""Interpolation and sums of one particle on the CPU, with four numbers at a time (fours.h)."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks
from softmpm.kernels.structs import types


@kernel_factory
def fours(dim: int, dtype: str, bricks: Bricks) -> SimpleNamespace:
    t = types(dim, dtype)
    vec, mat, table = t.vec, t.mat, wp.types.matrix((3, dim), t.real)
    sizes = f"{bricks.nodes}, {bricks.window[-2]}, {bricks.window[-1]}"

    @wp.func_native(f"return softmpm::cpu_gradient<{sizes}>(values, window, world, brick, corner, w, e);")
    def gradient(
        values: wp.array2d(dtype=vec),
        window: wp.array2d(dtype=wp.int32),
        world: int,
        brick: int,
        corner: int,
        w: table,
        e: table,
    ) -> mat:
        """Σ a ⊗ g / rate"""

    @wp.func_native(f"softmpm::cpu_add_one<{sizes}>(A, b, partial, world, brick, corner, w, e);")
    def add(
        A: mat,
        b: vec,
        partial: wp.array2d(dtype=vec),
        world: int,
        brick: int,
        corner: int,
        w: table,
        e: table,
    ):
        """Add N b + A g / rate to the sums of a brick."""

    return SimpleNamespace(gradient=gradient, add=add)
