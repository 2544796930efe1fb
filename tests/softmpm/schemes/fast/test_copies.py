"""Chunk graphs that serve one chunk after the other: states are copied for the backward pass, and calls of a recording share graphs."""

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from helpers import assert_relative, bar, busy_inputs, busy_scene, cotangent, dot, run

import softmpm
from softmpm import autograd, rollout, runner
from softmpm.schemes import capture, graph_cache
from softmpm.schemes.fast import chunk_buffers
from softmpm.schemes.fast import scheme as fast_scheme
from softmpm.schemes.fast.footprint import COPIED, MANY_CALLS, copies

WALL = softmpm.Wall(normal=(0.1, 1.0), offset=0.47, contact="separate", friction=0.4)
SCENES = {
    "surface points on a belt, and forces": (
        lambda: bar(walls=[WALL], gravity=(0.3, -9.8)),
        ("wall_velocity", "force"),
    ),
    "3D": (lambda: busy_scene(3), ()),
}
"""Scenes, with the inputs of their calls."""


@pytest.fixture
def made(monkeypatch) -> list[bool]:
    """Chunk graphs that are made, each with whether it stores its states."""
    graphs = []

    class Noted(fast_scheme.ChunkGraph):
        def __init__(self, model, layout, chunk, keep):
            super().__init__(model, layout, chunk, keep)
            graphs.append(keep)

    monkeypatch.setattr(fast_scheme, "ChunkGraph", Noted)
    return graphs


def loop(model: softmpm.Model, calls: int, substeps: int) -> Callable[[], list[torch.Tensor]]:
    """Function that makes so many calls one after another, on tensors that exist: their end, and their gradient twice."""
    v = (model.rest().v + 0.1).requires_grad_()
    params = softmpm.Params(*(value.clone().requires_grad_() for value in model.params()))
    shape = (calls, 2, model.worlds, model.muscle_count)
    activation = (0.3 * torch.sin(torch.arange(torch.Size(shape).numel()).view(shape))).to(v).requires_grad_()
    inputs, weights = None, cotangent(model.rest())
    if "force" in model.spec.given:
        belt = v.new_tensor([0.2, 0.01]) * torch.arange(1.0, 3.0, device=v.device).view(2, 1, 1, 1)
        force = torch.full((2, 1, model.particle_count, model.dim), 1e-5).to(v).requires_grad_()
        inputs = softmpm.Inputs(wall_velocity=belt.requires_grad_(), force=force)
    leaves = [v, activation, *params, *(value for value in inputs or () if value is not None)]

    def work() -> list[torch.Tensor]:
        end = model.rest()._replace(v=v)
        for row in activation:
            end = softmpm.simulate(model, end, row, params, substeps=substeps, inputs=inputs)
        loss = dot(weights, end)
        first = torch.autograd.grad(loss, leaves, retain_graph=True)
        return [*(part.detach() for part in end[:4]), *first, *torch.autograd.grad(loss, leaves)]

    return work


@pytest.mark.parametrize("calls, substeps", [(10, 9), (4, 70)], ids=["one chunk a call", "two"])
@pytest.mark.parametrize("scene, inputs", SCENES.values(), ids=SCENES)
def test_copied_states_change_no_bit(scene, inputs, calls, substeps, made, monkeypatch):
    """A few calls and their gradient, twice, on a few chunk graphs instead of one for each chunk."""
    model = softmpm.build(scene(), device="cpu", calls=calls, inputs=inputs)
    assert not copies(model)
    want, count = loop(model, calls, substeps)(), made.count(True)
    assert count > 5
    made.clear()
    monkeypatch.setattr(fast_scheme, "copies", lambda model: True)
    model = softmpm.build(scene(), device="cpu", calls=calls, inputs=inputs)
    for got, one in zip(loop(model, calls, substeps)(), want, strict=True):
        assert torch.equal(got, one)
    assert made.count(True) <= 4


