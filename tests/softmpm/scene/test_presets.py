"""The presets have the numbers of their sources, the page on materials has those of the presets, and both simulate."""

import cmath
import dataclasses
import math
import re
from pathlib import Path

import pytest
import torch
from helpers import LAWS

import softmpm
from softmpm.oracle import stress as oracle_stress
from softmpm.scene.presets import Preset

PAGE = (Path(__file__).parents[3] / "docs" / "materials.md").read_text()
PRESETS = {
    name: preset
    for name in dir(softmpm.presets)
    if isinstance(preset := getattr(softmpm.presets, name), Preset)
}
SHEETS = {
    "ECOFLEX_00_30": (1.07, 10),
    "DRAGON_SKIN_10": (1.07, 22),
    "DRAGON_SKIN_20": (1.08, 49),
    "DRAGON_SKIN_30": (1.08, 86),
    "SMOOTH_SIL_950": (1.24, 272),
}
"""Specific gravity and stress at 100 % strain [psi] of the data sheets."""
PSI = 6894.757
STRESS_OVER_SHEET = {
    "NeoHookean": 1.03,
    "StableNeoHookean": 1.14,
    "FixedCorotated": 1.30,
    "BarrierCorotated": 1.30,
}
EACH = pytest.mark.parametrize("name", PRESETS)
DIMS = pytest.mark.parametrize("dim", [2, 3])


def table(first: str) -> dict[str, list[str]]:
    """Rows of the table of the page whose head begins with ``first``, by their first cell without quotes."""
    (rows,) = re.findall(rf"^\| {re.escape(first)} \|[^\n]*\n\|[-|]+\n((?:\|[^\n]*\n)+)", PAGE, re.MULTILINE)
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows.splitlines()]
    return {first.strip("`"): others for first, *others in cells}


def loss_tangent(frequency: float) -> float:
    """Of the fractional Kelvin-Voigt solid of Delory et al., from its real and imaginary parts."""
    power, turn = (2 * math.pi * frequency * 260e-6) ** 0.27, 0.27 * math.pi / 2
    return power * math.sin(turn) / (1 + power * math.cos(turn))


def gent(shore: int) -> float:
    """Young's modulus [kPa] of a Shore hardness of type A."""
    return 98.1 * (56 + 7.62336 * shore) / (0.137505 * (254 - 2.54 * shore))


def uniaxial_stress(material: softmpm.NeoHookean, stretch: float) -> float:
    """Engineering stress [Pa] of a bar whose sides are free, by bisection for their stretch."""
    young, poisson = (torch.tensor(v, dtype=torch.float64) for v in (material.young, material.poisson))
    law = oracle_stress.law_of(material)

    def tau(side: float) -> torch.Tensor:
        F = torch.diag(torch.tensor([stretch, side, side], dtype=torch.float64))
        return law(F, *oracle_stress.lame(young, poisson))

    low, high = 0.3, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if tau(middle)[1, 1] > 0 else (middle, high)
    return tau(low)[0, 0].item() / stretch


def box_scene(material, dim: int, spacing=5e-3) -> softmpm.Scene:
    """A box of 2 cm, eight particles a side, on cells of 5 mm, at half of its step limit."""
    box = softmpm.box((4 * spacing,) * dim, (8 * spacing,) * dim, spacing=spacing / 2)
    grid = softmpm.Grid(shape=(13,) * dim, spacing=spacing)
    down = (0.0, -9.8, 0.0)[:dim]
    scene = softmpm.Scene(grid=grid, bodies=[softmpm.Body(box, material)], gravity=down, dt=1e-7)
    return dataclasses.replace(scene, dt=0.5 * softmpm.stable_dt(scene))


def test_silicones_have_the_numbers_of_their_data_sheets():
    """Density and stress are those of the sheet, E is that of the incompressible neo-Hookean solid, to three digits."""
    assert set(SHEETS) == set(PRESETS) - {"MUSCLE"}
    for name, (gravity, psi) in SHEETS.items():
        preset = PRESETS[name]
        assert preset.density == pytest.approx(1000 * gravity)
        assert preset.stress_100 == pytest.approx(psi * PSI, rel=5e-3)
        assert preset.young / 3 * (2 - 1 / 4) == pytest.approx(psi * PSI, rel=5e-3)


