"""Fixed corotated solid (corotated.py). Source: Stomakhin et al. 2012.

τ = 2μ S + λ j (1 + j) I                                                                        (E2)
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.corotated import corotated
from softmpm.kernels.structs import types


@kernel_factory
def law(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real = t.real
    pair = wp.types.vector(2, real)

    @wp.func
    def pressure(j: real) -> real:
        return j * (real(1.0) + j)

    @wp.func
    def pressure_slope(j: real) -> real:
        return real(1.0) + real(2.0) * j

    @wp.func
    def energy_slopes(j: real) -> pair:
        return pair(j, real(1.0))

    return corotated(dim, dtype, pressure, pressure_slope, energy_slopes)
