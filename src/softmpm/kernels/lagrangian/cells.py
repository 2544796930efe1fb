"""Internal forces, cell by cell: the particles of a cell share their nodes. Derivation: docs/math/lagrangian.md.

    F = I + Σ u_i ⊗ g_i,  Ḟ = Σ v_i ⊗ g_i                                                            (Q1)
    P = τ F⁻ᵀ,  f_i −= V P g_i,  f_i += N_i f_p                                                      (Q2)
    P̄ = −V Σ f̄_i ⊗ g_i,  τ̄ = P̄ F⁻¹,  F̄ −= F⁻ᵀ P̄ᵀ P,  f̄_p += Σ N_i f̄_i                              (Q2.adj)
    with viscosity, L = Ḟ F⁻¹:  Ḟ̄ = L̄ F⁻ᵀ,  F̄ −= Lᵀ L̄ F⁻ᵀ
    ū_i += F̄ g_i,  v̄_i += Ḟ̄ g_i                                                                      (Q1.adj)

A brick of cells takes its sums together (bricks.py); nodes.py adds those of the bricks around a node.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, brick_module, field, layers, meet, sums
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.rest_step import rest_step
from softmpm.kernels.physics.stress import total_stress, total_stress_adj
from softmpm.kernels.physics.viscosity import viscosity
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def particle_forces(spec: Spec) -> SimpleNamespace:
    """Functions of one particle."""
    t, k = types(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype)
    real, mat, Constants, dim = t.real, t.mat, t.Constants, spec.dim
    ParticleInputs, total_of = input_types(spec).ParticleInputs, total_stress(spec)
    rotation, stress, identity, volume_change = (
        total_of.rotation,
        total_of.stress,
        k.identity,
        k.volume_change,
    )
    viscous_stress, viscous = viscosity(dim, spec.dtype).viscous_stress, spec.viscosity
    report, largest = status.report(dim, spec.dtype).report, 1.0e12
    collapsed, not_finite, too_long = int(Kind.COLLAPSED), int(Kind.NOT_FINITE), int(Kind.STEP)
    step_is_stable = rest_step(spec).step_is_stable

    @wp.func
    def piola(inputs: ParticleInputs, world: int, p: int, H: mat, Q: mat, L: mat, inverse: mat) -> mat:
        """P of (Q2) [Pa]."""
        tau = stress(inputs, world, p, H, Q)
        if wp.static(viscous):
            tau += viscous_stress(identity() + H, L, inputs.viscosity[world, p])
        return tau * wp.transpose(inverse)

    @wp.func
    def forced(inputs: ParticleInputs, world: int, p: int, H: mat, rate: mat) -> mat:
        """−V P of a particle; ``rate`` is Ḟ."""
        inverse = wp.inverse(identity() + H)
        L = mat()
        if wp.static(viscous):
            L = rate * inverse
        return -inputs.volume[world, p] * piola(
            inputs, world, p, H, rotation(inputs, world, p, H), L, inverse
        )

    @wp.func
    def check(
        constants: Constants, words: wp.array(dtype=wp.int64), world: int, p: int, substep: int, H: mat
    ):
        """Report a particle that collapsed or is not finite. A comparison with NaN is false."""
        j = volume_change(H)
        if not (j > constants.collapse and j < real(largest)):
            kind = collapsed
            if not wp.isfinite(wp.ddot(H, H)) or not j < real(largest):
                kind = not_finite
            report(words, world, substep, kind, p)

    @wp.func
    def check_step(
        constants: Constants,
        inputs: ParticleInputs,
        words: wp.array(dtype=wp.int64),
        world: int,
        place: int,
        p: int,
        substep: int,
        H: mat,
    ):
        """Report a particle for which Δt is too long in the substep that begins with this H."""
        if wp.isfinite(constants.step):  # else the alarm is off
            if not step_is_stable(constants, inputs, world, place, H):
                report(words, world, substep, too_long, p)

    return SimpleNamespace(piola=piola, forced=forced, check=check, check_step=check_step)


@kernel_factory
def cells(spec: Spec, bricks: Bricks) -> SimpleNamespace:
    t, Rest, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype).Rest, particle_forces(spec)
    vec, mat, Constants, dim = t.vec, t.mat, t.Constants, spec.dim
    ParticleInputs, forced = input_types(spec).ParticleInputs, one.forced
    check, check_step = one.check, one.check_step
    of_u, of_v = (field(dim, spec.dtype, bricks, number) for number in range(2))
    stage_u, stage_v, gradient_u, gradient_v = of_u.stage, of_v.stage, of_u.gradient, of_v.gradient
    viscous, loaded, settings = spec.viscosity, "force" in spec.given, bricks.settings
    of_f = sums(dim, spec.dtype, bricks, loaded)
    line, clear, add, write, place_of = of_f.line, of_f.clear, of_f.add, of_f.write, of_f.place_of
    count, turns, threads = bricks.cell_count, bricks.turns, bricks.threads
    module = brick_module(f"{spec.module}.lagrangian.{bricks.name}")

    @wp.kernel(module=module, **settings)
    def forces(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        substep: int,
        # In:
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
        partial: wp.array2d(dtype=vec),
    ):
        world, brick, lane = wp.tid()
        stage_u(u, inside, world, brick, lane)
        if wp.static(viscous):
            stage_v(v, inside, world, brick, lane)
        clear(partial, world, brick)
        meet()
        total = line()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                p = place_of(inside, row, slot)
                corner = inside.corners[brick, slot % count]
                fx = vec()
                A = mat()
                b = vec()
                if p >= 0:
                    fx = inside.fraction[p]
                    H = gradient_u(u, inside, world, brick, corner, fx, constants.rate)  # (Q1)
                    rate = mat()
                    if wp.static(viscous):
                        rate = gradient_v(v, inside, world, brick, corner, fx, constants.rate)
                    if substep > 0:
                        check(constants, words, world, inside.order[p], substep - 1, H)
                    A = constants.rate * forced(inputs, world, p, H, rate)  # (Q2)
                    if wp.static(loaded):
                        b = inputs.force[world, p]
                total = add(total, partial, world, brick, slot, corner, fx, A, b)
        write(total, partial, inside, world, brick, lane)

    @wp.kernel(module=module, **settings)
    def check_end(
        # Parameters:
        constants: Constants,
        inside: Rest,
        substep: int,
        # In:
        u: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check the final state of a chunk, of which no forces are computed."""
        world, brick, lane = wp.tid()
        stage_u(u, inside, world, brick, lane)
        meet()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                p = place_of(inside, row, slot)
                if p >= 0:
                    corner = inside.corners[brick, slot % count]
                    H = gradient_u(u, inside, world, brick, corner, inside.fraction[p], constants.rate)
                    check(constants, words, world, inside.order[p], substep, H)

    @wp.kernel(module=module, **settings)
    def check_start(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        substep: int,
        placed: bool,  # whether the inputs are in the order of the places, or in the user's
        # In:
        u: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check the state at the beginning of a substep, with the step limit."""
        world, brick, lane = wp.tid()
        stage_u(u, inside, world, brick, lane)
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
                    check_step(constants, inputs, words, world, at, p, substep, H)

    return SimpleNamespace(forces=forces, check_end=check_end, check_start=check_start)


@kernel_factory
def lattice_cells(spec: Spec, bricks: Bricks) -> SimpleNamespace:
    """As :func:`cells`, for particles on a lattice without external forces of their own."""
    t, Rest, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype).Rest, particle_forces(spec)
    vec, Constants, dim = t.vec, t.Constants, spec.dim
    ParticleInputs, forced = input_types(spec).ParticleInputs, one.forced
    check = one.check
    of_u, of_v = (field(dim, spec.dtype, bricks, number, True) for number in range(2))
    stage_u, stage_v, clear = of_u.stage, of_v.stage, sums(dim, spec.dtype, bricks, False).clear
    layer_of, viscous = layers(dim, spec.dtype, bricks), spec.viscosity
    Lattice, block, taken, put, add = (
        layer_of.Lattice,
        layer_of.block,
        layer_of.taken,
        layer_of.put,
        layer_of.add[0],
    )
    gradients_u, gradients_v, points = layer_of.gradients[0], layer_of.gradients[1], bricks.layer
    count, slots, threads, settings = (
        bricks.cell_count,
        bricks.slots,
        bricks.layer_threads,
        bricks.layer_settings,
    )
    module = brick_module(f"{spec.module}.lagrangian.{bricks.name}.layers")

    @wp.kernel(module=module, **settings)
    def forces(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        lattice: Lattice,
        substep: int,
        # In:
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
        partial: wp.array2d(dtype=vec),
    ):
        world, brick, lane = wp.tid()
        stage_u(u, inside, world, brick, lane)
        if wp.static(viscous):
            stage_v(v, inside, world, brick, lane)
        clear(partial, world, brick)
        meet()
        for slot in range(lane, slots, threads):
            layer = slot / count
            corner = inside.corners[brick, slot % count]
            A = block()
            if corner >= 0:
                H = gradients_u(u, inside.window, world, brick, corner, layer, lattice)  # (Q1)
                rate = block()
                if wp.static(viscous):
                    rate = gradients_v(v, inside.window, world, brick, corner, layer, lattice)
                for n in range(points):
                    p = inside.places[brick * points + n, slot]
                    if p >= 0:
                        Hn = constants.rate * taken(H, n)
                        if substep > 0:
                            check(constants, words, world, inside.order[p], substep - 1, Hn)
                        A_n = forced(inputs, world, p, Hn, constants.rate * taken(rate, n))  # (Q2)
                        A = put(A, n, constants.rate * A_n)
            add(A, partial, world, brick, corner, layer, lane, lattice)

    return SimpleNamespace(forces=forces)


@kernel_factory
def particle_forces_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    """Adjoint of the functions of one particle."""
    t, identity = types(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype).identity
    mat, rotation, piola = t.mat, total_stress(spec).rotation, particle_forces(spec).piola
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    stress_adj, viscous = total_stress_adj(spec, wanted).stress_adj, spec.viscosity
    viscous_stress_adj = viscosity(spec.dim, spec.dtype).viscous_stress_adj
    report, bad_gradient = status.report(spec.dim, spec.dtype).report, int(Kind.GRADIENT)

    @wp.struct
    class ForceAdj:
        F: mat
        rate: mat

    @wp.func
    def forced_adj(
        inputs: ParticleInputs,
        world: int,
        p: int,
        H: mat,
        rate: mat,
        G: mat,  # Σ f̄_i ⊗ g_i
        adj_inputs: ParticleInputsAdj,
    ) -> ForceAdj:
        """(Q2.adj)"""
        inverse = wp.inverse(identity() + H)
        Q = rotation(inputs, world, p, H)
        L = mat()
        if wp.static(viscous):
            L = rate * inverse
        P = piola(inputs, world, p, H, Q, L, inverse)
        adj_P = -inputs.volume[world, p] * G
        adj_tau = adj_P * inverse
        adj = ForceAdj()
        adj.F = stress_adj(inputs, world, p, H, Q, adj_tau, adj_inputs)
        adj.F -= wp.transpose(inverse) * wp.transpose(adj_P) * P
        if wp.static(viscous):
            found = viscous_stress_adj(identity() + H, L, inputs.viscosity[world, p], adj_tau)
            adj.rate = found.C * wp.transpose(inverse)
            adj.F += found.F - wp.transpose(L) * adj.rate
            if wp.static("viscosity" in wanted):
                adj_inputs.viscosity[world, p] = adj_inputs.viscosity[world, p] + found.eta
        return adj

    @wp.func
    def check_adj(words: wp.array(dtype=wp.int64), world: int, p: int, substep: int, adj: ForceAdj):
        """Report a gradient that is not finite."""
        if not wp.isfinite(wp.ddot(adj.F, adj.F) + wp.ddot(adj.rate, adj.rate)):
            report(words, world, substep, bad_gradient, p)

    return SimpleNamespace(forced_adj=forced_adj, check_adj=check_adj, ForceAdj=ForceAdj)


@kernel_factory
def cells_adj(spec: Spec, wanted: RequestedGrads, bricks: Bricks) -> SimpleNamespace:
    t, Rest, one = (
        types(spec.dim, spec.dtype),
        rest(spec.dim, spec.dtype).Rest,
        particle_forces_adj(spec, wanted),
    )
    vec, mat, Constants, dim = t.vec, t.mat, t.Constants, spec.dim
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    forced_adj, check_adj = one.forced_adj, one.check_adj
    of_u, of_f, of_v = (field(dim, spec.dtype, bricks, number) for number in range(3))
    stage_u, stage_f, stage_v = of_u.stage, of_f.stage, of_v.stage
    gradient_u, gradient_f, gradient_v, value_f = of_u.gradient, of_f.gradient, of_v.gradient, of_f.value
    total_of, viscous, loaded = sums(dim, spec.dtype, bricks, False), spec.viscosity, "force" in wanted
    line, clear, add, write, place_of = (
        total_of.line,
        total_of.clear,
        total_of.add,
        total_of.write,
        total_of.place_of,
    )
    count, turns, threads, settings = bricks.cell_count, bricks.turns, bricks.threads, bricks.settings
    module = brick_module(f"{adj_module(spec, wanted)}.lagrangian.{bricks.name}")

    @wp.kernel(module=module, **settings)
    def forces_adj(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        substep: int,
        # In:
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        adj_f: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
        # Out, added into:
        adj_inputs: ParticleInputsAdj,
        # Out:
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
    ):
        world, brick, lane = wp.tid()
        stage_u(u, inside, world, brick, lane)
        stage_f(adj_f, inside, world, brick, lane)
        clear(partial_u, world, brick)
        if wp.static(viscous):
            stage_v(v, inside, world, brick, lane)
            clear(partial_v, world, brick)
        meet()
        total_u = line()
        total_v = line()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                p = place_of(inside, row, slot)
                corner = inside.corners[brick, slot % count]
                fx = vec()
                A = mat()
                B = mat()
                if p >= 0:
                    fx = inside.fraction[p]
                    H = gradient_u(u, inside, world, brick, corner, fx, constants.rate)
                    G = gradient_f(adj_f, inside, world, brick, corner, fx, constants.rate)
                    rate = mat()
                    if wp.static(viscous):
                        rate = gradient_v(v, inside, world, brick, corner, fx, constants.rate)
                    adj = forced_adj(inputs, world, p, H, rate, G, adj_inputs)
                    check_adj(words, world, inside.order[p], substep, adj)
                    A = constants.rate * adj.F  # (Q1.adj)
                    B = constants.rate * adj.rate
                    if wp.static(loaded):
                        share = value_f(adj_f, inside, world, brick, corner, fx)
                        adj_inputs.force[world, p] = adj_inputs.force[world, p] + share
                total_u = add(total_u, partial_u, world, brick, slot, corner, fx, A, vec())
                if wp.static(viscous):
                    total_v = add(total_v, partial_v, world, brick, slot, corner, fx, B, vec())
        write(total_u, partial_u, inside, world, brick, lane)
        if wp.static(viscous):
            write(total_v, partial_v, inside, world, brick, lane)

    return SimpleNamespace(forces_adj=forces_adj)


@kernel_factory
def lattice_cells_adj(spec: Spec, wanted: RequestedGrads, bricks: Bricks) -> SimpleNamespace:
    """As :func:`cells_adj`, for particles on a lattice without external forces of their own."""
    t, Rest, one = (
        types(spec.dim, spec.dtype),
        rest(spec.dim, spec.dtype).Rest,
        particle_forces_adj(spec, wanted),
    )
    vec, Constants, dim = t.vec, t.Constants, spec.dim
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    forced_adj, check_adj, layer_of = one.forced_adj, one.check_adj, layers(dim, spec.dtype, bricks)
    of_u, of_f, of_v = (field(dim, spec.dtype, bricks, number, True) for number in range(3))
    stage_u, stage_f, stage_v = of_u.stage, of_f.stage, of_v.stage
    clear, viscous = sums(dim, spec.dtype, bricks, False).clear, spec.viscosity
    Lattice, block, taken, put, points = (
        layer_of.Lattice,
        layer_of.block,
        layer_of.taken,
        layer_of.put,
        bricks.layer,
    )
    gradients_u, gradients_f, gradients_v = layer_of.gradients
    add_u, add_v = layer_of.add
    count, slots, threads, settings = (
        bricks.cell_count,
        bricks.slots,
        bricks.layer_threads,
        bricks.layer_settings,
    )
    module = brick_module(f"{adj_module(spec, wanted)}.lagrangian.{bricks.name}.layers")

    @wp.kernel(module=module, **settings)
    def forces_adj(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        lattice: Lattice,
        substep: int,
        # In:
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        adj_f: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
        # Out, added into:
        adj_inputs: ParticleInputsAdj,
        # Out:
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
    ):
        world, brick, lane = wp.tid()
        stage_u(u, inside, world, brick, lane)
        stage_f(adj_f, inside, world, brick, lane)
        clear(partial_u, world, brick)
        if wp.static(viscous):
            stage_v(v, inside, world, brick, lane)
            clear(partial_v, world, brick)
        meet()
        for slot in range(lane, slots, threads):
            layer = slot / count
            corner = inside.corners[brick, slot % count]
            A = block()
            B = block()
            if corner >= 0:
                H = gradients_u(u, inside.window, world, brick, corner, layer, lattice)
                G = gradients_f(adj_f, inside.window, world, brick, corner, layer, lattice)
                rate = block()
                if wp.static(viscous):
                    rate = gradients_v(v, inside.window, world, brick, corner, layer, lattice)
                for n in range(points):
                    p = inside.places[brick * points + n, slot]
                    if p >= 0:
                        Hn = constants.rate * taken(H, n)
                        Gn = constants.rate * taken(G, n)
                        adj = forced_adj(
                            inputs, world, p, Hn, constants.rate * taken(rate, n), Gn, adj_inputs
                        )
                        check_adj(words, world, inside.order[p], substep, adj)
                        A = put(A, n, constants.rate * adj.F)  # (Q1.adj)
                        if wp.static(viscous):
                            B = put(B, n, constants.rate * adj.rate)
            add_u(A, partial_u, world, brick, corner, layer, lane, lattice)
            if wp.static(viscous):
                add_v(B, partial_v, world, brick, corner, layer, lane, lattice)

    return SimpleNamespace(forces_adj=forces_adj)
