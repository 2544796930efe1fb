"""The same gradients through ``step`` on a ``wp.Tape`` as through ``simulate``."""

import math

import pytest
import torch
import warp as wp
from helpers import assert_relative, busy_inputs, busy_scene, cotangent, dot, run

import softmpm
from softmpm.kernels.structs import types
from softmpm.schemes.plain import substep


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype, limit", [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_tape_gives_the_gradients_of_simulate(dim, dtype, limit, device):
    """Start, material and activation, over 5 substeps, two worlds."""
    alarms = softmpm.Alarms(gap=None)  # the start is random
    model = softmpm.build(busy_scene(dim, per_law=6), device=device, dtype=dtype, worlds=2, alarms=alarms)
    inputs, t, dx = busy_inputs(model, control_steps=1), types(dim, str(dtype)[6:]), model.scene.grid.spacing
    mu, lam = (term.detach().requires_grad_() for term in lame(inputs))
    by_lame = inputs | {"young": mu * (2 + lam / (lam + mu)), "poisson": lam / (2 * (lam + mu))}
    mass = inputs["density"] * model.specific_volume
    end = run(softmpm.simulate, model, by_lame, 5)
    leaves = {name: inputs[name] for name in ("x", "v", "C", "F", "activation", "density")} | {
        "mu": mu,
        "lam": lam,
    }
    want = dict(
        zip(leaves, torch.autograd.grad(dot(cotangent(end), end), list(leaves.values())), strict=True)
    )

    start = softmpm.State(*(inputs[name].detach() for name in "xvCF"))
    params = softmpm.Params(
        by_lame["young"].detach(), by_lame["poisson"].detach(), inputs["density"].detach()
    )
    solid = softmpm.warp_solid(model, params, inputs["activation"][0].detach(), requires_grad=True)
    states = [softmpm.warp_state(model, start, requires_grad=True)]
    states += [softmpm.warp_state(model, requires_grad=True) for _ in range(5)]
    tape = wp.Tape()
    for s in range(5):
        softmpm.step(model, states[s], states[s + 1], solid, substep=s, tape=tape)
    weights = cotangent(start)
    cotangents = {states[-1].fx: (weights.x * dx, t.vec), states[-1].v: (weights.v, t.vec)}
    cotangents |= {states[-1].C: (weights.C, t.mat), states[-1].H: (weights.F, t.mat)}
    tape.backward(
        grads={array: wp.from_torch(g.contiguous(), dtype=d) for array, (g, d) in cotangents.items()}
    )

    got = {name: wp.to_torch(getattr(states[0], name).grad) for name in ("v", "C")}
    got |= {"x": wp.to_torch(states[0].fx.grad) / dx, "F": wp.to_torch(states[0].H.grad)}
    got |= {"mu": wp.to_torch(solid.mu.grad), "lam": wp.to_torch(solid.lam.grad)}
    got |= {"density": wp.to_torch(solid.mass.grad) * mass / inputs["density"]}
    got |= {"activation": (wp.to_torch(solid.active_stress.grad) * model.strength)[None]}
    for name, gradient in got.items():
        assert_relative(gradient, want[name], limit, name)
    solid.raise_failure(model, states[-1])

    tape.zero()
    assert all((array.grad.numpy() == 0).all() for array in states[0].differentiable())


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_a_gradient_that_is_not_finite_is_named_and_stops_nothing(formulation):
    """World, particle and the substep that the backward pass met first; afterwards steps go on, and a finite gradient is none."""
    model = softmpm.build(busy_scene(2), worlds=2, device="cpu", formulation=formulation)
    solid = softmpm.warp_solid(model, requires_grad=True)
    states = [softmpm.warp_state(model, requires_grad=True) for _ in range(4)]
    for bad in (True, False):
        tape = wp.Tape()
        for s in range(2):
            softmpm.step(model, states[s], states[s + 1], solid, substep=s, tape=tape)
        tape.zero()
        wp.to_torch(states[2].v.grad)[1] = math.nan if bad else 1.0
        tape.backward()
        if bad:
            with pytest.raises(
                softmpm.UnstableError, match=r"of world 1 .* not finite at substep 1; .*the loss"
            ) as error:
                solid.raise_failure(model, states[2])
            assert (error.value.kind, error.value.world, error.value.substep) == ("gradient", 1, 1)
        solid.raise_failure(model, states[2])
    softmpm.step(model, states[2], states[3], solid, substep=2)
    moved = (wp.to_torch(states[3].v) != wp.to_torch(states[2].v)).flatten(1).any(1)
    assert moved.tolist() == [True, True]