@pytest.mark.gpu
@pytest.mark.parametrize("scene, inputs", SCENES.values(), ids=SCENES)
def test_a_loop_on_a_gpu_copies_its_states(scene, inputs, made):
    """Ten declared calls, by themselves, captured and replayed, as the same calls undeclared, but for rounding."""
    about = dict(device="cuda", dtype=torch.float64, inputs=inputs)
    want = loop(softmpm.build(scene(), **about), 10, 9)()
    assert made.count(True) >= 10
    made.clear()
    model = softmpm.build(scene(), calls=10, **about)
    assert copies(model)
    work = loop(model, 10, 9)
    graph = softmpm.Graph(work, model.device)
    for found in (work(), *(graph() for _ in range(4))):
        for got, one in zip(found, want, strict=True):
            assert_relative(got, one, 1e-9)
    assert made.count(True) <= 8  # for either stream at most four, and none for a capture


@pytest.mark.parametrize(
    "device, particles, calls, deterministic, copied",
    [
        ("cuda", COPIED, MANY_CALLS, False, True),
        ("cuda", COPIED + 1, MANY_CALLS, False, False),
        ("cuda", COPIED, MANY_CALLS - 1, False, False),
        ("cuda", COPIED, MANY_CALLS, True, False),
        ("cpu", COPIED, MANY_CALLS, False, False),
    ],
)
def test_where_states_are_copied(device, particles, calls, deterministic, copied):
    """In loops of many calls of small scenes on a GPU, and not in a deterministic model."""
    spec = SimpleNamespace(deterministic=deterministic)
    model = SimpleNamespace(
        device=torch.device(device), worlds=2, particle_count=(particles + 1) // 2, calls=calls, spec=spec
    )
    assert copies(model) is copied


def test_calls_of_a_recording_share_chunk_graphs(made, monkeypatch):
    """Calls without a gradient need as few as outside of it, and what a recording has taken is not given to later calls."""
    model = softmpm.build(busy_scene(2), device="cpu")
    inputs = busy_inputs(model)
    with torch.no_grad():
        want = run(softmpm.simulate, model, inputs, 5)
        count = len(made)
        for module in (autograd, fast_scheme, chunk_buffers, rollout, runner, graph_cache):
            monkeypatch.setattr(module, "is_capturing", lambda model: True)
        with capture.collected_resources() as resources:
            for _ in range(4):
                found = run(softmpm.simulate, model, inputs, 5)
                assert all(torch.equal(a, b) for a, b in zip(found[:4], want[:4], strict=True))
        assert len(made) == count
        monkeypatch.undo()
        run(softmpm.simulate, model, inputs, 5)
    pool = fast_scheme.Fast.of(model)._pool
    assert pool is not None
    taken = {id(one.graph) for free in resources.made.values() for one in free}
    left = {id(one.graph) for free in pool._free[False].values() for one in free}
    assert taken and left and not taken & left


def test_a_recording_has_the_shared_buffers_of_its_backward_passes_to_itself(made, monkeypatch):
    """Those of a call before it are its own then, and a call after it gets others, with the same gradient."""
    model = softmpm.build(busy_scene(2), device="cpu")
    inputs = busy_inputs(model)

    def gradient() -> torch.Tensor:
        end = run(softmpm.simulate, model, inputs, 5)
        return torch.autograd.grad(dot(cotangent(end), end), inputs["v"])[0]

    want, pool = gradient(), fast_scheme.Fast.of(model)._pool
    assert pool is not None
    (before,) = pool._shared_adjoints.values()
    patched = pytest.MonkeyPatch()
    for module in (autograd, fast_scheme, chunk_buffers, rollout, runner, graph_cache):
        patched.setattr(module, "is_capturing", lambda model: True)
    with capture.collected_resources() as resources:
        assert torch.equal(gradient(), want) and torch.equal(gradient(), want)
    patched.undo()
    assert any(one is before for one in resources.made.values()) and not pool._shared_adjoints
    assert torch.equal(gradient(), want)
    (after,) = pool._shared_adjoints.values()
    assert after is not before
