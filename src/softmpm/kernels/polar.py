"""Rotation R of F = R S, smooth where singular values repeat, and its adjoint. Derivation: docs/math/elasticity.md.

R maximises tr(RᵀF) over the proper rotations: the polar rotation if det F > 0, its sign-corrected sibling if det F < 0.
Functions take H = F − I and give Q = R − I, so that a small deformation keeps all its digits.

2D, with a = F₀₀ + F₁₁, b = F₁₀ − F₀₁, r = √(a² + b²):  cos = a/r, sin = b/r                       (R1)
3D: the unit quaternion q of R is the eigenvector of the largest eigenvalue ℓ = tr S of Davenport's K(F),
    ℓ⁴ − 2 |F|² ℓ² − 8 det(F) ℓ + |F|⁴ − 4 |cof F|² = 0,                                           (R2)
    found by inverse iteration, then by Newton steps on the rotations:
    R ← R exp[ω],  (tr(S) I − S) ω = axl(RᵀF)                                                      (R3)
    with axl(M) = (M₂₁ − M₁₂, M₀₂ − M₂₀, M₁₀ − M₀₁).
Adjoint: F̄ += R [y],  (tr(S) I − S) y = axl(RᵀR̄)                                                    (R3.F)

(R3.F) has no singular values in a denominator but their pairwise sums: it is singular only where R itself is not unique.
Source: Davenport's q-method (Markley & Mortari 2000) for (R2); the rest is derived.
"""

import functools
from types import SimpleNamespace

import warp as wp

from softmpm.kernels.types import types

NEWTON_STEPS = {"float32": 2, "float64": 3}  # each doubles the digits of a start that has a few
QUARTIC_STEPS = 40  # an upper bound: at F = I none is taken, elsewhere 3 to 8


@functools.lru_cache(maxsize=None)
def polar(dim: int, dtype: str) -> SimpleNamespace:
    return _polar2(dtype) if dim == 2 else _polar3(dtype)


def _polar2(dtype: str) -> SimpleNamespace:
    t = types(2, dtype)
    real, mat = t.real, t.mat

    @wp.func
    def rotation(H: mat) -> mat:
        a = real(2.0) + H[0, 0] + H[1, 1]
        b = H[1, 0] - H[0, 1]
        r = wp.sqrt(a * a + b * b)
        if r == real(0.0):
            return mat()  # every rotation is a maximiser
        s = b / r
        c = (a - r) / r  # cos - 1
        if a > real(0.0):
            c = -b * s / (r + a)  # the same without cancellation
        return mat(c, -s, s, c)

    @wp.func
    def rotation_adj(H: mat, Q: mat, adj_R: mat) -> mat:
        """∂L/∂F (R1): with dθ = (cos db − sin da) / r."""
        a = real(2.0) + H[0, 0] + H[1, 1]
        b = H[1, 0] - H[0, 1]
        r = wp.sqrt(a * a + b * b)
        c = real(1.0) + Q[0, 0]
        s = Q[1, 0]
        angle = -s * (adj_R[0, 0] + adj_R[1, 1]) + c * (adj_R[1, 0] - adj_R[0, 1])
        return (angle / r) * mat(-s, -c, c, -s)

    return SimpleNamespace(rotation=rotation, rotation_adj=rotation_adj)


