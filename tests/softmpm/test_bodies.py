"""Contact between bodies on the moving grid (docs/formulations.md): they stick while they share nodes, and part unless built so."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import softmpm

CELL = 0.01  # [m]
RUBBER = softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3, viscosity=60.0)  # waves of 10 m/s


def model_of(lower, upper, **changes) -> softmpm.Model:
    """Two boxes in float64."""
    bodies = [softmpm.Body(shape, RUBBER) for shape in (lower, upper)]
    scene = softmpm.Scene(grid=softmpm.Grid(shape=(60, 40), spacing=CELL), bodies=bodies, dt=1e-6, **changes)
    scene = dataclasses.replace(scene, dt=0.4 * float(softmpm.stable_dt(scene)))
    return softmpm.build(scene, device="cpu", dtype=torch.float64, inputs=("gravity",))


def box(x: float, y: float, width: float, height: float) -> softmpm.Particles:
    return softmpm.box((x, y), (x + width, y + height), spacing=CELL / 2)


@pytest.mark.parametrize(("gap", "left"), [(1.0, 0.0), (2.5, 1.0)])
def test_bodies_that_are_built_together_are_attached(gap, left):
    """At 1 % of the wave speed blocks with a gap of one cell do not part; of 2.5 cells they do not act on each other."""
    lower = box(0.2, 0.15, 0.08, 0.04)
    model = model_of(lower, box(0.2, 0.19 + gap * CELL, 0.08, 0.04), gravity=(0.0, 0.0))
    rest, params = model.rest(), model.params()
    v = torch.zeros_like(rest.v)
    v[:, : len(lower), 1], v[:, len(lower) :, 1] = -0.05, 0.05
    end = softmpm.simulate(model, rest._replace(v=v), None, params, substeps=round(0.15 / model.scene.dt))
    lower_v, upper_v = softmpm.mean_velocity(model, end, params, per_body=True)[0, :, 1].tolist()
    assert upper_v - lower_v == pytest.approx(0.1 * left, abs=0.004)
    assert softmpm.momentum(model, end, params)[0].tolist() == pytest.approx([0.0, 0.0], abs=1e-12)


def test_a_body_lies_on_another_with_a_gap_and_without_sliding_and_leaves_it():
    """On a base that is tilted by 20° a block rests one cell above it; when gravity turns round, it leaves in free fall."""
    base = box(0.1, 0.1, 0.2, 0.04)
    driven = np.flatnonzero(base.positions[:, 1] < 0.12)
    tilted = (9.8 * math.sin(math.radians(20)), -9.8 * math.cos(math.radians(20)))
    model = model_of(base, box(0.16, 0.165, 0.08, 0.03), gravity=tilted, driven=driven)
    params, substeps = model.params(), round(0.02 / model.scene.dt)
    state = softmpm.simulate(model, model.rest(), None, params, substeps=15 * substeps)
    later = softmpm.simulate(model, state, None, params, substeps=5 * substeps)
    upper, moved = later.x[0, len(base) :], (later.x - state.x)[0, len(base) :, 0].mean()
    assert abs(moved) < 0.1 * CELL  # without friction: 12 cells
    gap = (upper[:, 1].min() - later.x[0, : len(base), 1].max()) / CELL - 0.5  # between the surfaces
    assert 0.5 < gap < 1.5
    up = softmpm.Inputs(gravity=torch.tensor([0.0, 9.8], dtype=torch.float64))
    end = softmpm.simulate(model, later, None, params, substeps=5 * substeps, inputs=up)
    speed = softmpm.mean_velocity(model, end, params, per_body=True)[0, 1, 1]
    assert speed == pytest.approx(9.8 * 5 * substeps * model.scene.dt, rel=0.05)
