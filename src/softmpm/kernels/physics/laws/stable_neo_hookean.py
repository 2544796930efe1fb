"""Stable neo-Hookean solid, and its adjoint. Source: Smith, de Goes, Kim 2018, "Stable Neo-Hookean Flesh Simulation".

    τ = μ (E + k B) + ((λ + ⅚ μ) (1 + j) − μ) j I,   E = B − I,   k = s / (12 + 3 s),   s = tr E          (E5)
    F̄ = 2μ ((1 + k) T + k' ⟨T, B⟩ I) F + p' tr(τ̄) cof(F),   k' = 4 / (3 (4 + s)²),   T = (τ̄ + τ̄ᵀ) / 2
    μ̄ = ⟨T, E + k B⟩ + tr(τ̄) (⅚ (1 + j) − 1) j,   λ̄ = tr(τ̄) (1 + j) j
    P = μ (1 + k) F + f' C,   C = cof F                                                                   (E5.P)
    F̄ = μ (P̄ − X) + μ k P̄ + (f' + μ) X + 2μ k' ⟨P̄, F⟩ F + f'' ⟨P̄, C⟩ C,   X = P̄ × F,   f'' = λ + ⅚ μ
    μ̄ = ⟨P̄, F − C + k F⟩ + ⅚ j ⟨P̄, C⟩,   λ̄ = j ⟨P̄, C⟩
    K ≤ 2μ ((1 + k) s₁² + k' s₁² tr B) + d max(p' J, 0),   p' = (λ + ⅚ μ) (2J − 1) − μ
    σ = μ (1 + k),  κ = 2μ k',  f' = (λ + ⅚ μ) j − μ,  f'' ≤ max(λ, 0) + ⅚ μ                             in (Q8)

with B = F Fᵀ, the largest principal stretch s₁ and d dimensions; μ and λ are those of linear elasticity at rest.
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
    identity, cofactor, volume_change = k.identity, k.cofactor, k.volume_change
    shifted, cofactor_change, cofactor_adj = k.shifted, k.cofactor_change, k.cofactor_adj
    five_sixths, four_thirds = (
        real(5.0 / 6.0),
        real(4.0 / 3.0),
    )  # in a kernel the division would be in float32

    @wp.func
    def softening(s: real) -> real:
        """k of (E5)."""
        return divide(s, real(12.0) + real(3.0) * s)

    @wp.func
    def softening_slope(s: real) -> real:
        return divide(four_thirds, (real(4.0) + s) * (real(4.0) + s))

    @wp.func
    def bulk(mu: real, lam: real) -> real:
        """λ of the paper."""
        return lam + five_sixths * mu

    @wp.func
    def pressure_slope(j: real, mu: real, lam: real) -> real:
        return bulk(mu, lam) * (real(1.0) + real(2.0) * j) - mu

    @wp.func
    def green(H: mat) -> mat:
        """E = F Fᵀ − I."""
        return H + wp.transpose(H) + H * wp.transpose(H)

    @wp.func
    def stress(H: mat, Q: mat, mu: real, lam: real) -> mat:
        E = green(H)
        k = softening(wp.trace(E))
        j = volume_change(H)
        pressure = (bulk(mu, lam) * (real(1.0) + j) - mu) * j
        return mu * ((real(1.0) + k) * E) + (mu * k + pressure) * identity()  # (E5)

    @wp.func
    def stress_adj(H: mat, Q: mat, mu: real, lam: real, adj_tau: mat) -> LawAdj:
        F = identity() + H
        E = green(H)
        s = wp.trace(E)
        k = softening(s)
        j = volume_change(H)
        trace = wp.trace(adj_tau)
        T = real(0.5) * (adj_tau + wp.transpose(adj_tau))
        TE = wp.ddot(T, E)
        adj = LawAdj()
        adj.F = real(2.0) * mu * ((real(1.0) + k) * (T * F) + (softening_slope(s) * (TE + trace)) * F)
        adj.F += (pressure_slope(j, mu, lam) * trace) * cofactor(F)
        volume = trace * j
        adj.mu = (real(1.0) + k) * TE + k * trace + volume * (five_sixths * (real(1.0) + j) - real(1.0))
        adj.lam = volume * (real(1.0) + j)
        return adj

    @wp.func
    def piola_adj(H: mat, Q: mat, mu: real, lam: real, adj_P: mat) -> LawAdj:
        F = shifted(H, real(1.0))
        D = cofactor_change(H)
        C = shifted(D, real(1.0))
        s = real(2.0) * wp.trace(H) + wp.ddot(H, H)
        k = softening(s)
        j = volume_change(H)
        X = cofactor_adj(H, adj_P)
        stretched = wp.ddot(adj_P, F)
        along = wp.ddot(adj_P, C)
        adj = LawAdj()
        adj.F = mu * (adj_P - X) + (mu * k) * adj_P + (real(2.0) * mu * softening_slope(s) * stretched) * F
        adj.F += bulk(mu, lam) * (j * X + along * C)
        volume = along * j
        adj.mu = wp.ddot(adj_P, H - D) + k * stretched + five_sixths * volume
        adj.lam = volume
        return adj

    @wp.func
    def bound(square: real, j: real, trace: real, mu: real, lam: real) -> real:
        s = trace - real(dim)
        shape = (real(1.0) + softening(s)) * square + softening_slope(s) * square * trace
        volume = wp.max(pressure_slope(j, mu, lam) * (real(1.0) + j), real(0.0))
        return real(2.0) * mu * shape + real(dim) * volume

    @wp.func
    def moduli(j: real, trace: real, mu: real, lam: real) -> Moduli:
        s = trace - real(dim)
        m = Moduli()
        m.shear = mu * (real(1.0) + softening(s))
        m.outer = real(2.0) * mu * softening_slope(s)
        m.slope = bulk(mu, lam) * j - mu
        m.curvature = bulk(mu, wp.max(lam, real(0.0)))
        return m

    return SimpleNamespace(
        rotation=no_rotation(dim, dtype),
        stress=stress,
        stress_adj=stress_adj,
        piola_adj=piola_adj,
        bound=bound,
        moduli=moduli,
    )