def _polar3(dtype: str) -> SimpleNamespace:
    t = types(3, dtype)
    real, vec, mat = t.real, t.vec, t.mat
    quat = wp.types.vector(4, real)  # (w, x, y, z), unit
    mat4 = wp.types.matrix((4, 4), real)
    steps = NEWTON_STEPS[dtype]
    close = 1e-3 if dtype == "float32" else 1e-6  # the eigenvalue need not be better: (R3) finishes

    @wp.func
    def axl(M: mat) -> vec:
        return vec(M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1])

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
    def largest_eigenvalue(F: mat) -> real:
        """ℓ of (R2). Newton from above, where the quartic is convex: it comes down and never overshoots."""
        G = cofactor(F)
        square = wp.ddot(F, F)
        J = F[0, 0] * G[0, 0] + F[0, 1] * G[0, 1] + F[0, 2] * G[0, 2]
        last = square * square - real(4.0) * wp.ddot(G, G)
        x = wp.sqrt(real(3.0) * square)
        for _step in range(QUARTIC_STEPS):
            value = ((x * x - real(2.0) * square) * x - real(8.0) * J) * x + last
            slope = real(4.0) * (x * x - square) * x - real(8.0) * J
            change = value / slope
            if not change > real(0.1 * close) * x:  # also ends on 0/0, where F = 0
                break
            x = x - change
        return x

    @wp.func
    def quaternion(F: mat) -> quat:
        """Unit eigenvector of K(F) for ℓ, to a few digits."""
        trace = F[0, 0] + F[1, 1] + F[2, 2]
        z = axl(F)
        s = trace + largest_eigenvalue(F) * real(1.0 + close)
        M = mat4(
            real(2.0) * trace - s, z[0], z[1], z[2],
            z[0], real(2.0) * F[0, 0] - s, F[0, 1] + F[1, 0], F[0, 2] + F[2, 0],
            z[1], F[0, 1] + F[1, 0], real(2.0) * F[1, 1] - s, F[1, 2] + F[2, 1],
            z[2], F[0, 2] + F[2, 0], F[1, 2] + F[2, 1], real(2.0) * F[2, 2] - s,
        )  # fmt: skip
        X = wp.inverse(M)  # ≈ −q qᵀ / (close ℓ)
        least = X[0, 0]
        column = quat(X[0, 0], X[1, 0], X[2, 0], X[3, 0])
        for i in range(1, 4):
            if X[i, i] < least:
                least = X[i, i]
                column = quat(
                    X[0, i], X[1, i], X[2, i], X[3, i]
                )  # a column by its number would be kept in memory
        q = X * column
        length = wp.length(q)
        if not length > real(0.0):
            return quat(real(1.0), real(0.0), real(0.0), real(0.0))  # F = 0: every rotation is a maximiser
        return q / length

    @wp.func
    def minus_identity(q: quat) -> mat:
        """Q = R(q) − I without forming R."""
        w = q[0]
        u = vec(q[1], q[2], q[3])
        return real(2.0) * (w * wp.skew(u) + wp.outer(u, u) - wp.dot(u, u) * wp.identity(n=3, dtype=real))

    @wp.func
    def gap(S: mat) -> mat:
        """tr(S) I − S, symmetrised."""
        return wp.trace(S) * wp.identity(n=3, dtype=real) - real(0.5) * (S + wp.transpose(S))

    @wp.func
    def rotation(H: mat) -> mat:
        q = quaternion(wp.identity(n=3, dtype=real) + H)
        for _step in range(steps):
            Q = minus_identity(q)
            E = H + wp.transpose(Q) + wp.transpose(Q) * H  # RᵀF − I
            w = wp.inverse(gap(wp.identity(n=3, dtype=real) + E)) * axl(E)
            half = real(0.5) * w
            u = vec(q[1], q[2], q[3])
            v = q[0] * half + u + wp.cross(u, half)
            q = wp.normalize(quat(q[0] - wp.dot(u, half), v[0], v[1], v[2]))  # (R3)
        return minus_identity(q)

    @wp.func
    def rotation_adj(H: mat, Q: mat, adj_R: mat) -> mat:
        """∂L/∂F (R3.F)."""
        R = wp.identity(n=3, dtype=real) + Q
        S = wp.transpose(R) * (wp.identity(n=3, dtype=real) + H)
        A = gap(S)
        y = (
            wp.inverse(A)
            * axl(wp.transpose(R) * adj_R)
            / wp.where(wp.determinant(A) == real(0.0), real(0.0), real(1.0))
        )
        return R * wp.skew(y)

    return SimpleNamespace(rotation=rotation, rotation_adj=rotation_adj)
