"""``step`` in the reference formulation: the states and gradients of ``simulate``, on Warp arrays of nodes."""

import dataclasses

import pytest
import torch
import warp as wp
from helpers import assert_relative, busy_inputs, given
from surface_scenes import block, build

import softmpm
from softmpm.kernels.structs import types
from softmpm.schemes.lagrangian import nodal_step
from softmpm.schemes.lagrangian.nodal import particles_of

STEPS = 4
WALLS = ("friction", "wall_offset", "wall_normal", "wall_velocity")


def leaves_of(model: softmpm.Model) -> dict[str, torch.Tensor]:
    """Random inputs of one control step with walls that slide, one so rough that points stick to it, one so smooth that they slip."""
    found = busy_inputs(model, control_steps=1) | given(model, WALLS, 1)
    found |= {name: found[name][:1] for name in ("wall_offset", "wall_normal")}  # a single pose
    found["friction"] = found["friction"] * torch.tensor([30.0, 1e-5, 1.0]).to(found["friction"])
    return {name: tensor.detach().requires_grad_() for name, tensor in found.items()}


def arguments(leaves, grad: bool):
    """Activation, material and inputs."""
    kept = {name: t if grad else t.detach() for name, t in leaves.items()}
    inputs = softmpm.Inputs(**{name: kept[name] for name in WALLS})
    return kept["activation"], softmpm.Params(*(kept[name] for name in softmpm.Params._fields)), inputs


@pytest.mark.parametrize("dim", [2, 3])
def test_tape_gives_the_bits_of_simulate(dim, device):
    """Points that stick, slide and fly, walls that slide, a muscle, viscosity, two worlds: the end and the gradient of the state to the
    bit, those of the inputs to rounding, because their sums over nodes and substeps are taken in another order.
    """
    model = build(block(dim), device=device, dtype=torch.float64, worlds=2, inputs=WALLS)
    leaves = leaves_of(model)
    activation, params, inputs = arguments(leaves, grad=False)
    start = softmpm.State(*(leaves[name].detach() for name in "xvCF"))
    solid = softmpm.warp_solid(model, params, activation[0], inputs, requires_grad=True)
    states = [softmpm.warp_state(model, start, solid, requires_grad=True)]
    states += [softmpm.warp_state(model, requires_grad=True) for _ in range(STEPS)]

    nodes = states[0].nodal().clone()
    nodes = softmpm.Nodal(*(t.requires_grad_() for t in nodes[:4]), nodes.shift)
    start = particles_of(model, nodes)
    drive, material, walls = arguments(leaves, grad=True)
    end = softmpm.simulate(model, start, drive, material, substeps=STEPS, inputs=walls)
    generator = torch.Generator().manual_seed(5)
    weights = [torch.randn(t.shape, generator=generator, dtype=torch.float64).to(t) for t in end.nodes[:3]]
    loss = sum((w * t).sum() for w, t in zip(weights, end.nodes[:3], strict=True))
    names = ("density", "activation", "friction", "wall_velocity")
    want = torch.autograd.grad(loss, [*nodes[:3], *(leaves[name] for name in names)])

    tape = wp.Tape()
    for s in range(STEPS):
        softmpm.step(model, states[s], states[s + 1], solid, substep=s, tape=tape)
    solid.raise_failure(model, states[-1])
    arrays, vec = states[-1].differentiable(), types(dim, "float64").vec
    tape.backward(grads={a: wp.from_torch(w, dtype=vec) for a, w in zip(arrays, weights, strict=False)})
    found = softmpm.torch_state(model, states[-1])
    for name, got, there in zip("xvCF", found[:4], end[:4], strict=True):
        assert torch.equal(got, there), name
    for name, got, there in zip(("u", "v", "anchor"), states[0].adj(), want, strict=False):
        assert there.abs().max() > 0 and torch.equal(got, there), name
    grads = [solid.mass, solid.active_stress, solid.others["friction"], solid.others["surface_velocity"]]
    mass, stress, *others = (wp.to_torch(array.grad) for array in grads)
    inputs_found = (mass * model.volume / model.mass_unit, (stress * model.strength)[None], *others)
    for name, got, there in zip(names, inputs_found, want[3:], strict=True):
        assert there.abs().max() > 0, f"the test does not exercise {name}"
        assert_relative(got.view_as(there), there, 1e-12, name)
    tape.zero()
    assert all((array.grad.numpy() == 0).all() for array in (*states[0].differentiable(), solid.mass))


