"""Chunk graphs that several calls share: stored states are copied for the backward pass, and calls of a capture use the same graphs."""

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from helpers import (
    assert_relative,
    bar,
    busy_inputs,
    busy_scene,
    cotangent,
    dot,
    little_memory,
    pretend_capture,
    run,
)

import softmpm
from softmpm.planning.chunks import Chunk, Horizon
from softmpm.planning.memory import memory
from softmpm.schemes import capture, launch
from softmpm.schemes.fast import chunk_buffers, footprint
from softmpm.schemes.fast import scheme as fast_scheme
from softmpm.schemes.fast.footprint import MANY_CALLS, SMALL, copies
from softmpm.schemes.fast.particle_order import ParticleLayout

WALL = softmpm.Wall(normal=(0.1, 1.0), offset=0.4752, contact="separate", friction=0.4)
SCENES = {
    "surface points on a floor that rises, and forces": (
        lambda: bar(walls=[WALL], gravity=(0.3, -9.8)),
        ("wall_offset", "force"),
    ),
    "3D": (lambda: busy_scene(3), ()),
}
"""Scenes, with the inputs of their calls."""
LOOPS = {
    "one chunk a call": (2, 10 * [9]),
    "two": (2, 4 * [70]),
    "control steps of two lengths": (1, [140, 70, 140, 70]),
}
"""Control steps of a call, and the substeps of each, for every call."""


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


@pytest.fixture
def wandering(monkeypatch):
    """Gives the particles another order at each sorting, also on a CPU, which otherwise never changes it."""
    sort = ParticleLayout.resort

    def resort(self, x):
        sort(self, x)
        self.order.copy_(self.order.roll(self.version, dims=1))

    monkeypatch.setattr(ParticleLayout, "resort", resort)


def layout_of(model: softmpm.Model) -> ParticleLayout | None:
    """Order and window as they are now, if there are any."""
    pool = fast_scheme.Fast.of(model)._pool
    return None if pool is None else pool.layout


def loop(
    model: softmpm.Model, substeps: list[int], rows: int = 2, moves: bool = False
) -> Callable[[], list[torch.Tensor]]:
    """Function that makes calls one after another, on tensors that exist: their end, and their gradient twice.

    Args:
        moves: Particles are sorted anew before each call, and the window is enlarged in between.
    """
    v = (model.rest().v - 0.1).requires_grad_()
    params = softmpm.Params(*(value.clone().requires_grad_() for value in model.params()))
    shape = (len(substeps), rows, model.worlds, model.muscle_count)
    activation = (0.3 * torch.sin(torch.arange(torch.Size(shape).numel()).view(shape))).to(v).requires_grad_()
    inputs, weights = None, cotangent(model.rest())
    if "force" in model.spec.given:
        rises = 0.4752 + 2e-4 * torch.arange(rows + 1, dtype=torch.float64, device=v.device).view(-1, 1, 1)
        force = torch.full((rows, 1, model.particle_count, model.dim), 1e-5).to(v).requires_grad_()
        inputs = softmpm.Inputs(wall_offset=rises.requires_grad_(), force=force)
    leaves = [v, activation, *params, *(value for value in inputs or () if value is not None)]

    def work() -> list[torch.Tensor]:
        end, forces = model.rest()._replace(v=v), []
        for k, (row, count) in enumerate(zip(activation, substeps, strict=True)):
            if moves and (layout := layout_of(model)):
                layout.stale, layout.outgrown = True, k == 2
            end = softmpm.simulate(model, end, row, params, substeps=count, inputs=inputs)
            if end.surface is not None:
                forces.append(end.surface.force.square().sum())
        loss = dot(weights, end) + 1e3 * sum(forces)
        first = torch.autograd.grad(loss, leaves, retain_graph=True)
        return [*(part.detach() for part in end[:4]), *first, *torch.autograd.grad(loss, leaves)]

    return work


@pytest.mark.parametrize("rows, substeps", LOOPS.values(), ids=LOOPS)
@pytest.mark.parametrize("scene, inputs", SCENES.values(), ids=SCENES)
def test_copied_states_change_no_bit(scene, inputs, rows, substeps, made, monkeypatch):
    """A few calls and their gradient, twice, on a few chunk graphs instead of one for each chunk."""
    model = softmpm.build(scene(), device="cpu", calls=len(substeps), inputs=inputs)
    assert not copies(model)
    want, count = loop(model, substeps, rows)(), made.count(True)
    assert count > 5
    made.clear()
    monkeypatch.setattr(fast_scheme, "copies", lambda model: True)
    model = softmpm.build(scene(), device="cpu", calls=len(substeps), inputs=inputs)
    for got, one in zip(loop(model, substeps, rows)(), want, strict=True):
        assert torch.equal(got, one)
    assert made.count(True) <= 4


@pytest.mark.parametrize("scene, inputs", SCENES.values(), ids=SCENES)
def test_the_order_of_copied_states_is_theirs(scene, inputs, made, wandering, monkeypatch):
    """Each call has another order of the particles, and the window grows: again no bit changes."""
    want, found = [], []
    for copied, results in ((False, want), (True, found)):
        monkeypatch.setattr(fast_scheme, "copies", lambda model, copied=copied: copied)
        model = softmpm.build(scene(), device="cpu", calls=5, inputs=inputs)
        results += loop(model, 5 * [9], moves=True)()
        layout = layout_of(model)
        assert layout is not None and layout.version == 3  # of the larger window
    for got, one in zip(found, want, strict=True):
        assert torch.equal(got, one)


