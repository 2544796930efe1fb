"""Materials that soft robots are made of, with the sources of their constants: ``softmpm.presets``.

    body = softmpm.Body(shape, softmpm.presets.ECOFLEX_00_30.material(law=softmpm.StableNeoHookean))

The tables, their derivation and the step that each preset needs are in docs/materials.md.
"""

from dataclasses import dataclass

from softmpm.scene.materials import Material, NeoHookean

__all__ = [
    "DRAGON_SKIN_10",
    "DRAGON_SKIN_20",
    "DRAGON_SKIN_30",
    "ECOFLEX_00_30",
    "MUSCLE",
    "SMOOTH_SIL_950",
    "Preset",
]


@dataclass(frozen=True, kw_only=True, slots=True)
class Preset:
    """Constants of a real material. ``dataclasses.replace`` makes another one of it, :meth:`material` a law with these constants."""

    name: str
    """Name of the product or the tissue."""
    density: float
    """Rest density ρ₀ [kg/m³]."""
    young: float
    """Young's modulus E [Pa]. Silicones: that of the incompressible neo-Hookean solid with ``stress_100``, E = 12/7 σ."""
    viscosity: float
    """Viscosity η = tan δ E / (3 ω) [Pa s], which has the measured loss tangent tan δ at one angular frequency ω [1/s]."""
    stress_100: float | None = None
    """Engineering stress at 100 % uniaxial strain [Pa], the *100 % modulus* of data sheets; None if there is none."""
    poisson: float = 0.45
    """Poisson's ratio ν [-]. All these materials are incompressible, ν = 0.5, which has no stable step. With 0.45, a good value for
    every law, the volume grows by 4 to 5 % at 100 % strain; 0.49 takes less than half the step if there is no viscosity."""
    source: str
    """Origin of each number."""

    def material(self, law: type[Material] = NeoHookean, **changes: float) -> Material:
        """Material with these constants.

        Args:
            law: Elastic law. At 100 % strain the stress of NeoHookean is 3 % above ``stress_100``, of StableNeoHookean 14 % and
                of the corotated laws 30 %.
            changes: Values that replace those of the preset: ``density``, ``young``, ``poisson`` and ``viscosity``. The viscosity
                does not follow a changed Young's modulus.

        Raises:
            TypeError: A change has another name.
            ValueError: A value is outside its bounds.
        """
        constants = dict(
            density=self.density, young=self.young, poisson=self.poisson, viscosity=self.viscosity
        )
        return law(**(constants | changes))


_MEASURED = (
    "Viscosity: loss tangent 0.104 at 10 Hz of the fractional Kelvin-Voigt solid μ₀ (1 + (iωτ)ⁿ) with τ = 260 µs and n = 0.27, "
    "measured in a strip of Ecoflex (Delory et al. 2024, Viscoelastic dynamics of a soft strip subject to a large deformation, Soft "
    "Matter; constants from its published program, doi 10.5281/zenodo.10371481)"
)
_ASSUMED = f"{_MEASURED}. That this silicone has the same loss tangent is an assumption."

ECOFLEX_00_30 = Preset(
    name="Ecoflex 00-30",
    density=1070.0,
    young=118e3,
    viscosity=65.0,
    stress_100=68.9e3,
    source="Density and stress at 100 % (10 psi): Smooth-On, Ecoflex Series, technical bulletin. Young's modulus: 12/7 of this stress. "
    f"{_MEASURED}.",
)
"""The softest of the silicones here. At 10 Hz the strip of Delory et al. has E = 108 kPa."""

DRAGON_SKIN_10 = Preset(
    name="Dragon Skin 10",
    density=1070.0,
    young=260e3,
    viscosity=144.0,
    stress_100=152e3,
    source="Density and stress at 100 % (22 psi): Smooth-On, Dragon Skin Series, technical bulletin. Young's modulus: 12/7 of this "
    f"stress. {_ASSUMED}",
)
"""Silicone of Shore hardness 10A."""

DRAGON_SKIN_20 = Preset(
    name="Dragon Skin 20",
    density=1080.0,
    young=579e3,
    viscosity=320.0,
    stress_100=338e3,
    source="Density and stress at 100 % (49 psi): Smooth-On, Dragon Skin Series, technical bulletin. Young's modulus: 12/7 of this "
    f"stress. {_ASSUMED}",
)
"""Silicone of Shore hardness 20A."""

DRAGON_SKIN_30 = Preset(
    name="Dragon Skin 30",
    density=1080.0,
    young=1.02e6,
    viscosity=562.0,
    stress_100=593e3,
    source="Density and stress at 100 % (86 psi): Smooth-On, Dragon Skin Series, technical bulletin. Young's modulus: 12/7 of this "
    f"stress. {_ASSUMED}",
)
"""Silicone of Shore hardness 30A."""

SMOOTH_SIL_950 = Preset(
    name="Smooth-Sil 950",
    density=1240.0,
    young=3.21e6,
    viscosity=1780.0,
    stress_100=1.88e6,
    source="Density and stress at 100 % (272 psi): Smooth-On, Smooth-Sil Series, technical bulletin. Young's modulus: 12/7 of this "
    f"stress. {_ASSUMED}",
)
"""Silicone of Shore hardness 50A, for parts that hardly deform. Its viscosity takes a small step, see docs/materials.md."""

MUSCLE = Preset(
    name="passive skeletal muscle",
    density=1060.0,
    young=11.7e3,
    viscosity=10.4,
    source="Density: Mendez and Keys 1960, Density and composition of mammalian muscle, Metabolism 9. Young's modulus: 3 μ of the "
    "shear modulus 3.91 kPa of the human vastus medialis at rest, by elastography at about 100 Hz (Bensamoun et al. 2006, J. Magn. "
    "Reson. Imaging 23); the rectus femoris has the same (Chakouch et al. 2015, PLOS ONE 10, e0138873). Viscosity: loss tangent "
    "tan(0.253 π/2) = 0.42 of the springpot of relaxed human thigh at 25 to 62.5 Hz (Klatt et al. 2010, Phys. Med. Biol. 55), "
    "taken at 25 Hz.",
)
"""Relaxed human thigh muscle as an isotropic solid for small strains. Real muscle is three times as stiff in shear along its fibres as
across them (Knight et al. 2022, IEEE Trans. Med. Imaging), and stiffens where it is stretched."""


def __dir__() -> list[str]:
    return __all__
