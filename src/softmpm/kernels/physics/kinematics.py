"""Deformation of one particle: F = I + H, its cofactor and its change of volume. Derivation: docs/math/elasticity.md.

Everything is written in H = F − I, so that small strains keep their digits in float32.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


@kernel_factory
def kinematics(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, mat, divide = t.real, t.vec, t.mat, t.divide

    @wp.func
    def identity() -> mat:
        return wp.identity(n=dim, dtype=real)

    @wp.func
    def shifted(M: mat, t: real) -> mat:
        """M + t I."""
        out = M
        for i in range(dim):
            out[i, i] = out[i, i] + t
        return out

    if dim == 2:

        @wp.func
        def cofactor(F: mat) -> mat:
            return mat(F[1, 1], -F[1, 0], -F[0, 1], F[0, 0])

        @wp.func
        def volume_change(H: mat) -> real:
            """j = det(I + H) − 1."""
            return H[0, 0] + H[1, 1] + (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])

        @wp.func
        def cofactor_change(H: mat) -> mat:
            """cof F − I."""
            return cofactor(H)

        @wp.func
        def cofactor_adj(H: mat, adj_C: mat) -> mat:
            """Adjoint of F of cof F, which is linear in F."""
            return cofactor(adj_C)
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
        def cofactor_change(H: mat) -> mat:
            """cof F − I = tr(H) I − Hᵀ + cof H."""
            return shifted(cofactor(H) - wp.transpose(H), wp.trace(H))

        @wp.func
        def cofactor_adj(H: mat, adj_C: mat) -> mat:
            """Adjoint of cof F, C̄ × F, whose part C̄ × I is tr(C̄) I − C̄ᵀ. Its rows are vector products."""
            a = vec(H[0, 0], H[0, 1], H[0, 2])
            b = vec(H[1, 0], H[1, 1], H[1, 2])
            c = vec(H[2, 0], H[2, 1], H[2, 2])
            adj_a = vec(adj_C[0, 0], adj_C[0, 1], adj_C[0, 2])
            adj_b = vec(adj_C[1, 0], adj_C[1, 1], adj_C[1, 2])
            adj_c = vec(adj_C[2, 0], adj_C[2, 1], adj_C[2, 2])
            x = wp.cross(b, adj_c) + wp.cross(adj_b, c)
            y = wp.cross(c, adj_a) + wp.cross(adj_c, a)
            z = wp.cross(a, adj_b) + wp.cross(adj_a, b)
            own = mat(x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])
            return shifted(own - wp.transpose(adj_C), wp.trace(adj_C))

    @wp.func
    def inverse_transpose(H: mat) -> mat:
        """F⁻ᵀ."""
        return (real(1.0) / (real(1.0) + volume_change(H))) * shifted(cofactor_change(H), real(1.0))

    @wp.func
    def log1p(j: real) -> real:
        """log(1 + j) to the last digit also for small j (Kahan)."""
        u = real(1.0) + j
        return wp.where(u == real(1.0), j, wp.log(u) * divide(j, u - real(1.0)))

    return SimpleNamespace(
        identity=identity,
        shifted=shifted,
        cofactor=cofactor,
        cofactor_change=cofactor_change,
        cofactor_adj=cofactor_adj,
        volume_change=volume_change,
        inverse_transpose=inverse_transpose,
        log1p=log1p,
    )
