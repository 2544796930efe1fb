"""Forces on the nodes, brick by brick, of particles anywhere. Derivation: docs/math/lagrangian.md.

    F = I + Σ u_i ⊗ g_i,  Ḟ = Σ v_i ⊗ g_i                                                            (Q1)
    f_i −= V P g_i,  f_i += N_i f_p                                                                  (Q2)
    f̄_p += Σ N_i f̄_i                                                                                 (Q2.adj)
    ū_i += F̄ g_i,  v̄_i += Ḟ̄ g_i                                                                      (Q1.adj)

What a particle does with F is in particle_force.py; nodes.py adds the sums of the bricks around a node.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.lagrangian.bricks import Bricks, brick_options, meet
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.interpolation import field, sums
from softmpm.kernels.lagrangian.pair_sums import pair_sums
from softmpm.kernels.lagrangian.particle_force import particle_forces, particle_forces_adj
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.lagrangian.seats import seats
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def cells(spec: Spec, bricks: Bricks) -> SimpleNamespace:
    t, Rest, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype).Rest, particle_forces(spec)
    vec, mat, Constants, dim = t.vec, t.mat, t.Constants, spec.dim
    ParticleInputs, forced = input_types(spec).ParticleInputs, one.forced
    check, check_step, check_now = one.check, one.check_step, one.check_now
    memory = chunk(dim, spec.dtype)
    Chunk, state_of, u_of = memory.Chunk, memory.state_of, memory.u_of
    of_u, of_v = (field(dim, spec.dtype, bricks, number) for number in range(2))
    stage, stage_u, stage_v = of_u.stage, of_u.stage_at, of_v.stage_at
    gradient_u, gradient_v, seat = of_u.gradient, of_v.gradient, seats(spec, bricks)
    Seat, seat_of, occupant_of = seat.Seat, seat.seat_of, seat.occupant_of
    viscous, loaded, settings = spec.viscosity, "force" in spec.given, bricks.settings
    of_f = sums(dim, spec.dtype, bricks, loaded)
    line, clear, add, write, place_of = of_f.line, of_f.clear, of_f.add, of_f.write, of_f.place_of
    count, turns, threads, serial = bricks.cell_count, bricks.turns, bricks.threads, bricks.serial
    options = brick_options()

    @wp.func
    def forces_at(
        world: int,
        brick: int,
        lane: int,
        seat: Seat,
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        at: Chunk,
        s: int,
    ):
        u = at.u[u_of(at, s)]
        v = at.v[state_of(at, s)]
        corner = seat.corner
        who = seat.occupant
        stage_u(u, seat.nodes, world, lane)
        if wp.static(viscous):
            stage_v(v, seat.nodes, world, lane)
        clear(at.partial, world, brick)
        meet()
        total = line()
        for row in range(seat.first, seat.last):
            for slot in range(lane, turns, threads):
                if wp.static(serial):
                    corner = inside.corners[brick, slot % count]
                    who = occupant_of(inside, inputs, world, row, slot)
                p = who.place
                A = mat()
                b = vec()
                if p >= 0:
                    H = gradient_u(u, inside, world, brick, corner, who.fx, constants.rate)  # (Q1)
                    rate = mat()
                    if wp.static(viscous):
                        rate = gradient_v(v, inside, world, brick, corner, who.fx, constants.rate)
                    A = constants.rate * forced(who.given, H, rate)  # (Q2)
                    if wp.static(loaded):
                        b = inputs.force[world, p]
                    # Last, so that nothing waits for it:
                    check_now(constants, inputs, inside, at.words, world, p, s, H)
                fx = who.fx
                if wp.static(not serial):
                    if row + 1 < seat.last:  # loaded while the sums are taken
                        who = occupant_of(inside, inputs, world, row + 1, lane)
                total = add(total, at.partial, world, brick, slot, corner, fx, A, b)
        write(total, at.partial, corner, world, brick, lane)

    @kernel(options, **settings)
    def forces(
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        at: Chunk,
        s: int,
    ):
        world, brick, lane = wp.tid()
        seat = seat_of(inside, inputs, world, brick, lane)
        await_previous()
        forces_at(world, brick, lane, seat, constants, inputs, inside, at, s)

    @kernel(options, **settings)
    def check_state(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        substep: int,
        limited: bool,  # whether Δt is compared with its limit
        placed: bool,  # whether the inputs are in the order of the places, or in the user's
        # In:
        u: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check a state; failures are reported for ``substep``."""
        world, brick, lane = wp.tid()
        stage(u, inside, world, brick, lane)
        meet()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                place = place_of(inside, row, slot)
                if place >= 0:
                    p = inside.order[place]
                    corner = inside.corners[brick, slot % count]
                    H = gradient_u(u, inside, world, brick, corner, inside.fraction[place], constants.rate)
                    check(constants, words, world, p, substep, H)
                    at = p
                    if placed:
                        at = place
                    if limited:
                        check_step(constants, inputs, words, world, at, p, substep, H)

    return SimpleNamespace(
        seat_of=seat_of,
        forces=forces,
        forces_at=forces_at,
        check_state=check_state,
    )


