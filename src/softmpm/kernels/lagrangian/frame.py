"""Translation of a world: u_total = shift + u, with the shift in float64, so that u stays small. Derivation: docs/math/lagrangian.md.

    d = q round(u_m / q) along each axis with |u_m| > q, else 0,   u ← u − d,   shift ← shift + d              (Q9)

with u_m of one node m in the middle of the bodies and q the power of two from dx on. d depends on the state alone, hence on no
division into calls or chunks.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


@kernel_factory
def frame(dim: int, dtype: str) -> SimpleNamespace:
    real, vec = types(dim, dtype).real, types(dim, dtype).vec
    exact_vec = types(dim, "float64").vec

    class Frame:
        middle: int  # node m
        quantum: real  # q [m]
        per_quantum: real  # 1/q

    Frame = wp.struct(Frame, module=f"softmpm.types.d{dim}.{dtype}")

    @wp.func
    def recentring(body: Frame, here: vec) -> vec:
        """d of (Q9) from u_m."""
        d = vec()
        for axis in range(dim):
            whole = body.quantum * wp.round(here[axis] * body.per_quantum)  # exact, since q is a power of two
            d[axis] = wp.where(wp.abs(here[axis]) > body.quantum, whole, real(0.0))
        return d

    @wp.func
    def exact(a: vec) -> exact_vec:
        b = exact_vec()
        for axis in range(dim):
            b[axis] = wp.float64(a[axis])
        return b

    return SimpleNamespace(Frame=Frame, recentring=recentring, exact=exact)
