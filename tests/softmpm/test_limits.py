"""At the extremes nothing is silently wrong: a short map, judged without the library's alarms."""

import numpy as np
import pytest
import torch
from bench.extremes import bodies
from bench.extremes.cells import How, Outcome, verdict
from bench.extremes.judges import DENSITIES, Exact, Matter, stretches
from bench.extremes.laws import LAWS
from bench.extremes.pages import PAGES

import softmpm
from softmpm.oracle import stress as oracle_stress

ROWS = [row for rows in PAGES.values() for row in rows]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_nothing_is_silent_at_the_extremes(row, law):
    """Each cell is right, refused by name or stopped by name; in 3D the most extreme one of one law stands for the others."""
    cells = [(2, value) for value in row.few]
    cells += [(3, row.few[-1])] if law is softmpm.FixedCorotated else []
    found = {(dim, value): verdict(lambda d=dim, v=value: row.cell(law, d, v, How())) for dim, value in cells}
    assert not {cell: each.note for cell, each in found.items() if each.outcome is Outcome.SILENT}


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_the_judges_energies_belong_to_the_stresses(law, dim):
    """The derivative of the energy along (I + εG)F is τ : G, by central differences."""
    random = np.random.default_rng(0)
    F, G = np.eye(dim) + 0.2 * random.standard_normal((5, dim, dim)), random.standard_normal((5, dim, dim))
    mu, lam, eps = np.full(5, 2.0), np.full(5, 3.0), 1e-6

    def energy(step: float) -> np.ndarray:
        moved = F + step * G @ F
        return DENSITIES[law.__name__](stretches(moved), np.linalg.det(moved), mu, lam)

    stress = oracle_stress.LAWS[law](*(torch.from_numpy(array) for array in (F, mu, lam))).numpy()
    slope = (energy(eps) - energy(-eps)) / (2 * eps)
    assert slope == pytest.approx((stress * G).sum((1, 2)), rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["muscle", "pressure"])
def test_the_judges_energies_belong_to_the_actuators(kind, dim):
    """The same for the energy of actuators, Σ V⁰ τ : G, at an activation of 0.7."""
    scene = bodies.scene(bodies.block(softmpm.NeoHookean, dim, side=1), **{kind: 20.0})
    matter, random, eps = Matter(scene, activation=0.7), np.random.default_rng(0), 1e-6
    shape = (len(matter.rest), dim, dim)
    F, G = np.eye(dim) + 0.2 * random.standard_normal(shape), random.standard_normal(shape)

    def energy(step: float) -> float:
        still = np.zeros_like(F)
        return matter.energy(Exact(matter.rest, still[:, 0], still, F + step * G @ F)).actuators

    actuator = scene.muscles[0]
    direction = torch.tensor(getattr(actuator, "direction", ()), dtype=torch.float64).expand(len(F), -1)
    p = torch.full((len(F),), 0.7 * 20.0, dtype=torch.float64)
    stress = oracle_stress.actuator_stress(actuator, torch.from_numpy(F), direction, p).numpy()
    slope = (energy(eps) - energy(-eps)) / (2 * eps)
    assert slope == pytest.approx(matter.volume @ (stress * G).sum((1, 2)), rel=1e-7)
