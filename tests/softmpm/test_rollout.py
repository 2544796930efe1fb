"""Whole rollouts against the float64 oracle, finite differences and themselves."""

import dataclasses
import itertools
import math

import pytest
import torch
from helpers import INPUTS, LAWS, assert_relative, busy_inputs, busy_scene, cotangent, dot, gradients, run

import softmpm
from softmpm.oracle import moving
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import plan


@pytest.mark.parametrize("laws", [("neo_hookean",), ("fixed_corotated",), tuple(LAWS)])
@pytest.mark.parametrize("dim", [2, 3])
def test_state_and_every_gradient_are_the_references(dim, laws, device, scheme):
    """Contact, friction, overlapping muscles, damping, two worlds, two control steps: ≤ 1e-10 for each input."""
    scene = busy_scene(dim, laws)
    model = softmpm.build(scene, device=device, dtype=torch.float64, scheme=scheme, worlds=2)
    inputs = busy_inputs(model)
    copies = {name: tensor.detach().cpu().requires_grad_() for name, tensor in inputs.items()}
    got, want = run(softmpm.simulate, model, inputs, 10), run(moving.simulate, scene, copies, 10)
    for name, a, b in zip("xvCF", got[:4], want[:4], strict=True):
        assert_relative(a.cpu(), b, 1e-12, name)
    weights = cotangent(want)
    found = gradients(softmpm.simulate, model, inputs, 10, weights.to(model.device))
    wanted = gradients(moving.simulate, scene, copies, 10, weights)
    for name in INPUTS:
        assert wanted[name].abs().max() > 0, f"the test does not exercise {name}"
        assert_relative(found[name].cpu(), wanted[name], 1e-10, name)


def out_of_reach(dim: int) -> softmpm.Wall:
    """The second wall of ``busy_scene`` in a corner of the grid: the kernels are those of that scene, and nothing meets the wall."""
    return dataclasses.replace(busy_scene(dim).walls[1], offset=-1.04)


def special_start(model, kind: str) -> dict[str, torch.Tensor]:
    """Inputs at which adjoints are commonly wrong."""
    inputs = {name: tensor.detach() for name, tensor in busy_inputs(model, control_steps=1).items()}
    dim, rest = model.dim, model.rest()
    eye = rest.F
    angle = torch.tensor(0.8, dtype=torch.float64)
    turn = torch.eye(dim, dtype=torch.float64)
    turn[:2, :2] = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).view(2, 2)
    if kind == "rest":
        inputs |= {"F": eye, "C": 0 * eye, "v": 0 * rest.v}
    elif kind == "rotation":
        inputs |= {"F": turn @ eye}
    elif kind == "equal stretches":
        inputs |= {"F": turn @ (eye * torch.tensor([1.2, 1.2, 0.9][:dim], dtype=torch.float64))}
    elif kind == "inverted":
        inputs |= {"F": turn @ (eye * torch.tensor([0.9, -0.4, 1.1][:dim], dtype=torch.float64))}
    elif kind == "still under friction":
        inputs |= {"v": 0 * rest.v, "C": 0 * eye, "F": eye}
        inputs["x"][..., 1] -= inputs["x"][..., 1].min() - 0.35
    elif kind == "cell edge":
        inputs |= {"x": (rest.x / 0.1).round() * 0.1 + 0.05}
    elif kind == "no activation":
        inputs |= {"activation": 0 * inputs["activation"]}
    return {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}


POINTS = (
    "rest",
    "rotation",
    "equal stretches",
    "inverted",
    "still under friction",
    "cell edge",
    "no activation",
)


