"""Bricks of cells: interpolation from nodes to particles, and sums over particles for nodes.

A brick is a box of cells with the window of their nodes. With r = o − f the distance of a particle from node o of its cell, in
cells, and ``rate`` = 4/dx, the sums

    Σ N_i a_i,  Σ a_i ⊗ g_i,  g_i = rate N_i r                                                       (Q1)
    Σ_p N_i b + A g_i                                                                                (Q1.adj)

are taken axis by axis. On the CPU a thread has a brick, reads nodes where they are and adds to the partial sums directly. On a
GPU a block of threads has a brick, with the nodes of its window in shared memory (bricks.h). There are no atomic additions:
results are the same bits in every run.

Particles anywhere: each thread has one particle of a row, and gives A and b to those threads that have one component of the sums
of a cell each. Particles on a lattice, the same in every cell: each thread has a layer of a cell, whose particles share weights.
"""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import torch
import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.rest import UNROLLED, rest
from softmpm.kernels.structs import types

HEADER = Path(__file__).with_name("bricks.h")


class Bricks(NamedTuple):
    """Size of bricks."""

    cells: tuple[int, ...]
    """Cells along each axis."""
    parts: int
    """Particles of a cell in a row."""
    lattice: bool = False
    """Whether all cells have the same ``parts`` places along each axis."""
    serial: bool = False
    """Whether one thread has a brick, as on the CPU."""
    blocks: int = 1
    """Blocks that a multiprocessor is to hold at least: more of them leave fewer registers for each."""

    @property
    def dim(self) -> int:
        return len(self.cells)

    @property
    def cell_count(self) -> int:
        return math.prod(self.cells)

    @property
    def slots(self) -> int:
        """Particles of a row."""
        return self.cell_count * self.parts

    @property
    def threads(self) -> int:
        """Threads that have a brick."""
        return 1 if self.serial else max(self.slots, self.cell_count * self.dim)

    @property
    def turns(self) -> int:
        """Places in a row and idle threads beside them."""
        return self.slots if self.serial else self.threads

    @property
    def layer_threads(self) -> int:
        """Threads that have a brick of a lattice."""
        return 1 if self.serial else self.slots

    @property
    def layer(self) -> int:
        """Particles of a layer of a lattice."""
        return self.parts ** (self.dim - 1)

    @property
    def window(self) -> tuple[int, ...]:
        """Nodes along each axis."""
        return tuple(length + 2 for length in self.cells)

    @property
    def nodes(self) -> int:
        return math.prod(self.window)

    @property
    def name(self) -> str:
        kind = "l" if self.lattice else "p"
        return "x".join(map(str, self.cells)) + f".{kind}{self.parts}.{self.blocks}" + "s" * self.serial

    @property
    def settings(self) -> dict:
        """Of kernels that have bricks."""
        return dict(enable_backward=False, grid_stride=False, launch_bounds=(self.threads, self.blocks))

    @property
    def layer_settings(self) -> dict:
        """Of kernels that have bricks of a lattice."""
        bounds = (self.layer_threads, self.blocks)
        return dict(enable_backward=False, grid_stride=False, launch_bounds=bounds)


FEW = 20_000
"""Below this number of particles bricks are small, so that more multiprocessors have one."""
LARGEST_LATTICE = 3
"""Places along each axis."""


def bricks_for(dim: int, particles: int, device: torch.device, dtype: torch.dtype, places: int) -> Bricks:
    """Size of the bricks.

    Args:
        particles: Of all worlds.
        places: Places along each axis if the particles are on a lattice, else 0.
    """
    lattice = 0 < places <= LARGEST_LATTICE
    serial, few = device.type == "cpu", particles < FEW
    if dim == 2:
        return Bricks((4, 4) if few and not serial else (8, 8), places if lattice else 4, lattice, serial)
    if serial:
        return Bricks((4, 4, 4), places if lattice else 4, lattice, serial)
    cells = (4, 4, 4) if not few else (4, 4, 2) if lattice else (2, 2, 2)
    if dtype == torch.float64:
        cells = (4, 2, 2)
    return Bricks(cells, places if lattice else 8 if few else 4, lattice)


def brick_module(name: str) -> str:
    """Set the compile options of the Warp module of this name, as native functions need them; returns the name."""
    source = HEADER.read_text()
    build = wp.ModuleBuildOptions(extra_cuda_preamble=source, extra_cpu_preamble=source)
    options = {
        "extra_build_options": build,
        "max_unroll": UNROLLED,
        "cuda_output": "cubin",
        "enable_backward": False,
    }
    wp.set_module_options(options, module=wp.get_module(name))
    return name


@wp.func_native("softmpm::meet();")
def meet(): ...


@kernel_factory
def field(dim: int, dtype: str, bricks: Bricks, number: int, layered: bool = False) -> SimpleNamespace:
    """Nodal field ``number`` of those that a kernel holds; ``layered`` says whether its threads have layers."""
    t, r = types(dim, dtype), rest(dim, dtype)
    real, vec, mat, Rest, weights, lean = t.real, t.vec, t.mat, r.Rest, r.weights, r.lean
    nodes, across, along = bricks.nodes, bricks.window[-2], bricks.window[-1]
    threads = bricks.layer_threads if layered else bricks.threads

    @wp.func_native(f"softmpm::stage<{number}, {nodes}, {threads}>(values, window, world, brick, lane);")
    def copy_window(
        values: wp.array2d(dtype=vec), window: wp.array2d(dtype=wp.int32), world: int, brick: int, lane: int
    ): ...

    @wp.func_native(f"return softmpm::fetch<{number}, {nodes}>(values, window, world, brick, k);")
    def fetch(
        values: wp.array2d(dtype=vec), window: wp.array2d(dtype=wp.int32), world: int, brick: int, k: int
    ) -> vec: ...

    @wp.func
    def stage(values: wp.array2d(dtype=vec), inside: Rest, world: int, brick: int, lane: int):
        """Make a field ready, after :func:`meet`."""
        if wp.static(not bricks.serial):
            copy_window(values, inside.window, world, brick, lane)

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

    return SimpleNamespace(stage=stage, gradient=gradient, value=value)