def lame(inputs):
    young, poisson = inputs["young"], inputs["poisson"]
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def test_gradients_add_up_with_other_users_of_the_arrays():
    """A Warp loss kernel on the same tape, and a state used twice: contributions are added, not overwritten."""
    model = softmpm.build(busy_scene(2, per_law=4), device="cpu", dtype=torch.float64)
    solid = softmpm.warp_solid(model, requires_grad=True)
    a, b, c = (softmpm.warp_state(model, requires_grad=True) for _ in range(3))
    tape = wp.Tape()
    softmpm.step(model, a, b, solid, tape=tape)
    softmpm.step(model, a, c, solid, tape=tape)
    ones = wp.from_torch(torch.ones_like(wp.to_torch(b.v)), dtype=types(2, "float64").vec)
    tape.backward(grads={b.v: ones})
    once = wp.to_torch(a.v.grad).clone()
    tape.zero()
    tape.backward(grads={b.v: ones, c.v: ones})
    torch.testing.assert_close(wp.to_torch(a.v.grad), 2 * once, rtol=1e-14, atol=0)


@pytest.mark.parametrize("formulation", ["moving", "reference"])
@pytest.mark.parametrize("name", ["active_stress", "lam", "gravity"])
def test_a_solid_that_is_written_between_steps_is_named(formulation, name):
    """The adjoint of the first step would read the values of the second; even those in another order are seen."""
    model = softmpm.build(
        busy_scene(2, per_law=4),
        device="cpu",
        dtype=torch.float64,
        formulation=formulation,
        inputs=("gravity",),
    )
    rows = torch.tensor([[[0.3, 0.1]], [[0.1, 0.3]]], dtype=torch.float64)
    solids = [softmpm.warp_solid(model, None, row, requires_grad=True) for row in rows]
    states = [softmpm.warp_state(model, requires_grad=True) for _ in range(3)]
    tape = wp.Tape()
    softmpm.step(model, *states[:2], solids[0], tape=tape)
    softmpm.step(model, *states[1:], solids[1], tape=tape)
    ones = wp.from_torch(torch.ones_like(wp.to_torch(states[2].v)), dtype=types(2, "float64").vec)
    tape.backward(grads={states[2].v: ones})
    array = wp.to_torch(solids[0].arrays()[name], requires_grad=False)
    array.copy_(array.flatten().flip(0).view_as(array) if name == "active_stress" else 1.01 * array)
    with pytest.raises(RuntimeError, match=f"^{name} of a WarpSolid was written after a step"):
        tape.backward(grads={states[2].v: ones})


def test_step_refuses_what_cannot_work():
    """One state twice; a tape without gradients."""
    model = softmpm.build(busy_scene(2, per_law=4), device="cpu")
    solid, state = softmpm.warp_solid(model), softmpm.warp_state(model)
    with pytest.raises(ValueError, match="two different states"):
        softmpm.step(model, state, state, solid)
    with pytest.raises(ValueError, match="requires_grad=True"):
        softmpm.step(model, state, softmpm.warp_state(model), solid, tape=wp.Tape())


def test_step_advances_like_simulate(device):
    """One step equals one substep, and torch_state reads it back."""
    model = softmpm.build(busy_scene(3), device=device, dtype=torch.float64)
    start = model.rest()
    want = softmpm.simulate(model, start, None, model.params(), substeps=1)
    first, second = softmpm.warp_state(model, start), softmpm.warp_state(model)
    softmpm.step(model, first, second, softmpm.warp_solid(model))
    for name in "xvCF":
        torch.testing.assert_close(
            getattr(softmpm.torch_state(model, second), name), getattr(want, name), rtol=0, atol=1e-13
        )


def test_the_adjoint_runs_where_pytorch_works_by_then(monkeypatch):
    """The backward pass of a tape runs on the current stream, as in PyTorch, which need not be that of the steps."""
    model, current, used = softmpm.build(busy_scene(2), device="cpu"), [None], []
    states = [softmpm.warp_state(model, requires_grad=True) for _ in range(2)]
    solid, tape = softmpm.warp_solid(model, requires_grad=True), wp.Tape()
    launch = substep.Substep.launch

    def watched(self, *arguments):
        used.append(self.stream)
        self.stream = None
        launch(self, *arguments)
        self.stream = used[-1]

    monkeypatch.setattr(substep.Substep, "launch", watched)
    for module in (substep, softmpm.warp_api, softmpm.warp_arrays):
        monkeypatch.setattr(module, "stream_of", lambda device: current[0])
    for stream, work in (
        ("one", lambda: softmpm.step(model, *states, solid, tape=tape)),
        ("another", lambda: tape.backward(grads={states[1].v: wp.ones_like(states[1].v)})),
        ("a third", lambda: solid.raise_failure(model, states[1])),
    ):
        current[0] = stream
        used.clear()
        work()
        assert used and set(used) == {stream}