@pytest.mark.parametrize(
    "law, kind",
    # The other laws are undefined where det F < 0: tests/softmpm/test_errors.py has the error.
    [(law, kind) for law in LAWS for kind in POINTS if kind != "inverted" or law == "fixed_corotated"],
)
@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_at_special_points(dim, law, kind, device, scheme):
    """F = I, rotations, equal stretches, det F < 0, friction at rest, cell edges, zero activation: ≤ 1e-10 each."""
    still = kind == "still under friction"
    gravity = (0.0, -9.8, 0.0)[:dim] if still else (0.3, -9.8, 0.2)[:dim]
    floor, side = busy_scene(dim).walls
    walls = [floor, out_of_reach(dim) if still else side]
    scene = busy_scene(dim, (law,), per_law=8, gravity=gravity, walls=walls)
    off = {"inverted": {"collapse": None}, "cell edge": {"gap": None}}
    alarms = softmpm.Alarms(**off.get(kind, {}))
    model = softmpm.build(scene, device=device, dtype=torch.float64, scheme=scheme, alarms=alarms)
    inputs = special_start(softmpm.build(scene, device="cpu", dtype=torch.float64), kind)
    there = {name: tensor.detach().to(model.device).requires_grad_() for name, tensor in inputs.items()}
    weights = cotangent(softmpm.State(*(inputs[n] for n in "xvCF")))
    want = gradients(moving.simulate, scene, inputs, 3, weights)
    got = gradients(softmpm.simulate, model, there, 3, weights.to(model.device))
    for name in INPUTS:
        assert torch.isfinite(want[name]).all() and want[name].abs().max() > 0, name
        assert_relative(got[name].cpu(), want[name], 1e-10, name)


