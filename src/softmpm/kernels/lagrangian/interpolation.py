"""Interpolation from nodes to particles, and sums over particles for nodes, in bricks of cells.

With r = o − f the distance of a particle from node o of its cell, in cells, and ``rate`` = 4/dx, the sums

    Σ N_i a_i,  Σ a_i ⊗ g_i,  g_i = rate N_i r                                                       (Q1)
    Σ_p N_i b + A g_i                                                                                (Q1.adj)

are taken axis by axis. On a GPU the thread of a particle gives A and b to those threads that have one component of the sums of a cell
each.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, meet, window
from softmpm.kernels.lagrangian.exchange import exchange
from softmpm.kernels.lagrangian.fours import fours
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.structs import types


@kernel_factory
def field(dim: int, dtype: str, bricks: Bricks, number: int, layered: bool = False) -> SimpleNamespace:
    """Nodal field ``number`` of those that a kernel holds; ``layered`` says whether its threads have layers."""
    t, r = types(dim, dtype), rest(dim, dtype)
    real, vec, mat, Rest, weights, lean = t.real, t.vec, t.mat, r.Rest, r.weights, r.lean
    nodes, across, along = bricks.nodes, bricks.window[-2], bricks.window[-1]
    threads, of_one = bricks.layer_threads if layered else bricks.threads, fours(dim, dtype, bricks).gradient
    windows = window(bricks, threads)
    Window, window_of = windows.Window, windows.window_of

    @wp.func_native(f"softmpm::stage<{number}, {nodes}, {threads}>(values, at, world, lane);")
    def copy_window(values: wp.array2d(dtype=vec), at: Window, world: int, lane: int): ...

    @wp.func_native(f"return softmpm::fetch<{number}, {nodes}>(values, window, world, brick, k);")
    def fetch(
        values: wp.array2d(dtype=vec), window: wp.array2d(dtype=wp.int32), world: int, brick: int, k: int
    ) -> vec: ...

    @wp.func
    def stage_at(values: wp.array2d(dtype=vec), at: Window, world: int, lane: int):
        """Make a field ready, after :func:`meet`."""
        if wp.static(not bricks.serial):
            copy_window(values, at, world, lane)

    @wp.func
    def stage(values: wp.array2d(dtype=vec), inside: Rest, world: int, brick: int, lane: int):
        stage_at(values, window_of(inside.window, brick, lane), world, lane)

    @wp.func
    def node(values: wp.array2d(dtype=vec), inside: Rest, world: int, brick: int, k: int) -> vec:
        return fetch(values, inside.window, world, brick, k)

    if dim == 2:

        @wp.func
        def gradient(
            values: wp.array2d(dtype=vec),
            inside: Rest,
            world: int,
            brick: int,
            corner: int,
            fx: vec,
            rate: real,
        ) -> mat:
            """Σ a ⊗ g"""
            w = weights(fx)
            e = lean(w, fx)
            out = mat()
            for i in range(3):
                plain = vec()
                sloped = vec()
                for j in range(3):
                    a = node(values, inside, world, brick, corner + along * i + j)
                    plain += w[j, 1] * a
                    sloped += e[j, 1] * a
                for axis in range(2):
                    out[axis, 0] = out[axis, 0] + e[i, 0] * plain[axis]
                    out[axis, 1] = out[axis, 1] + w[i, 0] * sloped[axis]
            return rate * out

        @wp.func
        def value(
            values: wp.array2d(dtype=vec), inside: Rest, world: int, brick: int, corner: int, fx: vec
        ) -> vec:
            """Σ N a"""
            w = weights(fx)
            out = vec()
            for i in range(3):
                for j in range(3):
                    a = node(values, inside, world, brick, corner + along * i + j)
                    out += (w[i, 0] * w[j, 1]) * a
            return out
    else:

        @wp.func
        def gradient(
            values: wp.array2d(dtype=vec),
            inside: Rest,
            world: int,
            brick: int,
            corner: int,
            fx: vec,
            rate: real,
        ) -> mat:
            """Σ a ⊗ g"""
            w = weights(fx)
            e = lean(w, fx)
            out = mat()
            for i in range(3):
                plain = vec()
                y_sloped = vec()
                z_sloped = vec()
                for j in range(3):
                    line = vec()
                    sloped = vec()
                    for k in range(3):
                        at = corner + along * (across * i + j) + k
                        a = node(values, inside, world, brick, at)
                        line += w[k, 2] * a
                        sloped += e[k, 2] * a
                    plain += w[j, 1] * line
                    y_sloped += e[j, 1] * line
                    z_sloped += w[j, 1] * sloped
                for axis in range(3):
                    out[axis, 0] = out[axis, 0] + e[i, 0] * plain[axis]
                    out[axis, 1] = out[axis, 1] + w[i, 0] * y_sloped[axis]
                    out[axis, 2] = out[axis, 2] + w[i, 0] * z_sloped[axis]
            return rate * out

        @wp.func
        def value(
            values: wp.array2d(dtype=vec), inside: Rest, world: int, brick: int, corner: int, fx: vec
        ) -> vec:
            """Σ N a"""
            w = weights(fx)
            out = vec()
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        at = corner + along * (across * i + j) + k
                        a = node(values, inside, world, brick, at)
                        out += (w[i, 0] * w[j, 1] * w[k, 2]) * a
            return out

    if bricks.serial:

        @wp.func
        def gradient(
            values: wp.array2d(dtype=vec),
            inside: Rest,
            world: int,
            brick: int,
            corner: int,
            fx: vec,
            rate: real,
        ) -> mat:
            """Σ a ⊗ g"""
            w = weights(fx)
            return rate * of_one(values, inside.window, world, brick, corner, w, lean(w, fx))

    return SimpleNamespace(stage=stage, stage_at=stage_at, gradient=gradient, value=value)


@kernel_factory
def sums(dim: int, dtype: str, bricks: Bricks, loaded: bool) -> SimpleNamespace:
    """Sums Σ A g or, if ``loaded``, Σ N b + A g over the particles of a brick, for the nodes of its window.

    A kernel calls ``clear``, for each row ``add``, and ``write``.
    """
    t, r = types(dim, dtype), rest(dim, dtype)
    real, vec, mat, Rest, weights, lean = t.real, t.vec, t.mat, r.Rest, r.weights, r.lean
    nodes = bricks.nodes
    cells = bricks.cell_count
    parts = bricks.parts
    slots = bricks.slots
    serial = bricks.serial
    memory = exchange(dim, dtype, bricks, dim + (2 if loaded else 1), 1)
    add_of_one = fours(dim, dtype, bricks).add
    line, give, given, write_shared = memory.line, memory.give, memory.taken, memory.write

    if dim == 2:

        @wp.func
        def with_term(total: line, fx: vec, A: vec, b: real) -> line:
            """Add A·g/rate + N b of one particle, with one row of A and component of b."""
            w = weights(fx)
            e = lean(w, fx)
            new = total
            for i in range(3):
                plain = e[i, 0] * A[0]
                if wp.static(loaded):
                    plain += w[i, 0] * b
                sloped = w[i, 0] * A[1]
                for j in range(3):
                    new[3 * i + j] = new[3 * i + j] + (w[j, 1] * plain + e[j, 1] * sloped)
            return new
    else:

        @wp.func
        def with_term(total: line, fx: vec, A: vec, b: real) -> line:
            """Add A·g/rate + N b of one particle, with one row of A and component of b."""
            w = weights(fx)
            e = lean(w, fx)
            new = total
            for i in range(3):
                x = e[i, 0] * A[0]
                if wp.static(loaded):
                    x += w[i, 0] * b
                y = w[i, 0] * A[1]
                z = w[i, 0] * A[2]
                for j in range(3):
                    plain = w[j, 1] * x + e[j, 1] * y
                    sloped = w[j, 1] * z
                    for k in range(3):
                        new[9 * i + 3 * j + k] = new[9 * i + 3 * j + k] + (w[k, 2] * plain + e[k, 2] * sloped)
            return new

    @wp.func
    def row_of(A: mat, axis: int) -> vec:
        out = vec()
        for k in range(dim):
            out[k] = A[axis, k]
        return out

    @wp.func_native(f"softmpm::clear_sums<{nodes}>(partial, world, brick);")
    def clear(partial: wp.array2d(dtype=vec), world: int, brick: int): ...

    @wp.func
    def place_of(inside: Rest, row: int, slot: int) -> int:
        """Place of the particle in a slot of a row, or -1."""
        place = int(-1)
        if slot < slots:
            place = inside.places[row, slot]
        return place

    @wp.func
    def add(
        total: line,
        partial: wp.array2d(dtype=vec),
        world: int,
        brick: int,
        slot: int,
        corner: int,
        fx: vec,
        A: mat,
        b: vec,
    ) -> line:
        """Add what the particles of a row give; A and b are zero where there is none. All threads of a block call this together."""
        if wp.static(serial):
            if corner >= 0:  # else no cell
                w = weights(fx)
                add_of_one(A, b, partial, world, brick, corner, w, lean(w, fx))
            return total
        else:
            if slot < slots:
                give(0, slot, fx)
                for axis in range(dim):
                    give(1 + axis, slot, row_of(A, axis))
                if wp.static(loaded):
                    give(1 + dim, slot, b)
            meet()
            new = total
            if slot < cells * dim:
                component = slot / cells
                for part in range(parts):
                    other = part * cells + slot % cells
                    load = real(0.0)
                    if wp.static(loaded):
                        load = given(1 + dim, other)[component]
                    new = with_term(new, given(0, other), given(1 + component, other), load)
            meet()
            return new

    @wp.func
    def write(total: line, partial: wp.array2d(dtype=vec), corner: int, world: int, brick: int, lane: int):
        """Write the sums that ``add`` returned last; ``corner`` is that of cell ``lane`` modulo their number."""
        if wp.static(not serial):
            own = int(-1)
            if lane < cells * dim:
                own = corner
            write_shared(total, partial, partial, world, brick, own, lane / cells, lane)

    return SimpleNamespace(
        line=line, with_term=with_term, row_of=row_of, clear=clear, place_of=place_of, add=add, write=write
    )
