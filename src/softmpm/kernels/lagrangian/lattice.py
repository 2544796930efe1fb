"""Forces on the nodes, brick by brick, of particles on a lattice: as cells.py, but particles of a layer share their weights."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.lagrangian.bricks import Bricks, block_number, brick_options, meet, thread_number
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.interpolation import field, sums
from softmpm.kernels.lagrangian.layers import lattice_seats, layers
from softmpm.kernels.lagrangian.particle_force import CHECKED, particle_forces, particle_forces_adj
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types

WARPS, WARPS_ADJ = 20, 16
"""Warps of a multiprocessor, forward and adjoint, at which the threads of small layers hardly spill registers."""


def lattice_options(bricks: Bricks) -> dict:
    """Compile options. On a CPU the particles of a layer are in a loop: one after the other, their code fills the instruction cache."""
    return brick_options() | ({"max_unroll": bricks.dim} if bricks.serial else {})


def resident(spec: Spec, bricks: Bricks, warps: int) -> int:
    """``warps`` where a thread has few numbers, else 0, no demand."""
    small = bricks.parts <= 2 and not spec.viscosity and spec.dtype == "float32"
    return warps if small and not bricks.serial else 0


@kernel_factory
def lattice_cells(spec: Spec, bricks: Bricks) -> SimpleNamespace:
    """As :func:`cells`, for particles on a lattice without external forces of their own."""
    t, Rest, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype).Rest, particle_forces(spec)
    Constants, dim, mat = t.Constants, spec.dim, t.mat
    ParticleInputs, forced, given_to = input_types(spec).ParticleInputs, one.forced, one.given_to
    check_now, is_valid, memory = one.check_now, one.is_valid, chunk(dim, spec.dtype)
    Chunk, state_of, u_of = memory.Chunk, memory.state_of, memory.u_of
    of_u, of_v = (field(dim, spec.dtype, bricks, number, True) for number in range(2))
    stage_u, stage_v, clear = of_u.stage_at, of_v.stage_at, sums(dim, spec.dtype, bricks, False).clear
    one_layer, viscous = layers(dim, spec.dtype, bricks), spec.viscosity
    Lattice, block, places_of = one_layer.Lattice, one_layer.block, one_layer.places_of
    Seat, seat_of = lattice_seats(spec, bricks).Seat, lattice_seats(spec, bricks).seat_of
    taken, add, points = one_layer.taken, one_layer.add, bricks.layer
    gradients_u, gradients_v = one_layer.gradients[0], one_layer.gradients[1]
    count, turns, serial = bricks.cell_count, bricks.slots // bricks.layer_threads, bricks.serial
    options = lattice_options(bricks)

    @wp.func
    def forces_at(
        world: int,
        brick: int,
        lane: int,
        seat: Seat,
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        lattice: Lattice,
        at: Chunk,
        s: int,
    ):
        u = at.u[u_of(at, s)]
        v = at.v[state_of(at, s)]
        corner = seat.corner
        place = seat.places
        stage_u(u, seat.nodes, world, lane)
        if wp.static(viscous):
            stage_v(v, seat.nodes, world, lane)
        clear(at.partial, world, brick)
        meet()
        for turn in range(turns):  # a single one on a GPU
            slot = lane + turn
            if wp.static(serial):
                corner = inside.corners[brick, slot % count]
                place = places_of(inside, brick, slot)
            layer = slot / count
            A = block()
            bad = bool(False)
            if corner >= 0:
                H = gradients_u(u, inside.window, world, brick, corner, layer, lattice)  # (Q1)
                rate = block()
                if wp.static(viscous):
                    rate = gradients_v(v, inside.window, world, brick, corner, layer, lattice)
                for n in range(points):
                    p = wp.max(place[n], 0)
                    own = given_to(inputs, world, p)
                    there = place[n] >= 0  # a branch on it would keep the particles from waiting together
                    Hn = mat()
                    rate_n = mat()
                    for i in range(dim):  # in place: functions would copy those of all particles
                        for j in range(dim):
                            Hn[i, j] = H[dim * n + i, j]
                            if wp.static(viscous):
                                rate_n[i, j] = rate[dim * n + i, j]
                    An = wp.where(there, forced(own, Hn, rate_n), mat())  # (Q2)
                    for i in range(dim):
                        for j in range(dim):
                            A[dim * n + i, j] = An[i, j]
                    if wp.static(serial):
                        if there:
                            check_now(constants, inputs, inside, at.words, world, p, s, Hn)
                    else:
                        bad = bad or (there and not is_valid(constants, Hn))
            add(A, at.partial, world, brick, corner, layer, lane, lattice)
            if wp.static(not serial):  # here and with H once more, so that the particles do not wait for it
                if corner >= 0 and (bad or s % CHECKED == 0):
                    H = gradients_u(u, inside.window, world, brick, corner, layer, lattice)
                    for n in range(points):
                        if place[n] >= 0:
                            check_now(constants, inputs, inside, at.words, world, place[n], s, taken(H, n))

    @kernel(options, **bricks.layer_settings(resident(spec, bricks, WARPS)))
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
        seat = seat_of(inside, inputs, world, brick, lane)
        await_previous()
        forces_at(world, brick, lane, seat, constants, inputs, inside, lattice, at, s)

    return SimpleNamespace(seat_of=seat_of, forces=forces, forces_at=forces_at)


@kernel_factory
def lattice_cells_adj(spec: Spec, wanted: RequestedGrads, bricks: Bricks) -> SimpleNamespace:
    """As :func:`cells_adj`, for particles on a lattice without external forces of their own."""
    t = types(spec.dim, spec.dtype)
    Rest = rest(spec.dim, spec.dtype).Rest
    one = particle_forces_adj(spec, wanted)
    Constants, dim = t.Constants, spec.dim
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    forced_adj, check_adj, one_layer = one.forced_adj, one.check_adj, layers(dim, spec.dtype, bricks)
    given_to = particle_forces(spec).given_to
    Seat, seat_of = lattice_seats(spec, bricks).Seat, lattice_seats(spec, bricks).seat_of
    of_u, of_f, of_v = (field(dim, spec.dtype, bricks, number, True) for number in range(3))
    stage_u, stage_f, stage_v = of_u.stage_at, of_f.stage_at, of_v.stage_at
    clear, viscous = sums(dim, spec.dtype, bricks, False).clear, spec.viscosity
    Lattice, block, places_of = one_layer.Lattice, one_layer.block, one_layer.places_of
    taken, put, add, points = one_layer.taken, one_layer.put, one_layer.add, bricks.layer
    gradients_u, gradients_f, gradients_v = one_layer.gradients
    count, turns, serial = bricks.cell_count, bricks.slots // bricks.layer_threads, bricks.serial
    memory = chunk(dim, spec.dtype)
    Chunk, Adjoint = memory.Chunk, memory.Adjoint
    options = lattice_options(bricks)

    @wp.func
    def forces_adj_at(
        world: int,
        brick: int,
        lane: int,
        seat: Seat,
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
        corner = seat.corner
        place = seat.places
        stage_u(u, seat.nodes, world, lane)
        stage_f(bar.f, seat.nodes, world, lane)
        clear(bar.partial_u, world, brick)
        if wp.static(viscous):
            stage_v(v, seat.nodes, world, lane)
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
                        Hn = taken(H, n)
                        Gn = taken(G, n)
                        own = given_to(inputs, world, p)
                        rate_n = taken(rate, n)
                        adj = forced_adj(own, Hn, rate_n, Gn, world, p, adj_inputs)
                        check_adj(at.words, world, inside.order[p], at.length - 1 - s, adj)
                        # (Q1.adj), on a CPU in place, which on a GPU with viscosity took 15 registers more:
                        if wp.static(serial):
                            for i in range(dim):
                                for j in range(dim):
                                    A[dim * n + i, j] = adj.F[i, j]
                                    B[dim * n + i, j] = adj.rate[i, j]
                        else:
                            A = put(A, n, adj.F)
                            if wp.static(viscous):
                                B = put(B, n, adj.rate)
            add(A, bar.partial_u, world, brick, corner, layer, lane, lattice)
            if wp.static(viscous):
                add(B, bar.partial_v, world, brick, corner, layer, lane, lattice)

    @kernel(options, **bricks.layer_settings(resident(spec, bricks, WARPS_ADJ)))
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
        seat = seat_of(inside, inputs, world, brick, lane)
        await_previous()
        forces_adj_at(world, brick, lane, seat, constants, inputs, inside, lattice, at, bar, adj_inputs, s)

    return SimpleNamespace(seat_of=seat_of, forces_adj=forces_adj, forces_adj_at=forces_adj_at)
