"""Kelvin–Voigt viscosity of a particle, and its adjoint. Derivation: docs/math/elasticity.md.

    τ = 2η B D B,   B = F Fᵀ,   D = (C + Cᵀ) / 2                                                    (E6)
    C̄ = 2η B T B,   F̄ = 4η (T B D + D B T) F,   η̄ = 2 ⟨T, B D B⟩,   T = (τ̄ + τ̄ᵀ) / 2               (E6.adj)
    P = τ F⁻ᵀ = η F E',   E' = Fᵀ Ḟ + Ḟᵀ F,   Ḟ = C F                                               (E6.P)
    F̄ = η P̄ E' + Ḟ N,   Ḟ̄ = F N,   η̄ = ⟨P̄, F E'⟩,   N = η (Fᵀ P̄ + P̄ᵀ F)

which is the second Piola–Kirchhoff stress S = 2η Ė: objective, and defined where det F ≤ 0. η is in Pa s.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


@kernel_factory
def viscosity(dim: int, dtype: str) -> SimpleNamespace:
    real, mat = types(dim, dtype).real, types(dim, dtype).mat

    @wp.struct
    class ViscosityAdj:
        F: mat
        C: mat
        eta: real

    @wp.func
    def strain_rate(B: mat, C: mat) -> mat:
        """B D B, symmetric to the last bit: unsymmetric rounding would turn a free body."""
        M = real(0.5) * (B * (C + wp.transpose(C)) * B)
        for i in range(dim):
            for k in range(i):
                M[k, i] = M[i, k]
        return M

    @wp.func
    def viscous_stress(F: mat, C: mat, eta: real) -> mat:
        return (real(2.0) * eta) * strain_rate(F * wp.transpose(F), C)

    @wp.func
    def viscous_stress_adj(F: mat, C: mat, eta: real, adj_tau: mat) -> ViscosityAdj:
        B = F * wp.transpose(F)
        D = real(0.5) * (C + wp.transpose(C))
        T = real(0.5) * (adj_tau + wp.transpose(adj_tau))
        TBD = T * B * D
        adj = ViscosityAdj()
        adj.C = (real(2.0) * eta) * (B * T * B)
        adj.F = (real(4.0) * eta) * ((TBD + wp.transpose(TBD)) * F)
        adj.eta = real(2.0) * wp.ddot(T, B * D * B)
        return adj

    @wp.struct
    class PiolaAdj:
        F: mat
        rate: mat
        eta: real

    @wp.func
    def twice(M: mat) -> mat:
        """M + Mᵀ"""
        return M + wp.transpose(M)

    @wp.func
    def viscous_piola(F: mat, rate: mat, eta: real) -> mat:
        """P from Ḟ."""
        return eta * (F * twice(wp.transpose(F) * rate))

    @wp.func
    def viscous_piola_adj(F: mat, rate: mat, eta: real, adj_P: mat) -> PiolaAdj:
        E = twice(wp.transpose(F) * rate)
        N = eta * twice(wp.transpose(F) * adj_P)
        adj = PiolaAdj()
        adj.F = eta * (adj_P * E) + rate * N
        adj.rate = F * N
        adj.eta = wp.ddot(adj_P, F * E)
        return adj

    return SimpleNamespace(
        viscous_stress=viscous_stress,
        viscous_stress_adj=viscous_stress_adj,
        viscous_piola=viscous_piola,
        viscous_piola_adj=viscous_piola_adj,
    )
