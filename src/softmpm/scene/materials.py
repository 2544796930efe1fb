"""Elastic laws and their constants."""

from dataclasses import dataclass
from typing import ClassVar

from softmpm.validate import need, store_numbers


@dataclass(frozen=True, kw_only=True, slots=True)
class Material:
    """Isotropic elastic solid, with Kelvin-Voigt viscosity if it has any. Use one of its laws, the subclasses below.

    ``softmpm.presets`` has the constants of silicones and muscle with their sources (docs/materials.md).
    """

    survives_inversion: ClassVar[bool] = False
    """True if the stress is defined where det F ≤ 0."""

    density: float
    """Rest density ρ₀ [kg/m³]. Differentiable as ``params.density`` of a call."""
    young: float
    """Young's modulus E [Pa]. Differentiable as ``params.young``."""
    poisson: float = 0.3
    """Poisson's ratio ν [-], in (-1, 0.5). Differentiable as ``params.poisson``."""
    viscosity: float = 0.0
    """Viscosity η [Pa s]: the second Piola-Kirchhoff stress 2η times the rate of the Green strain is added. Good values:
    η = ζ L √(ρ₀ E) / π damps the slowest stretching oscillation of a free body of length L with a damping ratio of about ζ.
    Large values need a small step, see :func:`softmpm.stable_dt`. Differentiable as ``Inputs.viscosity``."""

    def __post_init__(self):
        need(
            type(self) is not Material,
            "a material needs a law: use NeoHookean, StableNeoHookean, FixedCorotated or BarrierCorotated.",
        )
        store_numbers(self, "material", "density", "young", "poisson", "viscosity")
        need(self.density > 0, f"density must be > 0 kg/m³, got {self.density}.")
        need(self.young > 0, f"young must be > 0 Pa, got {self.young}.")
        need(
            -1.0 < self.poisson < 0.5,
            f"poisson must lie in (-1, 0.5), got {self.poisson}; rubber has 0.45 to 0.49.",
        )
        need(self.viscosity >= 0, f"viscosity must be ≥ 0 Pa s, got {self.viscosity}.")


@dataclass(frozen=True, kw_only=True, slots=True)
class NeoHookean(Material):
    """Neo-Hookean solid, τ = μ(FFᵀ − I) + λ log(J) I. For large stretch; an inverted particle is an error.

    Source: Hu et al. 2019, "ChainQueen", section III. Good values: E 10 to 1e6 Pa, ν 0.2 to 0.45.
    """


@dataclass(frozen=True, kw_only=True, slots=True)
class StableNeoHookean(Material):
    """Stable neo-Hookean solid, a polynomial in J and a fraction in |F|². Defined through inversion, without a rotation or a logarithm.

    τ = μ [(1 + k) FFᵀ − I] + [(λ + 5/6 μ) J − μ] (J − 1) I with k = s / (12 + 3s), s = |F|² − d. For flesh and other nearly
    incompressible solids; agrees with linear elasticity of (E, ν) at rest. Source: Smith, de Goes, Kim 2018, "Stable Neo-Hookean
    Flesh Simulation". Good values: E 10 to 1e6 Pa, ν 0.2 to 0.49.
    """

    survives_inversion: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True, slots=True)
class FixedCorotated(Material):
    """Fixed corotated solid, τ = 2μ(F − R)Fᵀ + λ(J − 1)J I. Defined through inversion; softens below J = 0.5.

    Source: Stomakhin et al. 2012, "Energetically consistent invertible elasticity". Values: as NeoHookean.
    """

    survives_inversion: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True, slots=True)
class BarrierCorotated(Material):
    """Fixed corotated solid with a volumetric barrier, τ = 2μ(F − R)Fᵀ + λ/4 (J² − J⁻²) I.

    As FixedCorotated at small strain, but resists the more the more it is compressed, which takes a smaller step: the stiffness
    λ/2 (J² + J⁻²) is 2 λ at J = 0.5 and 13 λ at J = 0.2. Source: the derivative of λ/8 (J − 1/J)². Values: as NeoHookean.
    """
