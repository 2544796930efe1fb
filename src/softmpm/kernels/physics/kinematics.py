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

    if dim == 2:

        @wp.func
        def cofactor(F: mat) -> mat:
            return mat(F[1, 1], -F[1, 0], -F[0, 1], F[0, 0])

        @wp.func
        def volume_change(H: mat) -> real:
            """j = det(I + H) − 1."""
            return H[0, 0] + H[1, 1] + (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])

        @wp.func
        def inverse_transpose(H: mat) -> mat:
            """F⁻ᵀ."""
            scale = real(1.0) / (real(1.0) + volume_change(H))
            return scale * (cofactor(H) + identity())
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
        def inverse_transpose(H: mat) -> mat:
            """F⁻ᵀ, with cof F = (1 + tr H) I − Hᵀ + cof H."""
            scale = real(1.0) / (real(1.0) + volume_change(H))
            C = cofactor(H) - wp.transpose(H)
            t = real(1.0) + wp.trace(H)
            for i in range(3):
                C[i, i] = C[i, i] + t
            return scale * C

    @wp.func
    def log1p(j: real) -> real:
        """log(1 + j) to the last digit also for small j (Kahan)."""
        u = real(1.0) + j
        return wp.where(u == real(1.0), j, wp.log(u) * divide(j, u - real(1.0)))

    return SimpleNamespace(
        identity=identity,
        cofactor=cofactor,
        volume_change=volume_change,
        inverse_transpose=inverse_transpose,
        log1p=log1p,
    )
