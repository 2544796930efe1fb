"""Internal forces, cell by cell: the particles of a cell share their nodes. Derivation: docs/math/lagrangian.md.

    F = I + Σ u_i ⊗ g_i,  Ḟ = Σ v_i ⊗ g_i                                                            (Q1)
    P = τ F⁻ᵀ,  f_i −= V P g_i,  f_i += N_i f_p                                                      (Q2)
    P̄ = −V Σ f̄_i ⊗ g_i,  τ̄ = P̄ F⁻¹,  F̄ −= F⁻ᵀ P̄ᵀ P,  f̄_p += Σ N_i f̄_i                              (Q2.adj)
    with viscosity, L = Ḟ F⁻¹:  Ḟ̄ = L̄ F⁻ᵀ,  F̄ −= Lᵀ L̄ F⁻ᵀ
    ū_i += F̄ g_i,  v̄_i += Ḟ̄ g_i                                                                      (Q1.adj)

A thread adds up one cell and writes the sums of its nodes; nodes.py adds those of the cells around a node. There are no atomic
additions, so results are the same bits in every run.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.rest import lagrangian_module, rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.rest_step import rest_step
from softmpm.kernels.physics.stress import total_stress, total_stress_adj
from softmpm.kernels.physics.viscosity import viscosity
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def cells(spec: Spec) -> SimpleNamespace:
    t, r, k = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype)
    real, vec, mat, Constants, Rest, dim = t.real, t.vec, t.mat, t.Constants, r.Rest, spec.dim
    ParticleInputs, total, sums = input_types(spec).ParticleInputs, total_stress(spec), r.sums
    rotation, stress, identity, volume_change = total.rotation, total.stress, k.identity, k.volume_change
    viscous_stress, report = (
        viscosity(dim, spec.dtype).viscous_stress,
        status.report(dim, spec.dtype).report,
    )
    weights, weight, offset, slope = r.weights, r.weight, r.offset, r.slope
    viscous, forced, largest = spec.viscosity, "force" in spec.given, 1.0e12
    collapsed, not_finite, too_long = int(Kind.COLLAPSED), int(Kind.NOT_FINITE), int(Kind.STEP)
    step_is_stable = rest_step(spec).step_is_stable
    module = lagrangian_module(spec.module + ".lagrangian")
    table = wp.types.matrix((3, dim), real)

    @wp.func
    def gradient(
        nodal: wp.array2d(dtype=vec), world: int, inside: Rest, c: int, w: table, fx: vec, rate: real
    ) -> mat:
        """Σ a_i ⊗ g_i of a nodal field."""
        total = mat()
        for n in range(r.count):
            total += wp.outer(nodal[world, inside.cell_nodes[c, n]], slope(w, n, fx, rate))
        return total

    @wp.func
    def piola(inputs: ParticleInputs, world: int, p: int, H: mat, Q: mat, L: mat, inverse: mat) -> mat:
        """P of (Q2) [Pa]."""
        tau = stress(inputs, world, p, H, Q)
        if wp.static(viscous):
            tau += viscous_stress(identity() + H, L, inputs.viscosity[world, p])
        return tau * wp.transpose(inverse)

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
        p: int,
        substep: int,
        H: mat,
    ):
        """Report a particle for which Δt is too long in the substep that begins with this H."""
        if wp.isfinite(constants.step):  # else the alarm is off
            if not step_is_stable(constants, inputs, world, p, H):
                report(words, world, substep, too_long, p)

    @wp.kernel(module=module, enable_backward=False)
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
        partial: wp.array3d(dtype=vec),
    ):
        world, c = wp.tid()
        total = sums()
        for at in range(inside.first[c], inside.first[c + 1]):
            p = inside.particles[at]
            fx = inside.fraction[at]
            w = weights(fx)
            H = gradient(u, world, inside, c, w, fx, constants.rate)  # (Q1)
            if substep > 0:
                check(constants, words, world, p, substep - 1, H)
            check_step(constants, inputs, words, world, p, substep, H)
            inverse = wp.inverse(identity() + H)
            L = mat()
            if wp.static(viscous):
                L = gradient(v, world, inside, c, w, fx, constants.rate) * inverse
            P = piola(inputs, world, p, H, rotation(inputs, world, p, H), L, inverse)
            A = inputs.volume[world, p] * P
            for n in range(r.count):  # (Q2)
                f = A * slope(w, n, fx, constants.rate)
                for axis in range(dim):
                    total[n, axis] = total[n, axis] - f[axis]
                if wp.static(forced):
                    share = weight(w, offset(n)) * inputs.force[world, p]
                    for axis in range(dim):
                        total[n, axis] = total[n, axis] + share[axis]
        for n in range(r.count):
            f = vec()
            for axis in range(dim):
                f[axis] = total[n, axis]
            partial[world, c, n] = f

    @wp.kernel(module=module, enable_backward=False)
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
        world, c = wp.tid()
        for at in range(inside.first[c], inside.first[c + 1]):
            fx = inside.fraction[at]
            H = gradient(u, world, inside, c, weights(fx), fx, constants.rate)
            check(constants, words, world, inside.particles[at], substep, H)

    @wp.kernel(module=module, enable_backward=False)
    def check_start(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        # In:
        u: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check the initial state of a call."""
        world, c = wp.tid()
        for at in range(inside.first[c], inside.first[c + 1]):
            p = inside.particles[at]
            fx = inside.fraction[at]
            H = gradient(u, world, inside, c, weights(fx), fx, constants.rate)
            check(constants, words, world, p, 0, H)
            check_step(constants, inputs, words, world, p, 0, H)

    return SimpleNamespace(
        forces=forces, check_end=check_end, check_start=check_start, gradient=gradient, piola=piola
    )


