"""Lamé's constants and masses of the particles, and their adjoint. Derivation: docs/math/elasticity.md.

μ = E / 2(1 + ν),   λ = E ν / (1 + ν)(1 − 2ν),   m = ρ V / unit                                          (E0)
Ē = (μ̄/2 + ν t λ̄) s,   ν̄ = E s² ((1 + 2ν²) t² λ̄ − μ̄/2),   ρ̄ = m̄ V / unit,                              (E0.adj)
with s = 1/(1 + ν) and t = 1/(1 − 2ν).
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.structs import DTYPES


@kernel_factory
def material(dtype: str) -> SimpleNamespace:
    real = DTYPES[dtype]

    @kernel()
    def constants(
        # Parameters:
        volume: wp.array(dtype=real),
        unit: wp.array(dtype=real),
        # In:
        young: wp.array2d(dtype=real),
        poisson: wp.array2d(dtype=real),
        density: wp.array2d(dtype=real),
        # Out:
        mu: wp.array2d(dtype=real),
        lam: wp.array2d(dtype=real),
        mass: wp.array2d(dtype=real),
    ):
        world, p = wp.tid()
        E, nu = young[world, p], poisson[world, p]
        mu[world, p] = E / (real(2.0) * (real(1.0) + nu))
        lam[world, p] = E * nu / ((real(1.0) + nu) * (real(1.0) - real(2.0) * nu))
        mass[world, p] = density[world, p] * volume[p] / unit[0]  # exactly 1 where it is the unit

    @kernel()
    def constants_adj(
        # Parameters:
        volume: wp.array(dtype=real),
        unit: wp.array(dtype=real),
        # In:
        young: wp.array2d(dtype=real),
        poisson: wp.array2d(dtype=real),
        adj_mu: wp.array2d(dtype=real),
        adj_lam: wp.array2d(dtype=real),
        adj_mass: wp.array2d(dtype=real),
        # Out:
        adj_young: wp.array2d(dtype=real),
        adj_poisson: wp.array2d(dtype=real),
        adj_density: wp.array2d(dtype=real),
    ):
        """(E0.adj)"""
        world, p = wp.tid()
        E = young[world, p]
        nu = poisson[world, p]
        s = real(1.0) / (real(1.0) + nu)
        t = real(1.0) / (real(1.0) - real(2.0) * nu)
        half = real(0.5) * adj_mu[world, p]
        of_lam = adj_lam[world, p]
        adj_young[world, p] = s * (half + nu * t * of_lam)
        adj_poisson[world, p] = E * s * s * ((real(1.0) + real(2.0) * nu * nu) * t * t * of_lam - half)
        adj_density[world, p] = adj_mass[world, p] * volume[p] / unit[0]

    return SimpleNamespace(constants=constants, constants_adj=constants_adj)
