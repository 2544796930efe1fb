"""Rotation R of F = R S, smooth where singular values repeat, and its adjoint. Derivation: docs/math/elasticity.md.

R maximises tr(RᵀF) over the proper rotations: the polar rotation if det F > 0, its sign-corrected sibling if det F < 0.
Functions take H = F − I and give Q = R − I, so that a small deformation keeps all its digits.

2D, with a = F₀₀ + F₁₁, b = F₁₀ − F₀₁, r = √(a² + b²):  cos = a/r, sin = b/r                       (R1)
3D: the unit quaternion q of R is the eigenvector of the largest eigenvalue ℓ = tr S of Davenport's K(F),
    ℓ⁴ − 2 |F|² ℓ² − 8 det(F) ℓ + |F|⁴ − 4 |cof F|² = 0,                                           (R2)
    found by inverse iteration to a few digits, then by Newton steps on the rotations:
    R ← R exp[ω],  (tr(S) I − S) ω = axl(RᵀF)                                                      (R3)
    with axl(M) = (M₂₁ − M₁₂, M₀₂ − M₂₀, M₁₀ − M₀₁).
Adjoint: F̄ += R [y],  (tr(S) I − S) y = axl(RᵀR̄)                                                    (R3.F)
of F − R, with M = RᵀP̄ and a = axl(M):  F̄ = R (sym M + ½ [y]),  (tr(S) I − S) y = (tr(S − I) I − (S − I)) a   (R4)

(R3.F) has no singular values in a denominator but their pairwise sums: it is singular only where R itself is not unique.
Source: Davenport's q-method (Markley & Mortari 2000) for (R2); the rest is derived.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.structs import types

NEWTON_STEPS = {"float32": 2, "float64": 3}  # each doubles the digits of a start that has a few
QUARTIC_STEPS = 40  # an upper bound: at F = I none is taken, elsewhere 3 to 8
INVERSE_STEPS = 3


@kernel_factory
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

    @wp.func
    def strain_adj(H: mat, Q: mat, adj: mat) -> mat:
        """∂L/∂F (R4)."""
        U = H - Q
        E = U + wp.transpose(Q) * U  # S − I, small where U is, also if R is not quite orthogonal
        M = adj + wp.transpose(Q) * adj
        even = real(0.5) * (M[0, 1] + M[1, 0])
        odd = real(0.5) * (M[1, 0] - M[0, 1]) * wp.trace(E) / (real(2.0) + wp.trace(E))
        out = mat(M[0, 0], even - odd, even + odd, M[1, 1])
        return out + Q * out

    return SimpleNamespace(rotation=rotation, rotation_adj=rotation_adj, strain_adj=strain_adj)


def _polar3(dtype: str) -> SimpleNamespace:
    t = types(3, dtype)
    real, vec, mat, divide = t.real, t.vec, t.mat, t.divide
    cofactor = kinematics(3, dtype).cofactor
    quat = wp.types.vector(4, real)  # (w, x, y, z), unit
    steps = NEWTON_STEPS[dtype]
    close = 1e-4 if dtype == "float32" else 1e-6  # the eigenvalue need not be better: (R3) finishes
    above = 1.0 + close
    tiny = 1e-8 if dtype == "float32" else 1e-17

    @wp.func
    def axl(M: mat) -> vec:
        return vec(M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1])

    @wp.func
    def normalized(q: quat) -> quat:
        return divide(real(1.0), wp.length(q)) * q

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
            change = divide(value, slope)
            if not change > real(0.1 * close) * x:  # also ends on 0/0, where F = 0
                break
            x = x - change
        return x

    @wp.func
    def quaternion(F: mat) -> quat:
        """Unit eigenvector of K(F) for ℓ, to a few digits: inverse iteration with (1 + close) ℓ I − K = L D Lᵀ.

        That matrix is positive definite, so it needs no pivots. The start is at a right angle to no rotation about the axes by
        quarter turns, and what rounding adds is enough elsewhere.
        """
        s = largest_eigenvalue(F) * real(above)
        trace = F[0, 0] + F[1, 1] + F[2, 2]
        z = axl(F)
        xy = -(F[0, 1] + F[1, 0])
        xz = -(F[0, 2] + F[2, 0])
        yz = -(F[1, 2] + F[2, 1])
        r0 = divide(real(1.0), s - trace)
        b = -r0 * z  # the column below the pivot, over it
        r1 = divide(real(1.0), s + trace - real(2.0) * F[0, 0] + b[0] * z[0])
        xy += b[0] * z[1]
        xz += b[0] * z[2]
        yz += b[1] * z[2]
        c = r1 * xy
        d = r1 * xz
        r2 = divide(real(1.0), s + trace - real(2.0) * F[1, 1] + b[1] * z[1] - c * xy)
        yz -= c * xz
        e = r2 * yz
        r3 = divide(real(1.0), s + trace - real(2.0) * F[2, 2] + b[2] * z[2] - d * xz - e * yz)
        small = real(close) * s  # keeps the length: the smallest eigenvalue is about that
        q = quat(real(0.8), real(0.45), real(0.3), real(0.2))
        for _step in range(INVERSE_STEPS):
            x = q[1] - b[0] * q[0]
            y = q[2] - b[1] * q[0] - c * x
            w = small * r3 * (q[3] - b[2] * q[0] - d * x - e * y)
            y = small * r2 * y - e * w
            x = small * r1 * x - c * y - d * w
            q = quat(small * r0 * q[0] - b[0] * x - b[1] * y - b[2] * w, x, y, w)
        if not wp.dot(q, q) > real(0.0):
            return quat(real(1.0), real(0.0), real(0.0), real(0.0))  # F = 0: every rotation is a maximiser
        return normalized(q)

    @wp.func
    def minus_identity(q: quat) -> mat:
        """Q = R(q) − I without forming R."""
        w = real(2.0) * q[0]
        x = real(2.0) * q[1]
        y = real(2.0) * q[2]
        z = real(2.0) * q[3]
        xx = x * q[1]
        yy = y * q[2]
        zz = z * q[3]
        return mat(
            -yy - zz, x * q[2] - w * q[3], x * q[3] + w * q[2],
            x * q[2] + w * q[3], -xx - zz, y * q[3] - w * q[1],
            x * q[3] - w * q[2], y * q[3] + w * q[1], -xx - yy,
        )  # fmt: skip

    @wp.func
    def turn(E: mat, z: vec) -> vec:
        """ω with (tr(S) I − S) ω = z for S = I + E, symmetrised; not finite where there is none."""
        a = real(2.0) + E[1, 1] + E[2, 2]
        b = real(2.0) + E[0, 0] + E[2, 2]
        c = real(2.0) + E[0, 0] + E[1, 1]
        d = real(-0.5) * (E[1, 2] + E[2, 1])
        e = real(-0.5) * (E[0, 2] + E[2, 0])
        f = real(-0.5) * (E[0, 1] + E[1, 0])
        first = vec(b * c - d * d, d * e - f * c, d * f - e * b)
        yy = a * c - e * e
        yz = e * f - d * a
        zz = a * b - f * f
        rest = vec(
            first[1] * z[0] + yy * z[1] + yz * z[2], first[2] * z[0] + yz * z[1] + zz * z[2], real(0.0)
        )
        over = divide(real(1.0), a * first[0] + f * first[1] + e * first[2])
        return over * vec(wp.dot(first, z), rest[0], rest[1])

    @wp.func
    def rotation(H: mat) -> mat:
        if wp.max(wp.max(wp.abs(H[0])), wp.max(wp.max(wp.abs(H[1])), wp.max(wp.abs(H[2])))) < real(tiny):
            # To the last digit, and a CPU is slow with the squares of these.
            return real(0.5) * (H - wp.transpose(H))
        q = quaternion(wp.identity(n=3, dtype=real) + H)
        for _step in range(steps):
            Q = minus_identity(q)
            E = H + wp.transpose(Q) + wp.transpose(Q) * H  # RᵀF − I
            half = real(0.5) * turn(E, axl(E))
            if not wp.isfinite(wp.dot(half, half)):
                half = vec()  # R is not unique; q is one of them
            u = vec(q[1], q[2], q[3])
            v = q[0] * half + u + wp.cross(u, half)
            q = normalized(quat(q[0] - wp.dot(u, half), v[0], v[1], v[2]))  # (R3)
        return minus_identity(q)

    @wp.func
    def rotation_adj(H: mat, Q: mat, adj_R: mat) -> mat:
        """∂L/∂F (R3.F)."""
        R = wp.identity(n=3, dtype=real) + Q
        y = turn(H + wp.transpose(Q) + wp.transpose(Q) * H, axl(wp.transpose(R) * adj_R))
        return R * wp.skew(y)

    @wp.func
    def strain_adj(H: mat, Q: mat, adj: mat) -> mat:
        """∂L/∂F (R4)."""
        U = H - Q
        E = U + wp.transpose(Q) * U  # S − I, small where U is, also if R is not quite orthogonal
        M = adj + wp.transpose(Q) * adj
        a = axl(M)
        y = turn(E, wp.trace(E) * a - real(0.5) * ((E + wp.transpose(E)) * a))
        out = real(0.5) * (M + wp.transpose(M) + wp.skew(y))
        return out + Q * out

    return SimpleNamespace(rotation=rotation, rotation_adj=rotation_adj, strain_adj=strain_adj)