def test_recomputed_states_are_not_copied(made, monkeypatch):
    """With little memory the chunk graphs are as many, and no state is copied."""
    counts = []
    for copied in (False, True):
        monkeypatch.setattr(fast_scheme, "copies", lambda model, copied=copied: copied)
        settings = little_memory(softmpm.build(bar(), device="cpu", calls=3))
        model = softmpm.build(bar(), device="cpu", **settings)
        made.clear()
        if copied:
            monkeypatch.setattr(chunk_buffers.ChunkBuffers, "copy", None)
        activation = torch.zeros(3, 1, 2, requires_grad=True)
        end = softmpm.simulate(model, model.rest(), activation, model.params(), substeps=7)
        torch.autograd.grad(end.x.sum(), activation)
        counts.append(list(made))
    assert counts[0] == counts[1] and True in counts[0]


@pytest.mark.parametrize("scene, inputs", SCENES.values(), ids=SCENES)
def test_the_plan_of_memory_counts_copies(scene, inputs, monkeypatch):
    """Copied states and three chunk graphs take the memory of the formula, within 20 %."""
    for module in (footprint, fast_scheme):
        monkeypatch.setattr(module, "copies", lambda model: True)
    model = softmpm.build(scene(), device="cpu", calls=60, inputs=inputs)
    copied, copy = [], chunk_buffers.ChunkBuffers.copy

    def noted(self) -> chunk_buffers.StoredStates:
        stored = copy(self)
        copied.append(sum(t.nbytes for t in (stored.order, stored.origin, *stored.states)))
        return stored

    monkeypatch.setattr(chunk_buffers.ChunkBuffers, "copy", noted)
    loop(model, 60 * [3])()
    graph = fast_scheme.ChunkGraph(model, layout_of(model), Chunk(0, 6, 3), keep=True)
    kept = sum(copied) + 3 * graph.buffers.bytes
    assert len(copied) == 60 and abs(kept / memory(model, Horizon(2, 3)).kept - 1) < 0.2


@pytest.mark.gpu
@pytest.mark.parametrize("scene, inputs", SCENES.values(), ids=SCENES)
def test_a_loop_on_a_gpu_copies_its_states(scene, inputs, made, monkeypatch):
    """Ten declared calls, by themselves, captured and replayed, as the same calls undeclared, but for rounding. Chunk graphs become
    parts of the captured graph."""
    about = dict(device="cuda", dtype=torch.float64, scheme="fast", inputs=inputs)
    want = loop(softmpm.build(scene(), **about), 10 * [9])()
    assert made.count(True) >= 10
    made.clear()
    children = []
    add = launch.add_child
    monkeypatch.setattr(launch, "add_child", lambda *given: (children.append(given), add(*given)))
    model = softmpm.build(scene(), calls=10, **about)
    assert copies(model)
    work = loop(model, 10 * [9])
    graph = softmpm.Graph(work, model.device)
    for run_once in (work, *4 * [graph]):
        for got, one in zip(run_once(), want, strict=True):
            assert_relative(got, one, 1e-9)
    assert made.count(True) <= 8  # for either stream at most four, and none for a capture
    assert len(children) == 30  # ten calls, and their backward passes twice


@pytest.mark.parametrize(
    "device, particles, calls, deterministic, copied",
    [
        ("cuda", SMALL, MANY_CALLS, False, True),
        ("cuda", SMALL + 2, MANY_CALLS, False, False),
        ("cuda", SMALL, MANY_CALLS - 1, False, False),
        ("cuda", SMALL, MANY_CALLS, True, False),
        ("cpu", SMALL, MANY_CALLS, False, False),
    ],
)
def test_where_states_are_copied(device, particles, calls, deterministic, copied):
    """In loops of many calls of small scenes on a GPU, and not in a deterministic model."""
    spec = SimpleNamespace(deterministic=deterministic)
    model = SimpleNamespace(
        device=torch.device(device), worlds=2, particle_count=particles // 2, calls=calls, spec=spec
    )
    assert copies(model) is copied


def test_calls_of_a_capture_share_chunk_graphs(made, monkeypatch):
    """Calls without a gradient need no more of them than outside of it, and later calls use none of those that a capture took."""
    model = softmpm.build(busy_scene(2), device="cpu")
    inputs = busy_inputs(model)
    with torch.no_grad():
        want = run(softmpm.simulate, model, inputs, 5)
        count = len(made)
        pretend_capture(monkeypatch)
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


def test_a_capture_takes_the_buffers_that_backward_passes_share(made, monkeypatch):
    """A call after it gets new ones, and the same gradient."""
    model = softmpm.build(busy_scene(2), device="cpu")
    inputs = busy_inputs(model)

    def gradient() -> torch.Tensor:
        end = run(softmpm.simulate, model, inputs, 5)
        return torch.autograd.grad(dot(cotangent(end), end), inputs["v"])[0]

    want, pool = gradient(), fast_scheme.Fast.of(model)._pool
    assert pool is not None
    (before,) = pool._shared.values()
    with monkeypatch.context() as patch, capture.collected_resources() as resources:
        pretend_capture(patch)
        assert torch.equal(gradient(), want) and torch.equal(gradient(), want)
    assert any(one is before for one in resources.made.values()) and not pool._shared
    assert torch.equal(gradient(), want)
    (after,) = pool._shared.values()
    assert after is not before
