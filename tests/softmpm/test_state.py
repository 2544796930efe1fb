"""A state keeps its low-order parts through everything that a caller does with a named tuple."""

import copy
import pickle

import numpy as np
import pytest
import torch
from torch.utils import _pytree

import softmpm

TENSORS = ("x", "v", "C", "F")


def test_float64_has_room_for_the_remainders(model, moved):
    """``to`` adds them; a float64 model goes on where a float32 one was, with its energy to rounding."""
    double = softmpm.build(model.scene, device="cpu", dtype=torch.float64)
    exact, cut = moved.to(torch.float64), moved._replace(low=None).to(torch.float64)
    assert exact.low is None and moved.low is not None and moved.to("cpu").low is not None
    assert torch.equal(exact.x, moved.x.double() + moved.low.x.double()) and not torch.equal(exact.x, cut.x)
    assert torch.equal(exact.F, moved.F.double() + moved.low.F.double())
    want = softmpm.simulate(model, moved, None, model.params(), substeps=5)
    got = softmpm.simulate(double, exact, None, double.params(), substeps=5)
    torch.testing.assert_close(got.x, want.x.double() + want.low.x.double(), rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def model():
    """Eight free particles."""
    positions = np.stack(np.meshgrid([0.4, 0.45], [0.4, 0.45, 0.5, 0.55]), -1).reshape(-1, 2)
    body = softmpm.Body(softmpm.Particles(positions, 0.0025), softmpm.NeoHookean(density=1.0, young=10.0))
    scene = softmpm.Scene(grid=softmpm.Grid(shape=(12, 12), spacing=0.1), bodies=[body], dt=1e-3)
    return softmpm.build(scene, device="cpu")


@pytest.fixture
def moved(model) -> softmpm.State:
    """A state with low-order parts that are not zero."""
    rest = model.rest()
    end = softmpm.simulate(model, rest._replace(v=rest.v + 1e-3), None, model.params(), substeps=7)
    assert end.low is not None and end.low.x.abs().max() > 0
    return end


def assert_same(got: softmpm.State, want: softmpm.State) -> None:
    assert isinstance(got, softmpm.State) and isinstance(got.low, softmpm.Low)
    for a, b in zip((*got[:4], *got.low), (*want[:4], *want.low), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    "change",
    [
        lambda s: softmpm.State(*s),
        lambda s: s._replace(v=s.v.clone()),
        lambda s: softmpm.State(**s._asdict()),
        lambda s: softmpm.State(*(part.detach() for part in s[:5])),
        lambda s: s.detach(),
        lambda s: s.clone(),
        lambda s: s.to("cpu"),
        lambda s: pickle.loads(pickle.dumps(s)),
        copy.copy,
        copy.deepcopy,
        lambda s: _pytree.tree_map_only(torch.Tensor, torch.clone, s),
    ],
)
def test_low_order_parts_go_along(moved, change):
    """Through the constructor, iteration, _replace, pickle, copy and PyTorch's trees: the same bits."""
    assert_same(change(moved), moved)


def test_detach_clone_and_to(moved):
    """As those of a tensor: without history, differentiable, and in another precision. The low-order parts go along, in float64 in
    x and F."""
    start = moved._replace(x=moved.x.requires_grad_())
    assert not start.detach().x.requires_grad and start.detach().x.data_ptr() == start.x.data_ptr()
    copied = start.clone()
    assert copied.x.requires_grad and copied.low is not None and moved.low is not None
    assert copied.low.F.data_ptr() != moved.low.F.data_ptr()
    leaves = _pytree.tree_leaves(moved.to(torch.float64))
    assert all(leaf is None or leaf.dtype == torch.float64 for leaf in leaves) and len(leaves) == 7
    bare = moved._replace(low=None)
    assert bare.detach().low is bare.clone().low is bare.to(torch.float64).low is None


def test_small_motion_survives_many_calls(model):
    """400 calls of one substep at 1e-5 m/s, detached in between, move the block by 4e-6 m; without the low-order parts by 0."""
    state = model.rest()
    state = state._replace(v=state.v + 1e-5)
    bare = state._replace(low=None)
    for _ in range(400):
        state = softmpm.simulate(model, state, None, model.params(), substeps=1).detach()
        bare = softmpm.simulate(model, bare, None, model.params(), substeps=1)._replace(low=None)
    moved = (state.x.double() + state.low.x - model.rest().x.double() - model.rest().low.x).mean().item()
    assert moved == pytest.approx(4e-6, rel=2e-3)
    assert (bare.x - model.rest().x).abs().max() == 0


def test_a_gradient_passes_a_clone(model):
    """∂x_end/∂v through clone() is that without it, bitwise."""
    found = []
    for through in (lambda s: s, lambda s: s.clone()):
        start = model.rest()._replace(v=model.rest().v.requires_grad_())
        end = through(softmpm.simulate(model, through(start), None, model.params(), substeps=5))
        found.append(torch.autograd.grad(end.x.sum(), start.v)[0])
    assert torch.equal(*found)


def test_low_must_be_low_order_parts(model):
    """A tensor in its place is refused by name, as is a tuple in place of the state."""
    rest = model.rest()
    with pytest.raises(TypeError, match="state.low must be a softmpm.Low or None, got Tensor"):
        softmpm.simulate(model, rest._replace(low=rest.x), None, model.params(), substeps=1)
    with pytest.raises(TypeError, match="state must be a softmpm.State, got tuple"):
        softmpm.simulate(model, tuple(rest), None, model.params(), substeps=1)


def test_a_checkpoint_of_a_loop(moved, tmp_path):
    """``torch.load`` reads with ``weights_only=True``, its default, what ``torch.save`` wrote: every part, and nothing but tensors."""
    nodes = softmpm.Nodal(*(moved.v + k for k in range(4)))
    state = moved._replace(nodes=nodes, surface=softmpm.SurfaceState(moved.x, moved.v))
    content = {
        "state": state,
        "params": softmpm.Params(*moved.low, moved.x),
        "inputs": softmpm.Inputs(gravity=moved.v),
    }
    torch.save(content, tmp_path / "loop.pt")
    read = torch.load(tmp_path / "loop.pt", weights_only=True)
    assert_same(read["state"], state)
    assert {key: type(value) for key, value in read.items()} == {
        key: type(value) for key, value in content.items()
    }
    for got, want in zip(_pytree.tree_leaves(read), _pytree.tree_leaves(content), strict=True):
        assert got is want is None or torch.equal(got, want)


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_some_worlds_go_on_alone(formulation):
    """In a model of their own, with friction that adheres: the bits that they have among the others, and their gradient."""
    box = softmpm.box((0.3, 0.2), (0.5, 0.4), spacing=0.05)
    body = softmpm.Body(box, softmpm.NeoHookean(density=1.0, young=100.0, viscosity=0.2))
    floor = softmpm.Wall(normal=(0.0, 1.0), offset=0.2, friction=0.5)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(12, 12), spacing=0.1),
        bodies=[body],
        walls=[floor],
        gravity=(1.0, -9.8),
        dt=1e-3,
    )
    many, two = (softmpm.build(scene, device="cpu", worlds=n, formulation=formulation) for n in (4, 2))
    rest = many.rest()
    speed = torch.linspace(0.0, 0.3, 4).view(4, 1, 1).requires_grad_()
    params = many.params()
    state = softmpm.simulate(many, rest._replace(v=rest.v + speed), None, params, substeps=20)
    end = softmpm.simulate(many, state, None, params, substeps=20)
    for worlds in (slice(1, 4, 2), [1, 3], torch.tensor([False, True, False, True])):
        alone = softmpm.simulate(two, state.of_worlds(worlds), None, params, substeps=20)
        for got, want in zip(
            _pytree.tree_leaves(alone), _pytree.tree_leaves(end.of_worlds(worlds)), strict=True
        ):
            assert got is want is None or torch.equal(got, want)
    (slope,) = torch.autograd.grad(alone.x[..., 0].sum(), speed, retain_graph=True)
    (among,) = torch.autograd.grad(end.x[[1, 3], :, 0].sum(), speed)
    torch.testing.assert_close(slope, among)
    cut = softmpm.State(*(None if part is None else part[1:3] for part in state))
    with pytest.raises(TypeError, match=r"got tuple; state.of_worlds\(...\) takes some worlds"):
        softmpm.simulate(two, cut._replace(low=None), None, params, substeps=1)