def test_viscosities_have_the_measured_loss_tangent():
    """Silicones at 10 Hz, muscle at 25 Hz: tan δ = ω η / μ with μ = E / 3."""
    for name, preset in PRESETS.items():
        frequency = 25 if name == "MUSCLE" else 10
        measured = math.tan(0.253 * math.pi / 2) if name == "MUSCLE" else loss_tangent(10)
        assert 2 * math.pi * frequency * preset.viscosity / (preset.young / 3) == pytest.approx(
            measured, rel=5e-3
        )


def test_muscle_has_the_shear_modulus_of_elastography():
    """E = 3 μ with μ = 3.91 kPa, and the density of Mendez and Keys."""
    assert softmpm.presets.MUSCLE.young == pytest.approx(3 * 3.91e3, rel=5e-3)
    assert softmpm.presets.MUSCLE.density == 1060 and softmpm.presets.MUSCLE.stress_100 is None


@pytest.mark.parametrize("law", STRESS_OVER_SHEET)
def test_the_laws_have_the_stress_of_the_data_sheets(law):
    """At 100 % strain, times the factor that the page and the docstring state for each law, to 1 %."""
    assert set(STRESS_OVER_SHEET) == {known.__name__ for known in LAWS.values()}
    for name in SHEETS:
        material = PRESETS[name].material(law=getattr(softmpm, law))
        assert uniaxial_stress(material, 2.0) == pytest.approx(
            STRESS_OVER_SHEET[law] * PRESETS[name].stress_100, rel=1e-2
        )


def test_the_neo_hookean_law_has_its_incompressible_limit():
    """With ν near 0.5 the stress at 100 % strain is E/3 (2 − 1/4), by which E was found."""
    material = softmpm.presets.ECOFLEX_00_30.material(poisson=0.4999)
    assert uniaxial_stress(material, 2.0) == pytest.approx(118e3 / 3 * 1.75, rel=1e-4)


@EACH
@DIMS
def test_presets_simulate(name, dim):
    """A box stretched by 2 % falls by the parabola of a free body while it springs back, and less far than without viscosity.

    The mean strain is that of the damped oscillator of the slowest axial mode after its undamped half period, to 7e-4 of 2e-2.
    Silicones creep, since 2 cm vibrate at more than 190 Hz.
    """
    stretches = []
    for changes in ({}, {"viscosity": 0.0}):
        scene = box_scene(PRESETS[name].material(**changes), dim)
        model = softmpm.build(scene, device="cpu", dtype=torch.float64)
        rest, params = model.rest(), model.params()
        side = 1.02 ** (-1 / (dim - 1))  # the volume does not change
        F = torch.diag(torch.tensor([1.02, side, side][:dim], dtype=torch.float64))
        middle = rest.x.mean(1, keepdim=True)
        start = rest._replace(x=middle + (rest.x - middle) @ F, F=(rest.F @ F).contiguous())
        speed = math.sqrt(PRESETS[name].young / PRESETS[name].density)
        substeps = math.ceil(0.02 / speed / scene.dt)  # half a period of the slowest axial mode
        end = softmpm.simulate(model, start, None, params, substeps=substeps)
        fall = 9.8 * scene.dt**2 * substeps * (substeps + 1) / 2
        assert torch.allclose(end.x.mean(1)[0, 1], start.x.mean(1)[0, 1] - fall, rtol=0, atol=1e-9)
        stretches.append(end.F[..., 0, 0].mean().item() - 1)
    damped, free = stretches
    assert free < damped < 0.02, stretches
    rate = math.pi * math.sqrt(PRESETS[name].young / PRESETS[name].density) / 0.02  # ω of the mode [1/s]
    creep = 3 * PRESETS[name].viscosity / PRESETS[name].young
    root = cmath.sqrt((creep * rate**2 / 2) ** 2 - rate**2)
    slow, fast = -creep * rate**2 / 2 + root, -creep * rate**2 / 2 - root
    half = math.pi / rate
    oscillator = (slow * cmath.exp(fast * half) - fast * cmath.exp(slow * half)) / (slow - fast)
    assert damped == pytest.approx(0.02 * oscillator.real, abs=7e-4), (damped, 0.02 * oscillator.real)


