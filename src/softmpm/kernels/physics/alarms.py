"""Alarms between substeps: numerical fracture and the running step limit. Derivation: docs/math/alarms.md.

    gap    |x_q − x_p| ≤ g dx                   for rest neighbours p, q                                        (W1)
    step   Δt ≤ s dx √(ρ₀ / K)                  with the stiffness K of the present F, material and pull        (W2)
    K = max ⟨G, A[G]⟩ / ⟨G, G⟩  over symmetric G,  A[G] = d/dε τ((I + εG) F)                                     (W3)

A is symmetric, so A[G] = sym(F̄ Fᵀ) with the adjoint F̄ of the stress for τ̄ = G: no law needs a block of its own. Lanczos'
iteration makes A tridiagonal, T, and T − κ I has a positive pivot in its elimination exactly if an eigenvalue of T is above κ. Both
alarms stand at the start of a call and at the end of a chunk, where their price is shared by all its substeps; det F is checked in
every substep (status.py).
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.stress import material, total_stress, total_stress_adj
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types

STEPS = {2: 3, 3: 5}
"""Of Lanczos' iteration. In 2D there are three symmetric G, in 3D six, the last of which no longer moves K by 1 %."""


@kernel_factory
def alarm(spec: Spec) -> SimpleNamespace:
    """Blocks of one particle: is its step stable, and is a neighbour too far away."""
    t, wanted = types(spec.dim, spec.dtype), RequestedGrads()
    real, vec, mat, ivec, Constants = t.real, t.vec, t.mat, t.ivec, t.Constants
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    total, stress_adj = total_stress(spec), total_stress_adj(spec, wanted).stress_adj
    rotation, stiffness_bound, largest_square = total.rotation, total.stiffness_bound, total.largest_square
    identity, dim, steps = kinematics(spec.dim, spec.dtype).identity, spec.dim, STEPS[spec.dim]
    viscous, Material, material_of = spec.viscosity, material(spec).Material, material(spec).material_of

    @wp.func
    def viscous_rate(constants: Constants, inputs: ParticleInputs, world: int, p: int) -> real:
        """4 η s / Δt [Pa], by which B G B counts as stiffness (W4)."""
        if wp.static(viscous):
            return real(4.0) * inputs.viscosity[world, p] * wp.sqrt(constants.step) / constants.dt
        return real(0.0)

    @wp.func
    def stiffer(own: Material, H: mat, limit: real, rate: real) -> bool:
        """True if K > ``limit`` [Pa] (W3), viscosity included; false if K is not a number, which another alarm reports."""
        F = identity() + H
        Q = rotation(own, H)
        G = F * wp.transpose(F)
        G = G / wp.sqrt(wp.ddot(G, G))
        for i in range(dim):
            for j in range(dim):  # a part in every direction
                G[i, j] += (
                    real(0.3)
                    * wp.where(i == 0, real(1.0), real(-0.4))
                    * wp.where(j == 0, real(1.0), real(-0.4))
                )
        G = G / wp.sqrt(wp.ddot(G, G))
        before = mat()
        beta = real(0.0)
        pivot = real(1.0)
        step = int(0)
        while step < steps:  # which Warp does not unroll: the adjoint of the stress is compiled once
            step += 1
            A = stress_adj(own, H, Q, G, 0, 0, ParticleInputsAdj()) * wp.transpose(F)
            A = real(0.5) * (A + wp.transpose(A))
            if wp.static(viscous):
                B = F * wp.transpose(F)
                A += rate * (B * G * B)
            alpha = wp.ddot(G, A)
            pivot = alpha - limit - beta * beta / pivot
            if pivot > real(0.0):
                return wp.isfinite(pivot)
            A = A - alpha * G - beta * before
            beta = wp.sqrt(wp.ddot(A, A))
            before = G
            G = A / beta
        return False

    @wp.func
    def step_is_stable(constants: Constants, inputs: ParticleInputs, world: int, p: int, H: mat) -> bool:
        """(W2), as K ≤ s² ρ₀ dx² / Δt²."""
        reach = constants.spacing / constants.dt
        limit = constants.step * inputs.mass[world, p] / inputs.volume[world, p] * reach * reach
        rate = viscous_rate(constants, inputs, world, p)
        own = material_of(inputs, world, p)
        bound = stiffness_bound(own, H)
        if wp.static(viscous):
            F = identity() + H
            square = largest_square(F * wp.transpose(F))
            bound += rate * square * square
        # Nearly all particles of a scene at half its stable step need no more than this:
        if not bound > limit:
            return True
        return not stiffer(own, H, limit, rate)

    @wp.func
    def near(constants: Constants, cells: ivec, apart: vec) -> bool:
        """(W1) for two particles ``cells + apart`` from each other, in cells."""
        d = apart
        for axis in range(dim):
            d[axis] = apart[axis] + real(cells[axis])
        return not (wp.dot(d, d) > constants.gap)

    return SimpleNamespace(step_is_stable=step_is_stable, near=near, viscous_rate=viscous_rate)