def sliding_scene(dim: int) -> softmpm.Scene:
    """A block of two materials and two muscles that slides on a rough floor: contact without chatter. Features of ``busy_scene``."""
    count, h = (6, 4, 2)[:dim], 0.05
    lattice = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in count)).numpy()
    halves = [lattice[lattice[:, 0] < 3], lattice[lattice[:, 0] >= 3]]
    bodies = [
        softmpm.Body(softmpm.Particles(half * h + 0.4, h**dim), law(density=1.2, young=80.0, poisson=0.3))
        for half, law in zip(halves, (softmpm.NeoHookean, softmpm.FixedCorotated), strict=True)
    ]
    every = torch.arange(len(lattice)).numpy()
    up = (0.0, 1.0) + (0.0,) * (dim - 2)
    return softmpm.Scene(
        grid=softmpm.Grid(shape=(16, 12, 12)[:dim], spacing=0.1),
        bodies=bodies,
        muscles=[
            softmpm.Muscle(particles=every[: len(every) * 2 // 3], direction=up, strength=5.0),
            softmpm.Muscle(particles=every[len(every) // 3 :], direction=(1.0, 0.5, 0.2)[:dim], strength=4.0),
        ],
        walls=[softmpm.Wall(normal=up, offset=0.31, friction=0.2), out_of_reach(dim)],
        gravity=(0.0, -9.8, 0.0)[:dim],
        damping=0.7,
        dt=5e-4,
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_taylor_remainder_is_second_order(dim, device, scheme):
    """|L(θ + εd) − L(θ) − ε ⟨∇L, d⟩| falls with slope 1.95 to 2.05 over 100 substeps, for each input alone."""
    model = softmpm.build(sliding_scene(dim), device=device, dtype=torch.float64, scheme=scheme)
    inputs = busy_inputs(model)
    rest, away = model.rest(), torch.tensor([2.0, -0.3, 0.1][:dim], dtype=torch.float64, device=model.device)
    inputs |= {
        "x": rest.x,
        "v": rest.v + away,
        "C": rest.C,
        "F": rest.F + 0.1 * (inputs["F"].detach() - rest.F),
    }
    inputs = {name: tensor.detach().requires_grad_() for name, tensor in inputs.items()}
    weights = cotangent(softmpm.State(*(inputs[n] for n in "xvCF")))
    gradient = gradients(softmpm.simulate, model, inputs, 50, weights)

    def loss(changed):
        with torch.no_grad():
            return dot(weights, run(softmpm.simulate, model, changed, 50)).item()

    here, generator = loss(inputs), torch.Generator().manual_seed(7)
    for name in INPUTS:
        d = torch.randn(inputs[name].shape, generator=generator, dtype=torch.float64).to(model.device)
        d *= {"x": 0.1, "C": 5.0, "F": 0.1, "young": 80.0}.get(name, 1.0)
        remainders = []
        for step in STEPS:
            ahead = loss(inputs | {name: inputs[name].detach() + step * d})
            remainders.append(abs(ahead - here - step * (gradient[name] * d).sum().item()))
        rates = [math.log2(a / b) for a, b in itertools.pairwise(remainders)]
        assert all(1.95 <= rate <= 2.05 for rate in rates), (name, rates, remainders)


STEPS = (2.0**-13, 2.0**-14, 2.0**-15)  # below the distance to the next kink of contact and spline


def test_dot_product(device, scheme):
    """⟨J a, b⟩ = ⟨a, Jᵀ b⟩ with J a from the oracle by differentiating its backward pass: ≤ 1e-12."""
    scene = busy_scene(2)
    model = softmpm.build(scene, device=device, dtype=torch.float64, scheme=scheme)
    inputs = busy_inputs(model)
    copies = {name: tensor.detach().cpu().requires_grad_() for name, tensor in inputs.items()}
    end = run(moving.simulate, scene, copies, 5)
    b = cotangent(end, seed=11)
    a = {
        n: torch.randn(t.shape, generator=torch.Generator().manual_seed(12), dtype=torch.float64)
        for n, t in copies.items()
    }
    dual = [torch.zeros_like(t, requires_grad=True) for t in end[:4]]
    pulled = torch.autograd.grad(dot(dual, end), list(copies.values()), create_graph=True)
    pushed = torch.autograd.grad(dot(list(a.values()), pulled), dual)  # J a: linear in the dual
    want = dot(pushed, b)
    back = gradients(softmpm.simulate, model, inputs, 5, b.to(model.device))
    got = sum((a[name] * back[name].cpu()).sum() for name in INPUTS)
    assert abs(got - want) <= 1e-12 * sum((a[name] * back[name].cpu()).abs().sum() for name in INPUTS)


def test_worlds_are_single_runs(device, scheme):
    """Three worlds with their own start, activation and material equal three runs of one: end and gradients."""
    scene = busy_scene(2)
    models = {
        n: softmpm.build(scene, device=device, dtype=torch.float64, scheme=scheme, worlds=n) for n in (1, 3)
    }
    inputs = busy_inputs(models[3])
    together = gradients(softmpm.simulate, models[3], inputs, 6)
    weights = cotangent(run(softmpm.simulate, models[3], inputs, 6))
    for world in range(3):

        def alone(name, tensor, world=world):
            part = tensor[:, world : world + 1] if name == "activation" else tensor[world : world + 1]
            return part.detach().clone().requires_grad_()

        single = {name: alone(name, tensor) for name, tensor in inputs.items()}
        found = gradients(softmpm.simulate, models[1], single, 6, [w[world : world + 1] for w in weights[:4]])
        for name in INPUTS:
            assert_relative(
                alone(name, together[name]).detach(), found[name], 1e-13, f"world {world}, {name}"
            )


def test_recomputing_gives_the_gradient_of_keeping_everything(scheme):
    """Whatever the memory budget, the same gradient but for rounding between chunks: everything, √N, and hardly anything.

    In double precision, where rounding cannot be taken for a chunk that was lost.
    """
    scene, found, plans = busy_scene(2), [], []
    settings = dict(device="cpu", scheme=scheme, dtype=torch.float64)
    sizes = softmpm.build(scene, **settings).sizes()
    least = 2 * (sizes.inside + sizes.between) + sizes.nodes
    for budget in (1000 * least, 6 * least, least + 2 * sizes.between):
        model = softmpm.build(scene, memory_budget=budget, **settings)
        plans.append(plan(Horizon(4, 14), model.sizes(), model.budget))
        found.append(gradients(softmpm.simulate, model, busy_inputs(model, control_steps=4), substeps=14))
    assert plans[0].keep_all and plans[1].longest > plans[2].longest
    assert (
        1 < plans[2].checkpoints < len(Horizon(4, 14).chunks(plans[2].longest)) / 2
    )  # chunks run more than twice
    for name, others in itertools.product(INPUTS, found[1:]):
        assert_relative(found[0][name], others[name], 1e-12, name)


def test_a_budget_that_is_too_small_says_what_it_needs():
    """Not even √N states fit: the message has both sizes and a way out."""
    scene = busy_scene(2)
    model = softmpm.build(scene, device="cpu", memory_budget=1000)
    with pytest.raises(
        ValueError, match=r"needs at least [\d,]+ bytes for states, memory_budget is 1,000 bytes"
    ):
        gradients(softmpm.simulate, model, busy_inputs(model), substeps=50)
