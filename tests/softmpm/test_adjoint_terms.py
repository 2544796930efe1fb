"""Every term of the adjoints of the moving formulation against the float64 oracle, in scenes so small that bench/mutants.py can run
them for each; those of viscosity are in test_inputs.py."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp
from helpers import LAWS, assert_relative, busy_inputs, busy_scene, cotangent, dot, gradients, little_memory

import softmpm
from softmpm.kernels.physics.slot_sum import COLLECTORS
from softmpm.oracle import moving


def walled_scene(dim: int) -> softmpm.Scene:
    """:func:`busy_scene` between walls of every kind, which share nodes, so that some adjoints pass through several."""
    normals = [(0.0, 1.0, 0.0), (-1.0, 0.3, 0.1), (0.2, -1.0, 0.0), (1.0, 0.0, 0.1), (0.6, 0.8, 0.0)]
    kinds = [("separate", 0.4), ("slip", 0.0), ("separate", 0.0), ("stick", 0.0), ("separate", 0.1)]
    offsets = (0.41, -0.45, -0.45, 0.33, 0.55)
    walls = [
        softmpm.Wall(normal=normal[:dim], offset=offset, contact=kind, friction=friction)
        for normal, (kind, friction), offset in zip(normals, kinds, offsets, strict=True)
    ]
    return busy_scene(dim, tuple(LAWS), per_law=8, walls=walls)


def build(scene: softmpm.Scene, **settings) -> softmpm.Model:
    """On the CPU, without the alarms of a body that these scattered particles are not."""
    return softmpm.build(scene, device="cpu", alarms=softmpm.Alarms(gap=None), **settings)


def assert_gradients_are_the_references(model, inputs, substeps: int, limit: float) -> None:
    copies = {name: t.detach().double().requires_grad_() for name, t in inputs.items()}
    weights = cotangent(softmpm.State(*(copies[name] for name in "xvCF")))
    found = gradients(softmpm.simulate, model, inputs, substeps, [w.to(model.dtype) for w in weights[:4]])
    wanted = gradients(moving.simulate, model.scene, copies, substeps, weights)
    for name in inputs:
        assert wanted[name].abs().max() > 0, f"the test does not exercise {name}"
        assert_relative(found[name].double(), wanted[name], limit, name)


@pytest.mark.parametrize("dim", [2, 3])
def test_every_gradient_is_the_references(dim, scheme):
    """All walls, all laws, overlapping muscles, damping: ≤ 1e-10 for each input."""
    model = build(walled_scene(dim), dtype=torch.float64, scheme=scheme, worlds=2)
    assert_gradients_are_the_references(model, busy_inputs(model), 3, 1e-10)


@pytest.mark.parametrize("dim", [2, 3])
def test_rasterize_is_the_references(dim):
    """Mass and velocity on the grid: ≤ 1e-12 for x, v and C."""
    scene = walled_scene(dim)
    model = build(scene, dtype=torch.float64, worlds=2)
    inputs = busy_inputs(model)
    leaves = [inputs[name] for name in "xvC"]
    state = softmpm.State(*leaves, inputs["F"])
    fields = softmpm.rasterize(model, state), moving.rasterize(scene, state, model.params().density)
    generator = torch.Generator().manual_seed(5)
    weights = [torch.randn(t.shape, generator=generator, dtype=t.dtype) for t in fields[0]]
    found, wanted = (torch.autograd.grad(dot(weights, field), leaves) for field in fields)
    for name, got, want in zip("xvC", found, wanted, strict=True):
        assert_relative(got, want, 1e-12, name)


def test_gradients_add_up_over_chunks(scheme):
    """A call in many chunks, of which few states are checkpointed: ≤ 1e-9 for each input."""
    scene = walled_scene(2)
    settings = dict(dtype=torch.float64, scheme=scheme, worlds=2)
    model = build(scene, **settings, **little_memory(build(scene, **settings)))
    assert_gradients_are_the_references(model, busy_inputs(model, control_steps=3), 7, 1e-9)


def test_gradients_in_fixed_point_are_the_references():
    """A deterministic model sums the adjoints of active stresses in a fixed order: ≤ 2e-4 for each input, in single precision."""
    model = build(walled_scene(2), deterministic=True, worlds=2)
    assert_gradients_are_the_references(model, busy_inputs(model), 3, 2e-4)


def test_step_adds_to_gradients_that_are_there():
    """The adjoint of a step is added to every ``grad`` of the previous state and of the solid, whatever its values."""
    model = build(walled_scene(2), dtype=torch.float64)
    solid = softmpm.warp_solid(model, requires_grad=True)
    now, then = (softmpm.warp_state(model, requires_grad=True) for _ in range(2))
    tape = wp.Tape()
    softmpm.step(model, now, then, solid, tape=tape)
    arrays = [*now.differentiable(), *solid.differentiable()]
    ones = {array: wp.ones_like(array) for array in then.differentiable()}
    found = []
    for before in (0.0, 3.0):
        for array in arrays:
            wp.to_torch(array.grad).fill_(before)
        tape.backward(grads=ones)
        found.append([wp.to_torch(array.grad).clone() - before for array in arrays])
        tape.zero()
    for alone, added in zip(*found, strict=True):
        torch.testing.assert_close(added, alone, rtol=1e-12, atol=1e-12)


def test_the_active_stress_of_many_particles(scheme):
    """More particles than threads sum the adjoint of active stress, in muscles that follow each other in one slot: ≤ 1e-10."""
    side = int(np.ceil(np.sqrt(1.2 * COLLECTORS)))
    body = softmpm.box((0.3, 0.3), (0.8, 0.8), 0.5 / side)
    parts = np.array_split(np.arange(len(body)), 3)
    scene = busy_scene(2, per_law=1)
    scene = dataclasses.replace(
        scene,
        bodies=[softmpm.Body(body, softmpm.NeoHookean(density=1.0, young=80.0))],
        muscles=[
            softmpm.Muscle(particles=part, direction=(1, k), strength=5.0) for k, part in enumerate(parts)
        ],
        walls=[],
    )
    model = build(scene, dtype=torch.float64, scheme=scheme)
    assert_gradients_are_the_references(model, busy_inputs(model, control_steps=1), 1, 1e-10)