def test_arrays_that_warp_writes_into_are_read(device):
    """A step reads what a Warp kernel or copy has written since the previous one, the particles' inputs too."""
    model = build(block(2), device=device, dtype=torch.float64)
    params = model.params()
    twice = params._replace(density=2.0 * params.density, young=3.0 * params.young)
    solid, other = softmpm.warp_solid(model), softmpm.warp_solid(model, twice)
    a, b, c = (softmpm.warp_state(model) for _ in range(3))
    softmpm.step(model, a, b, solid)
    for name, array in solid.arrays().items():
        wp.copy(array, other.arrays()[name])
    wp.copy(a.v, b.v)
    softmpm.step(model, a, b, solid)
    softmpm.step(model, a, c, other)
    assert torch.equal(b.nodal().v, c.nodal().v) and b.nodal().v.abs().max() > 0


def test_a_failure_names_its_substep():
    """A world that collapses in the third step is reported by that number and stays as it is; the other one goes on."""
    made = dataclasses.replace(block(2), gravity=None, walls=[])
    model = softmpm.build(made, device="cpu", dtype=torch.float64, worlds=2, formulation="reference")
    start = model.rest()
    start.C[1] = -500.0 * torch.eye(2, dtype=torch.float64)
    start.v[1] = -500.0 * (start.x[1] - start.x[1].mean(0))
    with pytest.raises(softmpm.UnstableError) as caught:
        softmpm.simulate(model, start, None, model.params(), substeps=20)
    want = caught.value
    solid = softmpm.warp_solid(model)
    states = [softmpm.warp_state(model, start), softmpm.warp_state(model)]
    for s in range(20):
        softmpm.step(model, *states, solid, substep=s)
        states.reverse()
        if s == want.substep:
            stopped = states[0].nodal().clone()
    with pytest.raises(softmpm.UnstableError) as caught:
        solid.raise_failure(model, states[0])
    assert (caught.value.kind, caught.value.world, caught.value.substep) == (want.kind, 1, want.substep)
    assert want.substep > 0
    assert torch.equal(states[0].nodal().u[1], stopped.u[1])


def test_what_a_step_cannot_do_is_refused(monkeypatch):
    """States of the other formulation, one state twice, arrays of another shape, and a capture: its replays would write into memory
    that others use by then.
    """
    moving = softmpm.build(block(2), device="cpu")
    model = build(block(2))
    solid, state = softmpm.warp_solid(model), softmpm.warp_state(model)
    with pytest.raises(TypeError, match="state_in must be a softmpm.WarpNodal, .* got WarpState"):
        softmpm.step(model, softmpm.warp_state(moving), state, solid)
    with pytest.raises(TypeError, match="state must be a softmpm.WarpState, .* got WarpNodal"):
        softmpm.torch_state(moving, state)
    with pytest.raises(ValueError, match="two different states"):
        softmpm.step(model, state, state, solid)
    monkeypatch.setattr(nodal_step, "is_capturing", lambda model: True)
    with pytest.raises(RuntimeError, match="cannot be captured in a CUDA graph"):
        softmpm.step(model, state, softmpm.warp_state(model), solid)
    with pytest.raises(ValueError, match=r"u must be .* got \(1, 4, 2\) of float32"):
        dataclasses.replace(state, u=state.v[:, :4])
