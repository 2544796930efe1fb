"""Neo-Hookean solid, and its adjoint. Source: Hu et al. 2019 ("ChainQueen").

τ = μ (H + Hᵀ + H Hᵀ) + λ log(1 + j) I                                                          (E1)
F̄ = μ (τ̄ + τ̄ᵀ) F + λ tr(τ̄) cof(F) / J,  μ̄ = ⟨τ̄, H + Hᵀ + H Hᵀ⟩,  λ̄ = tr(τ̄) log(1 + j)
P = μ (F − C/J) + λ log(1 + j) C/J,  C = cof F                                                  (E1.P)
F̄ = μ (P̄ − X) + (f' + μ) X + f'' ⟨P̄, C⟩ C,  X = P̄ × F,  μ̄ = ⟨P̄, F − C/J⟩,  λ̄ = ⟨P̄, C⟩ log(1 + j)/J
K ≤ 2μ s² + d max(λ, 0)                              with the largest principal stretch s, in d dimensions
σ = μ,  f' = (λ log J − μ)/J,  f'' ≤ (μ + max(λ (1 − log J), 0))/J²                                  in (Q8)
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.laws import law_adj_type, no_rotation
from softmpm.kernels.physics.tangent import moduli_type
from softmpm.kernels.structs import types


@kernel_factory
def law(dim: int, dtype: str) -> SimpleNamespace:
    t, k, LawAdj = types(dim, dtype), kinematics(dim, dtype), law_adj_type(dim, dtype)
    Moduli = moduli_type(dtype)
    real, mat, divide = t.real, t.mat, t.divide
    identity, cofactor, volume_change, log1p = k.identity, k.cofactor, k.volume_change, k.log1p
    shifted, cofactor_change, cofactor_adj = k.shifted, k.cofactor_change, k.cofactor_adj

    @wp.func
    def stress(H: mat, Q: mat, mu: real, lam: real) -> mat:
        return mu * (H + wp.transpose(H) + H * wp.transpose(H)) + lam * log1p(volume_change(H)) * identity()

    @wp.func
    def stress_adj(H: mat, Q: mat, mu: real, lam: real, adj_tau: mat) -> LawAdj:
        F = identity() + H
        j = volume_change(H)
        trace = wp.trace(adj_tau)
        adj = LawAdj()
        adj.F = mu * (adj_tau + wp.transpose(adj_tau)) * F + divide(lam * trace, real(1.0) + j) * cofactor(F)
        adj.mu = wp.ddot(adj_tau, H + wp.transpose(H) + H * wp.transpose(H))
        adj.lam = trace * log1p(j)
        return adj

    @wp.func
    def piola_adj(H: mat, Q: mat, mu: real, lam: real, adj_P: mat) -> LawAdj:
        j = volume_change(H)
        D = cofactor_change(H)
        C = shifted(D, real(1.0))
        inverse = divide(real(1.0), real(1.0) + j)
        logarithm = log1p(j)
        pressure = lam * logarithm
        X = cofactor_adj(H, adj_P)
        along = wp.ddot(adj_P, C) * inverse
        curved = along * (mu + lam - pressure) * inverse  # f'' ⟨P̄, C⟩
        adj = LawAdj()
        adj.F = mu * (adj_P - X) + ((mu * j + pressure) * inverse) * X + curved * C
        adj.mu = wp.ddot(adj_P, H - D) + along * j  # F − C/J = H − D + C j/J
        adj.lam = along * logarithm
        return adj

    @wp.func
    def bound(square: real, j: real, trace: real, mu: real, lam: real) -> real:
        return real(2.0) * mu * square + real(dim) * wp.max(lam, real(0.0))

    @wp.func
    def moduli(j: real, trace: real, mu: real, lam: real) -> Moduli:
        inverse = divide(real(1.0), real(1.0) + j)
        pressure = lam * log1p(j)
        m = Moduli()
        m.shear = mu
        m.slope = (pressure - mu) * inverse
        m.curvature = (mu + wp.max(lam - pressure, real(0.0))) * inverse * inverse
        return m

    return SimpleNamespace(
        rotation=no_rotation(dim, dtype),
        stress=stress,
        stress_adj=stress_adj,
        piola_adj=piola_adj,
        bound=bound,
        moduli=moduli,
    )
