"""Forces on the nodes, brick by brick, of particles on a lattice: as cells.py, but particles of a layer share their weights."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, block_number, brick_module, meet, thread_number
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.interpolation import field, sums
from softmpm.kernels.lagrangian.particle_force import particle_forces, particle_forces_adj
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types

WARPS, WARPS_ADJ = 20, 16
"""Warps of a multiprocessor, forward and adjoint, at which the threads of small layers hardly spill registers."""


def resident(spec: Spec, bricks: Bricks, warps: int) -> int:
    """``warps`` where a thread has few numbers, else 0, no demand."""
    small = bricks.parts <= 2 and not spec.viscosity and spec.dtype == "float32"
    return warps if small and not bricks.serial else 0


@kernel_factory
def layers(dim: int, dtype: str, bricks: Bricks) -> SimpleNamespace:
    """Interpolation and sums of the layers of a lattice."""
    t, K, points = types(dim, dtype), bricks.parts, bricks.layer
    real, vec, mat = t.real, t.vec, t.mat
    table, block = wp.types.matrix((K * dim, 3), real), wp.types.matrix((points * dim, dim), real)
    Rest, places = rest(dim, dtype).Rest, wp.types.vector(points, wp.int32)
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
        """Add A g / rate of each particle, and write the sums."""

    @wp.func
    def places_of(inside: Rest, brick: int, slot: int) -> places:
        """Places of the particles of a layer, or -1."""
        out = places()
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
        places_of=places_of,
        taken=taken,
        put=put,
    )


@kernel_factory
def lattice_cells(spec: Spec, bricks: Bricks) -> SimpleNamespace:
    """As :func:`cells`, for particles on a lattice without external forces of their own."""
    t, Rest, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype).Rest, particle_forces(spec)
    Constants, dim = t.Constants, spec.dim
    ParticleInputs, forced = input_types(spec).ParticleInputs, one.forced
    check, memory = one.check, chunk(dim, spec.dtype)
    Chunk, state_of = memory.Chunk, memory.state_of
    of_u, of_v = (field(dim, spec.dtype, bricks, number, True) for number in range(2))
    stage_u, stage_v, clear = of_u.stage, of_v.stage, sums(dim, spec.dtype, bricks, False).clear
    one_layer, viscous = layers(dim, spec.dtype, bricks), spec.viscosity
    Lattice, block, places_of = one_layer.Lattice, one_layer.block, one_layer.places_of
    taken, put, add, points = one_layer.taken, one_layer.put, one_layer.add, bricks.layer
    gradients_u, gradients_v = one_layer.gradients[0], one_layer.gradients[1]
    count, turns, serial = bricks.cell_count, bricks.slots // bricks.layer_threads, bricks.serial
    module = brick_module(f"{spec.module}.lagrangian.{bricks.name}.layers")

    @wp.func
    def forces_at(
        world: int,
        brick: int,
        lane: int,
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        lattice: Lattice,
        at: Chunk,
        s: int,
    ):
        now = state_of(at, s)
        u = at.u[now]
        v = at.v[now]
        corner = inside.corners[brick, lane % count]  # loaded while the nodes are awaited
        place = places_of(inside, brick, lane)
        stage_u(u, inside, world, brick, lane)
        if wp.static(viscous):
            stage_v(v, inside, world, brick, lane)
        clear(at.partial, world, brick)
        meet()
        for turn in range(turns):  # a single one on a GPU
            slot = lane + turn
            if wp.static(serial):
                corner = inside.corners[brick, slot % count]
                place = places_of(inside, brick, slot)
            layer = slot / count
            A = block()
            if corner >= 0:
                H = gradients_u(u, inside.window, world, brick, corner, layer, lattice)  # (Q1)
                rate = block()
                if wp.static(viscous):
                    rate = gradients_v(v, inside.window, world, brick, corner, layer, lattice)
                for n in range(points):
                    p = place[n]
                    if p >= 0:
                        Hn = constants.rate * taken(H, n)
                        A_n = forced(inputs, world, p, Hn, constants.rate * taken(rate, n))  # (Q2)
                        A = put(A, n, constants.rate * A_n)
                        if s > 0:  # last, so that nothing waits for it
                            check(constants, at.words, world, inside.order[p], s - 1, Hn)
            add(A, at.partial, world, brick, corner, layer, lane, lattice)

    @wp.kernel(module=module, **bricks.layer_settings(resident(spec, bricks, WARPS)))
    def forces(
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        lattice: Lattice,
        at: Chunk,
        s: int,
    ):
        world, brick, lane = wp.tid()
        if wp.static(not serial):
            world = block_number() / inside.corners.shape[0]
            brick = block_number() - world * inside.corners.shape[0]
            lane = thread_number()
        forces_at(world, brick, lane, constants, inputs, inside, lattice, at, s)

    return SimpleNamespace(forces=forces, forces_at=forces_at)


@kernel_factory
def lattice_cells_adj(spec: Spec, wanted: RequestedGrads, bricks: Bricks) -> SimpleNamespace:
    """As :func:`cells_adj`, for particles on a lattice without external forces of their own."""
    t, Rest, one = (
        types(spec.dim, spec.dtype),
        rest(spec.dim, spec.dtype).Rest,
        particle_forces_adj(spec, wanted),
    )
    Constants, dim = t.Constants, spec.dim
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    forced_adj, check_adj, one_layer = one.forced_adj, one.check_adj, layers(dim, spec.dtype, bricks)
    of_u, of_f, of_v = (field(dim, spec.dtype, bricks, number, True) for number in range(3))
    stage_u, stage_f, stage_v = of_u.stage, of_f.stage, of_v.stage
    clear, viscous = sums(dim, spec.dtype, bricks, False).clear, spec.viscosity
    Lattice, block, places_of = one_layer.Lattice, one_layer.block, one_layer.places_of
    taken, put, add, points = one_layer.taken, one_layer.put, one_layer.add, bricks.layer
    gradients_u, gradients_f, gradients_v = one_layer.gradients
    count, turns, serial = bricks.cell_count, bricks.slots // bricks.layer_threads, bricks.serial
    memory = chunk(dim, spec.dtype)
    Chunk, Adjoint = memory.Chunk, memory.Adjoint
    module = brick_module(f"{adj_module(spec, wanted)}.lagrangian.{bricks.name}.layers")

    @wp.func
    def forces_adj_at(
        world: int,
        brick: int,
        lane: int,
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        lattice: Lattice,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: ParticleInputsAdj,
        s: int,
    ):
        u = at.u[s]
        v = at.v[s]
        corner = inside.corners[brick, lane % count]  # loaded while the nodes are awaited
        place = places_of(inside, brick, lane)
        stage_u(u, inside, world, brick, lane)
        stage_f(bar.f, inside, world, brick, lane)
        clear(bar.partial_u, world, brick)
        if wp.static(viscous):
            stage_v(v, inside, world, brick, lane)
            clear(bar.partial_v, world, brick)
        meet()
        for turn in range(turns):  # a single one on a GPU
            slot = lane + turn
            if wp.static(serial):
                corner = inside.corners[brick, slot % count]
                place = places_of(inside, brick, slot)
            layer = slot / count
            A = block()
            B = block()
            if corner >= 0:
                H = gradients_u(u, inside.window, world, brick, corner, layer, lattice)
                G = gradients_f(bar.f, inside.window, world, brick, corner, layer, lattice)
                rate = block()
                if wp.static(viscous):
                    rate = gradients_v(v, inside.window, world, brick, corner, layer, lattice)
                for n in range(points):
                    p = place[n]
                    if p >= 0:
                        Hn = constants.rate * taken(H, n)
                        Gn = constants.rate * taken(G, n)
                        adj = forced_adj(
                            inputs, world, p, Hn, constants.rate * taken(rate, n), Gn, adj_inputs
                        )
                        check_adj(at.words, world, inside.order[p], at.length - 1 - s, adj)
                        A = put(A, n, constants.rate * adj.F)  # (Q1.adj)
                        if wp.static(viscous):
                            B = put(B, n, constants.rate * adj.rate)
            add(A, bar.partial_u, world, brick, corner, layer, lane, lattice)
            if wp.static(viscous):
                add(B, bar.partial_v, world, brick, corner, layer, lane, lattice)

    @wp.kernel(module=module, **bricks.layer_settings(resident(spec, bricks, WARPS_ADJ)))
    def forces_adj(
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        lattice: Lattice,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: ParticleInputsAdj,
        s: int,
    ):
        world, brick, lane = wp.tid()
        if wp.static(not serial):
            world = block_number() / inside.corners.shape[0]
            brick = block_number() - world * inside.corners.shape[0]
            lane = thread_number()
        forces_adj_at(world, brick, lane, constants, inputs, inside, lattice, at, bar, adj_inputs, s)

    return SimpleNamespace(forces_adj=forces_adj, forces_adj_at=forces_adj_at)
