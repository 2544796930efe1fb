"""Kirchhoff stress τ of a deformation, one block per law, with its adjoint. Derivation: docs/math/elasticity.md.

Everything is written in H = F − I, so that small strains keep their digits in float32. With j = J − 1, R = I + Q:

    neo-Hookean:        τ = μ (H + Hᵀ + H Hᵀ) + λ log(1 + j) I                                      (E1)
    fixed corotated:    τ = 2μ S + λ j (1 + j) I,  S = (H − Q) Fᵀ = U + U Hᵀ,  U = H − Q            (E2)
    barrier corotated:  τ = 2μ S + λ/4 (J² − J⁻²) I                                                 (E3)

All take Q, which ``rotation`` of the law gives; a neo-Hookean solid needs none. Forward and adjoint of a particle share it. S is
symmetric but for rounding, which would turn a free body: the half below the diagonal stands for both.
Sources: Hu et al. 2019 ("ChainQueen"), Stomakhin et al. 2012; the volumetric term of (E3) is the derivative of λ/8 (J − 1/J)².
The adjoints take τ̄ and return (F̄, μ̄, λ̄):

    (E1): F̄ = μ (τ̄ + τ̄ᵀ) F + λ tr(τ̄) cof(F) / J,  μ̄ = ⟨τ̄, H + Hᵀ + H Hᵀ⟩,  λ̄ = tr(τ̄) log(1 + j)
    (E2): F̄ = 2μ T (2F − R) + λ (2J − 1) tr(τ̄) cof(F) + adjoint of R for R̄ = −2μ T F,  T = (τ̄ + τ̄ᵀ) / 2,
          μ̄ = 2 ⟨T F, F − R⟩,  λ̄ = tr(τ̄) j (1 + j)
    (E3): as (E2), with λ/2 (J + J⁻³) for λ (2J − 1) and λ̄ = tr(τ̄) (J² − J⁻²) / 4

``bound`` of a law is at least the stiffness K of (W3), from the square s² of the largest principal stretch or more, and J:

    (E1): K ≤ 2μ s² + d max(λ, 0),    (E2), (E3): K ≤ 2μ max(2s² − s, 0) + d max(λ J p', 0)          (E4)

in d dimensions, with the slope p' = dp/dJ of the law's pressure λ p. At rest they are K itself.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.polar import polar
from softmpm.kernels.structs import types


@kernel_factory
def elasticity(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, mat = t.real, t.vec, t.mat
    rotation, rotation_adj = polar(dim, dtype).rotation, polar(dim, dtype).rotation_adj
    divide = types(dim, dtype).divide

    @wp.struct
    class ElasticAdj:
        F: mat
        mu: real
        lam: real

    @wp.func
    def identity() -> mat:
        return wp.identity(n=dim, dtype=real)

    if dim == 2:

        @wp.func
        def cofactor(F: mat) -> mat:
            return mat(F[1, 1], -F[1, 0], -F[0, 1], F[0, 0])

        @wp.func
        def volume_change(H: mat) -> real:
            """j = det(I + H) − 1."""
            return H[0, 0] + H[1, 1] + (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])
    else:

        @wp.func
        def cofactor(F: mat) -> mat:
            a = vec(F[0, 0], F[0, 1], F[0, 2])
            b = vec(F[1, 0], F[1, 1], F[1, 2])
            c = vec(F[2, 0], F[2, 1], F[2, 2])
            bc = wp.cross(b, c)
            ca = wp.cross(c, a)
            ab = wp.cross(a, b)
            return mat(bc[0], bc[1], bc[2], ca[0], ca[1], ca[2], ab[0], ab[1], ab[2])

        @wp.func
        def volume_change(H: mat) -> real:
            G = cofactor(H)
            return wp.trace(H) + wp.trace(G) + (H[0, 0] * G[0, 0] + H[0, 1] * G[0, 1] + H[0, 2] * G[0, 2])

    @wp.func
    def log1p(j: real) -> real:
        """log(1 + j) to the last digit also for small j (Kahan)."""
        u = real(1.0) + j
        return wp.where(u == real(1.0), j, wp.log(u) * divide(j, u - real(1.0)))

    @wp.func
    def no_rotation(H: mat) -> mat:
        return mat()

    @wp.func
    def neo_hookean(H: mat, Q: mat, mu: real, lam: real) -> mat:
        return mu * (H + wp.transpose(H) + H * wp.transpose(H)) + lam * log1p(volume_change(H)) * identity()

    @wp.func
    def neo_hookean_adj(H: mat, Q: mat, mu: real, lam: real, adj_tau: mat) -> ElasticAdj:
        F = identity() + H
        j = volume_change(H)
        trace = wp.trace(adj_tau)
        adj = ElasticAdj()
        adj.F = mu * (adj_tau + wp.transpose(adj_tau)) * F + divide(lam * trace, real(1.0) + j) * cofactor(F)
        adj.mu = wp.ddot(adj_tau, H + wp.transpose(H) + H * wp.transpose(H))
        adj.lam = trace * log1p(j)
        return adj

    @wp.func
    def neo_hookean_bound(square: real, j: real, mu: real, lam: real) -> real:
        return real(2.0) * mu * square + real(dim) * wp.max(lam, real(0.0))

    def corotated(pressure: wp.Function, pressure_slope: wp.Function) -> tuple[wp.Function, ...]:
        """Stress, adjoint and bound of a corotated law, τ = 2μ S + λ p(j) I, from p and ∂p/∂J."""

        @wp.func
        def stress(H: mat, Q: mat, mu: real, lam: real) -> mat:
            U = H - Q
            S = U + U * wp.transpose(H)
            for i in range(dim):
                for k in range(i):
                    S[k, i] = S[i, k]
            return real(2.0) * mu * S + lam * pressure(volume_change(H)) * identity()

        @wp.func
        def stress_adj(H: mat, Q: mat, mu: real, lam: real, adj_tau: mat) -> ElasticAdj:
            F = identity() + H
            j = volume_change(H)
            trace = wp.trace(adj_tau)
            T = real(0.5) * (adj_tau + wp.transpose(adj_tau))
            TF = T * F
            two_mu = real(2.0) * mu
            adj = ElasticAdj()
            adj.F = two_mu * (TF + T * (H - Q)) + (lam * pressure_slope(j) * trace) * cofactor(F)
            adj.F += rotation_adj(H, Q, -two_mu * TF)
            adj.mu = real(2.0) * wp.ddot(TF, H - Q)
            adj.lam = trace * pressure(j)
            return adj

        @wp.func
        def bound(square: real, j: real, mu: real, lam: real) -> real:
            shape = wp.max(real(2.0) * square - wp.sqrt(square), real(0.0))
            volume = wp.max(lam * (real(1.0) + j) * pressure_slope(j), real(0.0))
            return real(2.0) * mu * shape + real(dim) * volume

        return stress, stress_adj, bound

    @wp.func
    def soft_pressure(j: real) -> real:
        return j * (real(1.0) + j)

    @wp.func
    def soft_pressure_slope(j: real) -> real:
        return real(1.0) + real(2.0) * j

    @wp.func
    def barrier_pressure(j: real) -> real:
        """(J² − J⁻²) / 4, without cancellation where j is small."""
        square = (real(1.0) + j) * (real(1.0) + j)
        return divide(real(0.25) * j * (real(2.0) + j) * (square + real(1.0)), square)

    @wp.func
    def barrier_pressure_slope(j: real) -> real:
        J = real(1.0) + j
        return real(0.5) * (J + divide(real(1.0), J * J * J))

    fixed_corotated, fixed_corotated_adj, fixed_bound = corotated(soft_pressure, soft_pressure_slope)
    barrier_corotated, barrier_corotated_adj, barrier_bound = corotated(
        barrier_pressure, barrier_pressure_slope
    )

    return SimpleNamespace(
        Adj=ElasticAdj,
        identity=identity,
        volume_change=volume_change,
        rotation={
            "neo_hookean": no_rotation,
            "fixed_corotated": rotation,
            "barrier_corotated": rotation,
        },
        stress={
            "neo_hookean": neo_hookean,
            "fixed_corotated": fixed_corotated,
            "barrier_corotated": barrier_corotated,
        },
        stress_adj={
            "neo_hookean": neo_hookean_adj,
            "fixed_corotated": fixed_corotated_adj,
            "barrier_corotated": barrier_corotated_adj,
        },
        bound={
            "neo_hookean": neo_hookean_bound,
            "fixed_corotated": fixed_bound,
            "barrier_corotated": barrier_bound,
        },
    )
