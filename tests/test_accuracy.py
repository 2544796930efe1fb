"""Short problems of bench/accuracy.py with limits; docs/accuracy.md has all of them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from bench.problems import contact, exact, solids, spheres, statics, waves

RESULTS = Path(__file__).parents[1] / "bench" / "results"


def test_a_cantilever_bends_as_the_exact_beam():
    """By a fifth of its length: 0.2 % with 1.2 million particle-substeps, 1 % with 0.4 million."""
    for size, limit, cost in (((3, 3), 0.2, 1.2), ((2, 3), 1.0, 0.4)):
        found = statics.beam("reference", *size, sinks=0.2, dim=2)
        assert abs(found["error %"]) <= limit
        assert found["cost M"] <= cost


def test_a_cantilever_of_two_cells_bends_in_3d():
    """Within 2 %."""
    assert abs(statics.beam("reference", 2, 3, sinks=0.2, dim=3)["error %"]) <= 2.0


def test_a_bar_of_two_cells_turns_as_saint_venant_says():
    """Within 2 % in both formulations."""
    for formulation in ("reference", "moving"):
        assert abs(statics.twisted(formulation, 2, 2)["error %"]) <= 2.0


def test_a_column_sinks_under_its_weight():
    """Within 0.03 % with 32 cells, where a sticking wall has an error of 0.9 %."""
    assert abs(statics.column("reference", 32, 2)["error %"]) <= 0.03


@pytest.mark.parametrize(("clamped", "limit"), [(True, 0.12), (False, 0.4)])
def test_a_bar_vibrates_with_second_order(clamped, limit):
    """Lowest frequency with 16 cells, and the order from 8 to 16."""
    coarse, fine = (waves.bar("reference", n, 2, clamped=clamped)["error %"] for n in (8, 16))
    assert abs(fine) <= limit
    assert math.log2(coarse / fine) >= 1.9


def test_a_disc_breathes():
    """Within 0.7 % with 32 cells per unit of length, 8 in its radius."""
    assert abs(waves.disc("reference", 32, 2)["error %"]) <= 0.7


@pytest.mark.parametrize("formulation", ["reference", "moving"])
def test_a_disc_rests_as_hertz_says(formulation):
    """Its centre sinks by the exact amount to 1 %, its largest pressure is exact to 3 %, with 1.7 cells in half of the contact."""
    found = contact.hertz(32, 2, formulation)
    assert abs(found["sinking"]["error %"]) <= 1.0
    assert abs(found["pressure"]["error %"]) <= 3.0


def test_a_block_rests_on_the_floor():
    """Without a gap: within half a hundredth of a cell."""
    assert abs(contact.gap(2, 2)["error %"]) <= 0.5


def test_a_soft_block_rests_on_a_slope(monkeypatch):
    """With its corners on nodes, where it rolled a metre down when the outline did not load the nodes as the particles do."""
    monkeypatch.syspath_prepend(RESULTS.parent)
    from bench import slope

    found = slope.slope(6, (0.0, 0.0), "reference", torch.device("cpu"))
    assert found["1.5 s, mm"] < 25.0


@pytest.mark.parametrize(("formulation", "force"), [("reference", 3.0), ("moving", 6.0)])
def test_a_sphere_is_pressed_as_hertz_says(formulation, force):
    """Force of two plates on a sphere of 8 cells to so many percent, and radius of the contact, one cell, to 3 %."""
    found = {
        name: 100 * (measured / want - 1)
        for name, (measured, want) in spheres.pressed(4, formulation).items()
    }
    assert abs(found["force [N]"]) <= force
    assert abs(found["radius of the contact [m]"]) <= 3.0


@pytest.mark.parametrize("formulation", ["reference", "moving"])
def test_friction_is_alike_in_all_directions(formulation):
    """A block slides along an axis and obliquely as a rigid one, to 0.01 %, rests below the angle of friction, and goes with a belt."""
    found = solids.slid(3, formulation, (0.25, 0.5, 0.4), headings=(0.0, 30.0))
    acceleration, rigid = found.pop("acceleration [m/s²]")
    assert abs(acceleration / rigid - 1) <= 1e-4
    for name, (measured, _) in found.items():
        assert abs(measured) <= 1e-4, name


@pytest.mark.parametrize("formulation", ["reference", "moving"])
def test_friction_stops_a_spin(formulation):
    """Torque of a uniform pressure under a square, and its change of angular momentum, to 1.5 %; then it stands still."""
    torque, change, spin = solids.spins(4, formulation, "square").values()
    assert abs(torque.measured / torque.exact - 1) <= 0.015
    assert abs(change.measured / change.exact - 1) <= 0.015
    assert abs(spin.measured) <= 0.05


def test_the_exact_answers():
    """Against the literature: roots of the disc, torsion of a square, a small beam, a light column."""
    assert abs(exact.breathing(0.3) - 2.12575) < 1e-5
    assert abs(exact.breathing(0.0) - 1.84118) < 1e-5
    assert abs(exact.twist_of_bar(1.0, 1.0, 1.0, 1.0) * 2 * 0.1406 - 1) < 3e-4
    of = exact.section(1e5, 0.3, 0.1, None)
    small = exact.tip_of_beam(1e-3, 0.8, of)
    assert abs(small / (1e-3 * 0.8**4 / (8 * of.bending) + 1e-3 * 0.8**2 / (2 * of.shear)) - 1) < 1e-6
    assert abs(exact.sphere(1.0, 1.0, 0.3, 0.05).approach / 0.05**2 - 1) < 0.015  # a²/R of a half space
    light = exact.column([1.0], 1.0, 1e-6, 1.0, 1.0)[0]
    assert abs(light / (-1e-6 / 6) - 1) < 1e-5


@pytest.mark.parametrize("formulation", ["reference", "moving"])
def test_walks_are_those_of_the_present_robot(formulation, monkeypatch):
    """Displacements of docs/gait.md on the coarsest grid, within 0.1 %: whoever changes the robot has to measure its walks again."""
    monkeypatch.syspath_prepend(RESULTS.parent)
    from bench import gait

    rows = json.loads((RESULTS / "gait.walk.cpu.json").read_text())["rows"]
    wanted = dict(gait="viscous", formulation=formulation)
    (row,) = (
        r for r in rows if r.items() >= wanted.items() and (round(r["η/μ ms"]), r["cells/m"]) == (1, 40)
    )
    activations, meets = np.array(gait.GAITS["viscous"]), {"reference": "surface", "moving": "nodes"}
    found, _ = gait.walk(40, formulation, 1e-3, activations, "cpu", meets[formulation])
    np.testing.assert_allclose(1e3 * found.mean(axis=0), [row["0.5 s mm"], row["1 s mm"]], rtol=1e-3)
