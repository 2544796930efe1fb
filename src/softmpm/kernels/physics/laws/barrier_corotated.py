"""Corotated solid with a volumetric barrier (corotated.py): the pressure is the derivative of λ/8 (J − 1/J)².

τ = 2μ S + λ/4 (J² − J⁻²) I                                                                     (E3)
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.corotated import corotated
from softmpm.kernels.structs import types


@kernel_factory
def law(dim: int, dtype: str) -> SimpleNamespace:
    real, divide = types(dim, dtype).real, types(dim, dtype).divide
    pair = wp.types.vector(2, real)

    @wp.func
    def pressure(j: real) -> real:
        """(J² − J⁻²) / 4, without cancellation where j is small."""
        square = (real(1.0) + j) * (real(1.0) + j)
        return divide(real(0.25) * j * (real(2.0) + j) * (square + real(1.0)), square)

    @wp.func
    def pressure_slope(j: real) -> real:
        J = real(1.0) + j
        return real(0.5) * (J + divide(real(1.0), J * J * J))

    @wp.func
    def energy_slopes(j: real) -> pair:
        J = real(1.0) + j
        fourth = divide(real(3.0), J * J * J * J)
        return pair(divide(pressure(j), J), real(0.25) * (real(1.0) + fourth))

    return corotated(dim, dtype, pressure, pressure_slope, energy_slopes)