def test_values_can_be_replaced():
    """Fields and the law of a material; a preset itself is frozen, and other names or bad values are refused."""
    preset = softmpm.presets.DRAGON_SKIN_20
    made = preset.material(law=softmpm.StableNeoHookean, poisson=0.49, viscosity=0.0)
    assert made == softmpm.StableNeoHookean(density=1080, young=579e3, poisson=0.49, viscosity=0.0)
    assert dataclasses.replace(preset, young=5e5).material().young == 5e5
    assert preset.material() == softmpm.NeoHookean(density=1080, young=579e3, poisson=0.45, viscosity=320)
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset.young = 1.0
    with pytest.raises(TypeError, match="youngs"):
        preset.material(youngs=1.0)
    with pytest.raises(ValueError, match=r"poisson must lie in \(-1, 0.5\)"):
        preset.material(poisson=0.5)


def test_every_preset_states_its_sources():
    """Of its density, its Young's modulus and its viscosity."""
    for preset in PRESETS.values():
        assert all(word in preset.source for word in ("Density", "Young's modulus", "Viscosity")), preset.name


def test_the_page_has_the_values_of_the_presets():
    """All of them, and the retardation time 3 η/E."""
    rows = table("preset | material")
    assert set(rows) == set(PRESETS)
    for name, (material, *cells) in rows.items():
        preset = PRESETS[name]
        stress = None if preset.stress_100 is None else preset.stress_100 / 1e3
        assert material == preset.name
        for cell, value in zip(
            cells[:4], (preset.density, preset.young / 1e3, stress, preset.viscosity), strict=True
        ):
            assert cell == "–" if value is None else float(cell) == pytest.approx(value, rel=1e-12)
        assert float(cells[4]) == pytest.approx(3e3 * preset.viscosity / preset.young, abs=5.1e-3)


def test_the_page_has_the_data_sheets_and_gents_relation():
    """Numbers of the sheets, 12/7 of the stress, and the estimate by Shore hardness or by the storage modulus at 10 Hz."""
    rows = table("preset | specific gravity")
    assert set(rows) == set(SHEETS)
    storage = 3 * 27.8 * (1 + (2 * math.pi * 10 * 260e-6) ** 0.27 * math.cos(0.27 * math.pi / 2))
    for name, (gravity, psi, young, other) in rows.items():
        assert (float(gravity), float(psi)) == SHEETS[name]
        assert float(young) == pytest.approx(12 / 7 * SHEETS[name][1] * PSI / 1e3, abs=0.51)
        shore = re.search(r"Shore (\d+)A", other)
        value = gent(int(shore[1])) if shore else storage
        assert float(other.split(",")[0]) == pytest.approx(value, abs=0.51), name


def test_the_page_has_the_stress_of_each_law():
    """The factors that are tested above."""
    assert {law: float(cell) for law, (cell,) in table("law").items()} == STRESS_OVER_SHEET


def test_the_page_has_the_loss_tangents():
    """And the retardation times tan δ / ω."""
    for frequency, (tangent, time) in table("frequency [Hz]").items():
        assert float(tangent) == pytest.approx(loss_tangent(float(frequency)), abs=5.1e-4)
        want = 1e3 * loss_tangent(float(frequency)) / (2 * math.pi * float(frequency))
        assert float(time) == pytest.approx(want, abs=5.1e-3)


def test_the_page_has_the_step_limits():
    """To three digits those of stable_dt, and of dt² (2μ + dim λ) + 4 η dt = ρ dx², solved by hand."""
    rows = table("preset | 2D")
    assert set(rows) == set(PRESETS)
    for name, cells in rows.items():
        for cell, (dim, changes) in zip(
            cells, [(2, {}), (2, {"viscosity": 0.0}), (3, {}), (3, {"viscosity": 0.0})], strict=True
        ):
            m = PRESETS[name].material(**changes)
            mu, lam = (
                m.young / (2 + 2 * m.poisson),
                m.young * m.poisson / ((1 + m.poisson) * (1 - 2 * m.poisson)),
            )
            K, mass = 2 * mu + dim * lam, m.density * 5e-3**2
            by_hand = (math.sqrt((2 * m.viscosity) ** 2 + K * mass) - 2 * m.viscosity) / K
            assert softmpm.stable_dt(box_scene(m, dim)) == pytest.approx(by_hand, rel=1e-6)
            assert float(cell) == float(f"{1e6 * by_hand:.3g}"), name


def test_the_code_of_the_page_runs():
    """It makes three materials, one of them elastic."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert names["soft"].viscosity > 0 and names["flesh"].poisson == 0.49 and names["elastic"].viscosity == 0
