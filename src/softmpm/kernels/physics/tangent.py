"""Bound of the tangent δP = 𝔸[δF], for the step limit of the reference formulation. Derivation: docs/math/lagrangian.md.

    step   Δt ≤ s dx √(ρ₀ / K),   K ≥ λ_max(𝔸 + (2s/Δt) 𝕍)                                          (Q7), (W4)
    K = σ + t/d + √((d − 1)/d (q − t²/d)),   t = tr M,   q = |M|²                                    (Q8)
    M = f'' c cᵀ + f' N + κ s sᵀ + v diag(s²),   v = 4 η s/Δt

with the principal stretches s, c_i = J/s_i, and N the second derivative of J. t and q are polynomials in the invariants of F, so that
no principal axis is needed.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import DTYPES, types


@kernel_factory
def moduli_type(dtype: str):
    real = DTYPES[dtype]

    class Moduli:
        shear: real  # σ: what a part contributes to every direction, at least [Pa]
        outer: real  # κ: factor of F ⊗ F [Pa]
        slope: real  # f' of the energy f(J) [Pa]
        curvature: real  # f'', or more; not negative [Pa]

    return wp.struct(Moduli, module=f"softmpm.types.{dtype}")


@kernel_factory
def tangent(dim: int, dtype: str) -> SimpleNamespace:
    t, Moduli = types(dim, dtype), moduli_type(dtype)
    real, mat = t.real, t.mat
    d, others, spread = real(dim), real(dim - 1), real((dim - 1) / dim)

    @wp.func
    def stiffer(F: mat, j: real, m: Moduli, v: real, limit: real) -> bool:
        """True if K of (Q8) is above ``limit`` [Pa]; false if it is not a number."""
        J = real(1.0) + j
        B = F * wp.transpose(F)
        s2 = wp.trace(B)
        s4 = wp.ddot(B, B)
        c2 = s2
        n = real(1.0)
        if wp.static(dim == 3):
            c2 = real(0.5) * (s2 * s2 - s4)
            n = s2
        own = m.curvature * c2
        outer = m.outer * s2
        trace = own + outer + v * s2
        q = own * own + outer * outer + v * v * s4 + real(2.0) * m.slope * m.slope * n
        q += real(4.0) * m.curvature * m.slope * J * n
        q += real(2.0) * d * m.outer * J * (d * m.curvature * J + others * m.slope)
        q += real(2.0) * v * (d * m.curvature * J * J + m.outer * s4)
        mean = trace / d
        left = limit - m.shear - mean
        return left < real(0.0) or spread * (q - trace * mean) > left * left  # saves the root

    return SimpleNamespace(stiffer=stiffer)
