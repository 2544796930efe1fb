"""Sums of two fields over the particles of a brick: at once if there are threads for all components, else one after the other."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, meet
from softmpm.kernels.lagrangian.exchange import exchange
from softmpm.kernels.lagrangian.interpolation import sums
from softmpm.kernels.structs import types


@kernel_factory
def pair_sums(dim: int, dtype: str, bricks: Bricks) -> SimpleNamespace:
    """As :func:`sums` for Σ A g and Σ B g."""
    t, one, cells, parts = types(dim, dtype), sums(dim, dtype, bricks, False), bricks.cell_count, bricks.parts
    real, vec, mat, line, with_term, row_of = t.real, t.vec, t.mat, one.line, one.with_term, one.row_of
    add_one, write_one, slots, components = one.add, one.write, bricks.slots, 2 * cells * dim
    at_once, memory = bricks.pairs, exchange(dim, dtype, bricks, 2 * dim + 1, 2)
    give, given, write_shared = memory.give, memory.taken, memory.write

    @wp.struct
    class Lines:
        first: line
        second: line  # unless both are taken at once

    @wp.func
    def add(
        total: Lines,
        first: wp.array2d(dtype=vec),
        second: wp.array2d(dtype=vec),
        world: int,
        brick: int,
        slot: int,
        corner: int,
        fx: vec,
        A: mat,
        B: mat,
    ) -> Lines:
        """Add what the particles of a row give; A and B are zero where there is none. All threads of a block call this together."""
        new = Lines()
        if wp.static(at_once):
            if slot < slots:
                give(0, slot, fx)
                for axis in range(dim):
                    give(1 + axis, slot, row_of(A, axis))
                    give(1 + dim + axis, slot, row_of(B, axis))
            meet()
            new.first = total.first
            if slot < components:
                for part in range(parts):
                    other = part * cells + slot % cells
                    row = given(1 + slot / cells, other)
                    new.first = with_term(new.first, given(0, other), row, real(0.0))
            meet()
        else:
            new.first = add_one(total.first, first, world, brick, slot, corner, fx, A, vec())
            new.second = add_one(total.second, second, world, brick, slot, corner, fx, B, vec())
        return new

    @wp.func
    def write(
        total: Lines,
        first: wp.array2d(dtype=vec),
        second: wp.array2d(dtype=vec),
        corner: int,
        world: int,
        brick: int,
        lane: int,
    ):
        """Write the sums that ``add`` returned last; ``corner`` is that of cell ``lane`` modulo their number."""
        if wp.static(at_once):
            own = int(-1)
            if lane < components:
                own = corner
            write_shared(total.first, first, second, world, brick, own, lane / cells, lane)
        else:
            write_one(total.first, first, corner, world, brick, lane)
            write_one(total.second, second, corner, world, brick, lane)

    return SimpleNamespace(Lines=Lines, add=add, write=write)
