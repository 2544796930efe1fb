"""Corotated laws: the common part of those that differ in their pressure only. Derivation: docs/math/elasticity.md.

    τ = 2μ S + λ p(j) I,   S = (H − Q) Fᵀ = U + U Hᵀ,   U = H − Q
    F̄ = 2μ T (2F − R) + λ p' tr(τ̄) cof(F) + adjoint of R for R̄ = −2μ T F,   T = (τ̄ + τ̄ᵀ) / 2
    μ̄ = 2 ⟨T F, F − R⟩,   λ̄ = tr(τ̄) p(j)
    P = 2μ (H − Q) + f' C,   C = cof F                                                        (E2.P)
    F̄ = f' (P̄ × F) + f'' ⟨P̄, C⟩ C + adjoint of F − R for 2μ P̄
    μ̄ = 2 ⟨P̄, H − Q⟩,   λ̄ = ⟨P̄, C⟩ p/J
    K ≤ 2μ max(2s² − s, 0) + d max(λ J p', 0)            with the largest principal stretch s, in d dimensions
    σ = 2μ,  f' = λ p/J,  f'' = λ (p/J)'                                                              in (Q8)

Forward and adjoint of a particle share Q. S is symmetric but for rounding, which would turn a free body: the half below the diagonal
stands for both. Source: Stomakhin et al. 2012, "Energetically consistent invertible elasticity".
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.laws import law_adj_type
from softmpm.kernels.physics.polar import polar
from softmpm.kernels.physics.tangent import moduli_type
from softmpm.kernels.structs import types


def corotated(
    dim: int, dtype: str, pressure: wp.Function, pressure_slope: wp.Function, energy_slopes: wp.Function
) -> SimpleNamespace:
    """Functions of the law with the pressure λ p(j), from p, p' = ∂p/∂J and the pair of p/J and its derivative."""
    t, k, LawAdj = types(dim, dtype), kinematics(dim, dtype), law_adj_type(dim, dtype)
    Moduli = moduli_type(dtype)
    real, mat = t.real, t.mat
    identity, cofactor, volume_change = k.identity, k.cofactor, k.volume_change
    shifted, cofactor_change, cofactor_adj = k.shifted, k.cofactor_change, k.cofactor_adj
    turning = polar(dim, dtype)
    rotation, rotation_adj, strain_adj = turning.rotation, turning.rotation_adj, turning.strain_adj

    @wp.func
    def stress(H: mat, Q: mat, mu: real, lam: real) -> mat:
        U = H - Q
        S = U + U * wp.transpose(H)
        for i in range(dim):
            for k in range(i):
                S[k, i] = S[i, k]
        return real(2.0) * mu * S + lam * pressure(volume_change(H)) * identity()

    @wp.func
    def stress_adj(H: mat, Q: mat, mu: real, lam: real, adj_tau: mat) -> LawAdj:
        F = identity() + H
        j = volume_change(H)
        trace = wp.trace(adj_tau)
        T = real(0.5) * (adj_tau + wp.transpose(adj_tau))
        TF = T * F
        two_mu = real(2.0) * mu
        adj = LawAdj()
        adj.F = two_mu * (TF + T * (H - Q)) + (lam * pressure_slope(j) * trace) * cofactor(F)
        adj.F += rotation_adj(H, Q, -two_mu * TF)
        adj.mu = real(2.0) * wp.ddot(TF, H - Q)
        adj.lam = trace * pressure(j)
        return adj

    @wp.func
    def piola_adj(H: mat, Q: mat, mu: real, lam: real, adj_P: mat) -> LawAdj:
        C = shifted(cofactor_change(H), real(1.0))
        slopes = energy_slopes(volume_change(H))
        along = wp.ddot(adj_P, C)
        adj = LawAdj()
        adj.F = (real(2.0) * mu) * strain_adj(H, Q, adj_P) + lam * (
            slopes[0] * cofactor_adj(H, adj_P) + (slopes[1] * along) * C
        )
        adj.mu = real(2.0) * wp.ddot(adj_P, H - Q)
        adj.lam = along * slopes[0]
        return adj

    @wp.func
    def bound(square: real, j: real, trace: real, mu: real, lam: real) -> real:
        shape = wp.max(real(2.0) * square - wp.sqrt(square), real(0.0))
        volume = wp.max(lam * (real(1.0) + j) * pressure_slope(j), real(0.0))
        return real(2.0) * mu * shape + real(dim) * volume

    @wp.func
    def moduli(j: real, trace: real, mu: real, lam: real) -> Moduli:
        slopes = energy_slopes(j)
        m = Moduli()
        m.shear = real(2.0) * mu
        m.slope = lam * slopes[0]
        m.curvature = wp.max(lam * slopes[1], real(0.0))
        return m

    return SimpleNamespace(
        rotation=rotation,
        stress=stress,
        stress_adj=stress_adj,
        piola_adj=piola_adj,
        bound=bound,
        moduli=moduli,
    )