@kernel_factory
def sums(dim: int, dtype: str, bricks: Bricks, loaded: bool) -> SimpleNamespace:
    """Sums Σ A g or, if ``loaded``, Σ N b + A g over the particles of a brick, for the nodes of its window.

    A kernel calls ``clear``, for each row ``add``, and ``write``.
    """
    t, r = types(dim, dtype), rest(dim, dtype)
    real, vec, mat, Rest, weights, lean = t.real, t.vec, t.mat, r.Rest, r.weights, r.lean
    nodes, threads, count, cells = bricks.nodes, bricks.threads, r.count, bricks.cell_count
    parts, slots, serial = bricks.parts, bricks.slots, bricks.serial
    across, along, kinds = bricks.window[-2], bricks.window[-1], dim + (2 if loaded else 1)
    line = wp.types.vector(count, real)
    terms = f"{kinds * dim * slots}, {slots}"
    sizes = f"{nodes}, {threads}, {count}, {across}, {along}"

    @wp.func_native(f"softmpm::give<{terms}>(number, lane, value);")
    def give(number: int, lane: int, value: vec): ...

    @wp.func_native(f"return softmpm::given<{terms}, {t.c_name}, {dim}>(number, lane);")
    def given(number: int, lane: int) -> vec: ...

    @wp.func_native(f"softmpm::write_sums<{sizes}>(total, partial, world, brick, corner, axis, lane);")
    def write_shared(
        total: line,
        partial: wp.array2d(dtype=vec),
        world: int,
        brick: int,
        corner: int,
        axis: int,
        lane: int,
    ): ...

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

    @wp.func
    def place(n: int) -> int:
        """Node n of a cell in the window, from the cell's corner on."""
        if wp.static(dim == 2):
            return n / 3 * along + n % 3
        else:
            return (n / 9 * across + (n / 3) % 3) * along + n % 3

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
            x = with_term(line(), fx, row_of(A, 0), b[0])
            y = with_term(line(), fx, row_of(A, 1), b[1])
            z = line()
            if wp.static(dim == 3):
                z = with_term(line(), fx, row_of(A, 2), b[dim - 1])
            for n in range(count):
                at = brick * nodes + corner + place(n)
                if wp.static(dim == 2):
                    partial[world, at] = partial[world, at] + vec(x[n], y[n])
                else:
                    partial[world, at] = partial[world, at] + vec(x[n], y[n], z[n])
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
    def write(total: line, partial: wp.array2d(dtype=vec), inside: Rest, world: int, brick: int, lane: int):
        """Write the sums that ``add`` returned last."""
        if wp.static(not serial):
            corner = int(-1)
            if lane < cells * dim:
                corner = inside.corners[brick, lane % cells]
            write_shared(total, partial, world, brick, corner, lane / cells, lane)

    return SimpleNamespace(line=line, clear=clear, place_of=place_of, add=add, write=write)


@kernel_factory
def layers(dim: int, dtype: str, bricks: Bricks) -> SimpleNamespace:
    """Interpolation and sums of the layers of a lattice."""
    t, K, points = types(dim, dtype), bricks.parts, bricks.layer
    real, vec, mat = t.real, t.vec, t.mat
    table, block = wp.types.matrix((K * dim, 3), real), wp.types.matrix((points * dim, dim), real)
    across, along = bricks.window[-2], bricks.window[-1]
    where = f"{bricks.nodes}, {{}}{across}, {along}, {K}"
    gathers = f"{where.format('')}>(values, window, world, brick, corner, layer, lattice.w, lattice.e);"
    adds = f"{where.format(f'{bricks.cell_count}, ')}>(A, partial, world, brick, corner, layer, lane, lattice.w, lattice.e);"

    class Lattice:
        w: table  # [axis and place, node]
        e: table  # w (o − f)

    Lattice = wp.struct(Lattice, module=f"softmpm.types.d{dim}.{dtype}.lattice{K}")

    def gradients(number: int):
        """Σ a ⊗ g / rate of nodal field ``number``, ``dim`` rows for each particle."""

        @wp.func_native(f"return softmpm::layer_gradients<{number}, {gathers}")
        def gathered(
            values: wp.array2d(dtype=vec),
            window: wp.array2d(dtype=wp.int32),
            world: int,
            brick: int,
            corner: int,
            layer: int,
            lattice: Lattice,
        ) -> block: ...

        return gathered

    def adding(number: int):
        """Add A g / rate of each particle to sums ``number``, and write them."""

        @wp.func_native(f"softmpm::add_layer<{number}, {adds}")
        def add(
            A: block,
            partial: wp.array2d(dtype=vec),
            world: int,
            brick: int,
            corner: int,
            layer: int,
            lane: int,
            lattice: Lattice,
        ): ...

        return add

    @wp.func
    def taken(rows: block, n: int) -> mat:
        out = mat()
        for i in range(dim):
            for j in range(dim):
                out[i, j] = rows[dim * n + i, j]
        return out

    @wp.func
    def put(rows: block, n: int, A: mat) -> block:
        new = rows
        for i in range(dim):
            for j in range(dim):
                new[dim * n + i, j] = A[i, j]
        return new

    return SimpleNamespace(
        Lattice=Lattice,
        block=block,
        gradients=(gradients(0), gradients(1), gradients(2)),
        add=(adding(0), adding(1)),
        taken=taken,
        put=put,
    )
