"""Force of one particle on its nodes, and its adjoint. Derivation: docs/math/lagrangian.md.

P = τ F⁻ᵀ of law and actuators, and that of viscosity (E6.P),  the force is −V P g_i              (Q2)
P̄ = −V Σ f̄_i ⊗ g_i,  F̄ by the adjoint of P of law and actuators                                   (Q2.adj)

P is the product of a symmetric τ, whose rounding does not turn a free body; its adjoint needs no τ.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.accumulate import accumulate
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.rest_step import rest_step
from softmpm.kernels.physics.stress import material, total_stress, total_stress_adj
from softmpm.kernels.physics.viscosity import viscosity
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types

CHECKED = wp.constant(8)
"""Substeps from one check of the step limit to the next: an instability takes several substeps to grow. A chunk that failed is run
again substep by substep, with a check at the beginning of each.
"""


@kernel_factory
def particle_forces(spec: Spec) -> SimpleNamespace:
    """Functions of one particle."""
    t, k = types(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype)
    real, mat, Constants, dim = t.real, t.mat, t.Constants, spec.dim
    ParticleInputs, total_of = input_types(spec).ParticleInputs, total_stress(spec)
    rotation, stress, shifted = total_of.rotation, total_of.stress, k.shifted
    volume_change, inverse_transpose = k.volume_change, k.inverse_transpose
    viscous_piola, viscous = viscosity(dim, spec.dtype).viscous_piola, spec.viscosity
    Material, material_ahead = material(spec).Material, material(spec).material_ahead
    report, largest = status.report(dim, spec.dtype).report, 1.0e12
    collapsed, not_finite, too_long = int(Kind.COLLAPSED), int(Kind.NOT_FINITE), int(Kind.STEP)
    step_is_stable, Rest = rest_step(spec).step_is_stable, rest(dim, spec.dtype).Rest

    @wp.struct
    class Given:
        """Inputs of a particle for a control step."""

        material: Material
        viscosity: real  # [Pa s]
        volume: real

    @wp.func
    def given_to(inputs: ParticleInputs, world: int, p: int) -> Given:
        out = Given()
        out.material = material_ahead(inputs, world, p)
        out.volume = inputs.volume[world, p]
        if wp.static(viscous):
            out.viscosity = inputs.viscosity[world, p]
        return out

    @wp.func
    def forced(own: Given, H: mat, rate: mat) -> mat:
        """−V P of a particle; ``rate`` is Ḟ."""
        P = stress(own.material, H, rotation(own.material, H)) * inverse_transpose(H)
        if wp.static(viscous):
            P += viscous_piola(shifted(H, real(1.0)), rate, own.viscosity)
        return -own.volume * P

    @wp.func
    def is_valid(constants: Constants, H: mat) -> bool:
        """True for a particle that ``check`` does not report. A comparison with NaN is false."""
        j = volume_change(H)
        return j > constants.collapse and j < real(largest)

    @wp.func
    def check(
        constants: Constants, words: wp.array(dtype=wp.int64), world: int, p: int, substep: int, H: mat
    ):
        """Report a particle that collapsed or is not finite."""
        if not is_valid(constants, H):
            kind = collapsed
            j = volume_change(H)
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

    @wp.func
    def check_now(
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        words: wp.array(dtype=wp.int64),
        world: int,
        place: int,
        s: int,
        H: mat,
    ):
        """Check a particle with this H at the beginning of substep ``s``, in some substeps with the step limit."""
        check(constants, words, world, inside.order[place], wp.max(s - 1, 0), H)
        if s % CHECKED == 0:
            check_step(constants, inputs, words, world, place, inside.order[place], s, H)

    return SimpleNamespace(
        Given=Given,
        given_to=given_to,
        forced=forced,
        is_valid=is_valid,
        check=check,
        check_step=check_step,
        check_now=check_now,
    )


@kernel_factory
def particle_forces_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    """Adjoint of the functions of one particle."""
    t, k = types(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype)
    real, mat = t.real, t.mat
    shifted, rotation, Given = k.shifted, total_stress(spec).rotation, particle_forces(spec).Given
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    piola_adj, viscous = total_stress_adj(spec, wanted, "piola").stress_adj, spec.viscosity
    viscous_piola_adj = viscosity(spec.dim, spec.dtype).viscous_piola_adj
    to_particle = accumulate(spec.dtype).to_particle
    report, bad_gradient = status.report(spec.dim, spec.dtype).report, int(Kind.GRADIENT)

    @wp.struct
    class ForceAdj:
        F: mat
        rate: mat

    @wp.func
    def forced_adj(
        own: Given,
        H: mat,
        rate: mat,
        G: mat,  # Σ f̄_i ⊗ g_i
        world: int,
        p: int,
        adj_inputs: ParticleInputsAdj,
    ) -> ForceAdj:
        """(Q2.adj)"""
        adj_P = -own.volume * G
        adj = ForceAdj()
        adj.F = piola_adj(own.material, H, rotation(own.material, H), adj_P, world, p, adj_inputs)
        if wp.static(viscous):
            found = viscous_piola_adj(shifted(H, real(1.0)), rate, own.viscosity, adj_P)
            adj.F += found.F
            adj.rate = found.rate
            if wp.static("viscosity" in wanted):
                to_particle(adj_inputs.viscosity, world, p, found.eta)
        return adj

    @wp.func
    def check_adj(words: wp.array(dtype=wp.int64), world: int, p: int, substep: int, adj: ForceAdj):
        """Report a gradient that is not finite."""
        if not wp.isfinite(wp.ddot(adj.F, adj.F) + wp.ddot(adj.rate, adj.rate)):
            report(words, world, substep, bad_gradient, p)

    return SimpleNamespace(forced_adj=forced_adj, check_adj=check_adj)
