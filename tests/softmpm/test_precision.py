"""Accuracy of float32: it resolves small motions and agrees with float64."""

import numpy as np
import torch
from helpers import assert_relative, busy_inputs, busy_scene, gradients, run

import softmpm


def bar(dtype):
    """A free bar of 16 cells at CFL 0.04 that vibrates along its length, confined by slip walls; one period in substeps."""
    dx, rho, young = 1 / 32, 1.0, 1.0
    xs, ys = np.meshgrid(
        np.arange(32) * dx / 2 + dx / 4 + 0.25, np.arange(4) * dx / 2 + dx / 4 + 0.25, indexing="ij"
    )
    particles = softmpm.Particles(np.stack([xs, ys], -1).reshape(-1, 2), (dx / 2) ** 2)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(32, 20), spacing=dx),
        bodies=[softmpm.Body(particles, softmpm.NeoHookean(density=rho, young=young, poisson=0.0))],
        dt=0.04 * dx,
    )
    return softmpm.build(scene, device="cpu", dtype=dtype), round(2 * 0.5 / scene.dt)


def vibrate(dtype, calls=1):
    model, period = bar(dtype)
    rest = model.rest()
    v = torch.zeros_like(rest.v)
    v[..., 0] = 1e-5 * torch.cos(2 * torch.pi * (model.positions[:, 0].double() - 0.25)).to(dtype)
    state = rest._replace(v=v)
    for _ in range(calls):
        state = softmpm.simulate(model, state, None, model.params(), substeps=period // calls)
    return state


def test_a_small_vibration_survives_in_float32():
    """Strain 1e-5 at CFL 0.04: after one period the velocity is float64's to 1e-4, in one call and cut into ten."""
    want = vibrate(torch.float64).v
    assert (want.abs().max() / 1e-5 - 1).abs() < 0.1  # it has come back: the comparison is not between zeros
    assert_relative(vibrate(torch.float32).v.double(), want, 1e-4, "one call")
    assert_relative(vibrate(torch.float32, calls=10).v.double(), want, 1e-4, "ten calls")


def test_float32_gradients_are_those_of_float64(device):
    """Over 100 substeps with contact, friction and muscles, for each input, in 2D and 3D."""
    for dim in (2, 3):
        found = {}
        for dtype in (torch.float64, torch.float32):
            model = softmpm.build(busy_scene(dim, dt=5e-4), device=device, dtype=dtype)
            inputs = busy_inputs(softmpm.build(busy_scene(dim, dt=5e-4), device="cpu", dtype=torch.float32))
            inputs = {k: t.detach().to(model.device, dtype).requires_grad_() for k, t in inputs.items()}
            found[dtype] = gradients(softmpm.simulate, model, inputs, substeps=50)
        for name in found[torch.float64]:
            assert_relative(
                found[torch.float32][name].double(), found[torch.float64][name], 1e-3, f"{dim}D {name}"
            )


def test_slow_particles_move_in_float32():
    """1e-3 m/s at Δt = 1e-5 s moves a particle at 0.5 m by 1e-8 m a step: below the spacing of float32, and kept."""
    particles = softmpm.Particles(np.array([[0.5, 0.5]]), 1e-4)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(16, 16), spacing=0.1),
        bodies=[softmpm.Body(particles, softmpm.NeoHookean(density=1.0, young=1.0))],
        dt=1e-5,
    )
    model = softmpm.build(scene, device="cpu")
    rest = model.rest()
    end = softmpm.simulate(model, rest._replace(v=rest.v + 1e-3), None, model.params(), substeps=1000)
    torch.testing.assert_close(end.x - rest.x, torch.full_like(end.x, 1e-5), rtol=1e-2, atol=0)


def test_a_state_carries_what_rounding_took():
    """Two calls of n substeps end, in float32, where one call of 2n does: bitwise."""
    model = softmpm.build(busy_scene(2), device="cpu", dtype=torch.float32)
    inputs = {k: t.detach() for k, t in busy_inputs(model, control_steps=1).items()}
    whole = run(softmpm.simulate, model, inputs, substeps=20)
    half = run(softmpm.simulate, model, inputs, substeps=10)
    params = softmpm.Params(*(inputs[k] for k in softmpm.Params._fields))
    again = softmpm.simulate(model, half, inputs["activation"], params, substeps=10)
    for name in "xvCF":
        assert torch.equal(getattr(again, name), getattr(whole, name)), name