@kernel_factory
def cells_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, r, k = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype)
    vec, mat, Constants, Rest, dim = t.vec, t.mat, t.Constants, r.Rest, spec.dim
    ParticleInputs, total, sums = input_types(spec).ParticleInputs, total_stress(spec), r.sums
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    rotation, identity, stress_adj = total.rotation, k.identity, total_stress_adj(spec, wanted).stress_adj
    viscous_stress_adj, one = viscosity(dim, spec.dtype).viscous_stress_adj, cells(spec)
    gradient, piola = one.gradient, one.piola
    weights, weight, offset, slope = r.weights, r.weight, r.offset, r.slope
    viscous, forced = spec.viscosity, "force" in wanted
    report, bad_gradient = status.report(dim, spec.dtype).report, int(Kind.GRADIENT)
    module = lagrangian_module(adj_module(spec, wanted) + ".lagrangian")

    @wp.kernel(module=module, enable_backward=False)
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
        partial_u: wp.array3d(dtype=vec),
        partial_v: wp.array3d(dtype=vec),
    ):
        world, c = wp.tid()
        total_u = sums()
        total_v = sums()
        for at in range(inside.first[c], inside.first[c + 1]):
            p = inside.particles[at]
            fx = inside.fraction[at]
            w = weights(fx)
            H = gradient(u, world, inside, c, w, fx, constants.rate)
            inverse = wp.inverse(identity() + H)
            Q = rotation(inputs, world, p, H)
            L = mat()
            if wp.static(viscous):
                L = gradient(v, world, inside, c, w, fx, constants.rate) * inverse
            P = piola(inputs, world, p, H, Q, L, inverse)
            adj_P = -inputs.volume[world, p] * gradient(
                adj_f, world, inside, c, w, fx, constants.rate
            )  # (Q2.adj)
            adj_tau = adj_P * inverse
            adj_F = stress_adj(inputs, world, p, H, Q, adj_tau, adj_inputs)
            adj_F -= wp.transpose(inverse) * wp.transpose(adj_P) * P
            adj_rate = mat()
            if wp.static(viscous):
                adj_viscous = viscous_stress_adj(identity() + H, L, inputs.viscosity[world, p], adj_tau)
                adj_rate = adj_viscous.C * wp.transpose(inverse)
                adj_F += adj_viscous.F - wp.transpose(L) * adj_rate
                if wp.static("viscosity" in wanted):
                    adj_inputs.viscosity[world, p] = adj_inputs.viscosity[world, p] + adj_viscous.eta
            if not wp.isfinite(wp.ddot(adj_F, adj_F) + wp.ddot(adj_rate, adj_rate)):
                report(words, world, substep, bad_gradient, p)
            for n in range(r.count):
                g = slope(w, n, fx, constants.rate)
                share = adj_F * g  # (Q1.adj)
                for axis in range(dim):
                    total_u[n, axis] = total_u[n, axis] + share[axis]
                if wp.static(viscous):
                    rate = adj_rate * g
                    for axis in range(dim):
                        total_v[n, axis] = total_v[n, axis] + rate[axis]
                if wp.static(forced):
                    adj_inputs.force[world, p] = (
                        adj_inputs.force[world, p]
                        + weight(w, offset(n)) * adj_f[world, inside.cell_nodes[c, n]]
                    )
        for n in range(r.count):
            share = vec()
            rate = vec()
            for axis in range(dim):
                share[axis] = total_u[n, axis]
                rate[axis] = total_v[n, axis]
            partial_u[world, c, n] = share
            if wp.static(viscous):
                partial_v[world, c, n] = rate

    return SimpleNamespace(forces_adj=forces_adj)
