"""Layers of a lattice: particles of a cell that share their weights along the last axis, and that one thread has."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, window
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def layers(dim: int, dtype: str, bricks: Bricks) -> SimpleNamespace:
    """Interpolation and sums of the layers of a lattice."""
    t, K, points = types(dim, dtype), bricks.parts, bricks.layer
    real, vec, mat = t.real, t.vec, t.mat
    table, block = wp.types.matrix((K * dim, 3), real), wp.types.matrix((points * dim, dim), real)
    Rest, Places = rest(dim, dtype).Rest, wp.types.vector(points, wp.int32)
    across, along = bricks.window[-2], bricks.window[-1]
    where = f"{bricks.nodes}, {{}}{across}, {along}, {K}"
    gathers = f"{where.format('')}>(values, window, world, brick, corner, layer, lattice.w, lattice.e);"
    adds = f"{where.format(f'{bricks.cell_count}, ')}>(A, partial, world, brick, corner, layer, lane, lattice.w, lattice.e);"

    class Lattice:
        w: table  # [axis and place, node]
        e: table  # 4/dx w (o − f)

    Lattice = wp.struct(Lattice, module=f"softmpm.types.d{dim}.{dtype}.lattice{K}")

    def gradients(number: int):
        """Σ a ⊗ g of nodal field ``number``, ``dim`` rows for each particle."""

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

    @wp.func_native(f"softmpm::add_layer<{adds}")
    def add(
        A: block,
        partial: wp.array2d(dtype=vec),
        world: int,
        brick: int,
        corner: int,
        layer: int,
        lane: int,
        lattice: Lattice,
    ):
        """Add A g of each particle, and write the sums."""

    @wp.func
    def places_of(inside: Rest, brick: int, slot: int) -> Places:
        """Places of the particles of a layer, or -1."""
        out = Places()
        for n in range(points):
            out[n] = inside.places[brick * points + n, slot]
        return out

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
        add=add,
        Places=Places,
        places_of=places_of,
        taken=taken,
        put=put,
    )


@kernel_factory
def lattice_seats(spec: Spec, bricks: Bricks) -> SimpleNamespace:
    """As :func:`seats`."""
    Rest, ParticleInputs = rest(spec.dim, spec.dtype).Rest, input_types(spec).ParticleInputs
    windows = window(bricks, bricks.layer_threads)
    one = layers(spec.dim, spec.dtype, bricks)
    count = bricks.cell_count
    Window, window_of, Places, places_of = windows.Window, windows.window_of, one.Places, one.places_of

    @wp.struct
    class Seat:
        nodes: Window
        corner: int
        places: Places

    @wp.func
    def seat_of(inside: Rest, inputs: ParticleInputs, world: int, brick: int, lane: int) -> Seat:
        out = Seat()
        out.nodes = window_of(inside.window, brick, lane)
        out.corner = inside.corners[brick, lane % count]
        out.places = places_of(inside, brick, lane)
        return out

    return SimpleNamespace(Seat=Seat, seat_of=seat_of)