@kernel_factory
def cells_adj(spec: Spec, wanted: RequestedGrads, bricks: Bricks) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    Rest = rest(spec.dim, spec.dtype).Rest
    one = particle_forces_adj(spec, wanted)
    vec, mat, Constants, dim = t.vec, t.mat, t.Constants, spec.dim
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    forced_adj, check_adj = one.forced_adj, one.check_adj
    of_u, of_f, of_v = (field(dim, spec.dtype, bricks, number) for number in range(3))
    stage_u, stage_f, stage_v = of_u.stage_at, of_f.stage_at, of_v.stage_at
    gradient_u, gradient_f, gradient_v, value_f = of_u.gradient, of_f.gradient, of_v.gradient, of_f.value
    one_sum = sums(dim, spec.dtype, bricks, False)
    both = pair_sums(dim, spec.dtype, bricks)
    viscous = spec.viscosity
    clear, add, write, add_both, write_both = one_sum.clear, one_sum.add, one_sum.write, both.add, both.write
    lines, loaded = both.Lines if viscous else one_sum.line, "force" in wanted
    seat = seats(spec, bricks)
    Seat, seat_of, occupant_of = seat.Seat, seat.seat_of, seat.occupant_of
    count, turns, threads, settings = bricks.cell_count, bricks.turns, bricks.threads, bricks.settings
    serial, memory = bricks.serial, chunk(dim, spec.dtype)
    Chunk, Adjoint = memory.Chunk, memory.Adjoint
    options = brick_options()

    @wp.func
    def forces_adj_at(
        world: int,
        brick: int,
        lane: int,
        seat: Seat,
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: ParticleInputsAdj,
        s: int,
    ):
        u = at.u[s]
        v = at.v[s]
        corner = seat.corner
        who = seat.occupant
        stage_u(u, seat.nodes, world, lane)
        stage_f(bar.f, seat.nodes, world, lane)
        clear(bar.partial_u, world, brick)
        if wp.static(viscous):
            stage_v(v, seat.nodes, world, lane)
            clear(bar.partial_v, world, brick)
        meet()
        total = lines()
        for row in range(seat.first, seat.last):
            for slot in range(lane, turns, threads):
                if wp.static(serial):
                    corner = inside.corners[brick, slot % count]
                    who = occupant_of(inside, inputs, world, row, slot)
                p = who.place
                A = mat()
                B = mat()
                if p >= 0:
                    H = gradient_u(u, inside, world, brick, corner, who.fx, constants.rate)
                    G = gradient_f(bar.f, inside, world, brick, corner, who.fx, constants.rate)
                    rate = mat()
                    if wp.static(viscous):
                        rate = gradient_v(v, inside, world, brick, corner, who.fx, constants.rate)
                    adj = forced_adj(who.given, H, rate, G, world, p, adj_inputs)
                    check_adj(at.words, world, inside.order[p], at.length - 1 - s, adj)
                    A = constants.rate * adj.F  # (Q1.adj)
                    B = constants.rate * adj.rate
                    if wp.static(loaded):
                        share = value_f(bar.f, inside, world, brick, corner, who.fx)
                        adj_inputs.force[world, p] = adj_inputs.force[world, p] + share
                fx = who.fx
                if wp.static(not serial):
                    if row + 1 < seat.last:
                        who = occupant_of(inside, inputs, world, row + 1, lane)
                if wp.static(viscous):
                    total = add_both(
                        total, bar.partial_u, bar.partial_v, world, brick, slot, corner, fx, A, B
                    )
                else:
                    total = add(total, bar.partial_u, world, brick, slot, corner, fx, A, vec())
        if wp.static(viscous):
            write_both(total, bar.partial_u, bar.partial_v, corner, world, brick, lane)
        else:
            write(total, bar.partial_u, corner, world, brick, lane)

    @kernel(options, **settings)
    def forces_adj(
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: ParticleInputsAdj,
        s: int,
    ):
        world, brick, lane = wp.tid()
        seat = seat_of(inside, inputs, world, brick, lane)
        await_previous()
        forces_adj_at(world, brick, lane, seat, constants, inputs, inside, at, bar, adj_inputs, s)

    return SimpleNamespace(seat_of=seat_of, forces_adj=forces_adj, forces_adj_at=forces_adj_at)
