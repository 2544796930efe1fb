"""Memory goes with the last reference to it: Python is not looking for cycles here, as on a GPU it would do so too late."""

import gc
import time
import weakref

import pytest
import torch
from helpers import (
    KINDS,
    assert_relative,
    busy_inputs,
    busy_scene,
    cotangent,
    dot,
    little_memory,
    pretend_capture,
    run,
)

import softmpm
from softmpm.planning import memory
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import plan
from softmpm.schemes import capture
from softmpm.schemes.fast import adjoint_buffers, chunk_graph, particle_order
from softmpm.schemes.fast import scheme as fast_scheme
from softmpm.schemes.fast.sorted_state import SortedState
from softmpm.schemes.plain import chunk as plain_chunk

HOLD_MEMORY = (
    softmpm.Model,
    particle_order.ParticleLayout,
    chunk_graph.ChunkGraph,
    chunk_graph.ChunkGraphAdj,
    adjoint_buffers.SharedAdjoint,
    fast_scheme.FastRun,
    plain_chunk.PlainRun,
)


@pytest.fixture
def living(monkeypatch):
    """Function that lists objects of models and calls created since and still alive, with their tensors; of one class or of any."""
    seen = []

    def track(kind):
        make = kind.__init__

        def tracked(self, *args, **kwargs):
            make(self, *args, **kwargs)
            tensors = (value for value in vars(self).values() if isinstance(value, torch.Tensor))
            seen.extend(weakref.ref(thing) for thing in (self, *tensors))

        monkeypatch.setattr(kind, "__init__", tracked)

    def alive(kind=object) -> list:
        things = (ref() for ref in seen)
        return list(
            {id(thing): thing for thing in things if thing is not None and isinstance(thing, kind)}.values()
        )

    for kind in HOLD_MEMORY:
        track(kind)
    gc.disable()
    yield alive
    gc.enable()


def model(device="cpu", **settings) -> softmpm.Model:
    return softmpm.build(busy_scene(2), device=device, **settings)


@pytest.fixture(params=["kept", "recomputed"])
def budget(request, monkeypatch) -> dict:
    """Settings with which a call stores all intermediate states, and with which it recomputes them."""
    monkeypatch.setattr(memory, "LONGEST", 8)
    return {} if request.param == "kept" else little_memory(model())


@pytest.fixture(params=KINDS)
def settings(request, budget) -> dict:
    return KINDS[request.param] | budget


def call(built, seed=1, substeps=7):
    """The end of a simulation that waits for its backward pass, and its inputs."""
    inputs = busy_inputs(built, control_steps=3, seed=seed)
    return run(softmpm.simulate, built, inputs, substeps), inputs


def backward(end, inputs) -> tuple[torch.Tensor, ...]:
    return torch.autograd.grad(dot(cotangent(end), end), list(inputs.values()))


@pytest.mark.parametrize("work", ["forward", "forward and backward", "a call that waits"])
def test_a_model_that_nobody_uses_is_freed(living, settings, work, device):
    """Its chunk graphs are freed as well: building models one after the other takes no more memory than one."""
    built = model(device=device, **settings)
    with torch.set_grad_enabled(work != "forward"):
        end, inputs = call(built)
    if work == "forward and backward":
        backward(end, inputs)
        backward(*call(built, seed=2))
    assert living(softmpm.Model) and living(torch.Tensor)
    del built, end, inputs
    assert not living()


def test_a_model_that_failed_is_freed(living, settings, device):
    """It is freed as soon as no reference to the error is left, forward and backward. On a GPU the backward pass runs in a thread
    of PyTorch, which lets go of the error a moment after it was raised here."""
    built, failed = model(device=device, **settings), 0
    inputs = busy_inputs(built)
    with torch.no_grad():
        inputs["v"] += torch.tensor([-50.0, 9.0]).to(inputs["v"])
    try:
        run(softmpm.simulate, built, inputs, 20)
    except softmpm.UnstableError:
        failed += 1
    end, inputs = call(built)
    try:
        (end.x[0, 1] * torch.finfo(built.dtype).max * 10).sum().backward()
    except softmpm.UnstableError:
        failed += 1
    assert failed == 2 and living(softmpm.Model)
    del built, end, inputs
    deadline = time.monotonic() + (5.0 if device == "cuda" else 0.0)
    while living() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not living()


def test_a_call_leaves_nothing_but_its_chunk_graphs(living, settings, device):
    """This holds with and without its gradient; a second call leaves no more."""
    built, left = model(device=device, **settings), []
    for _ in range(3):
        backward(*call(built))
        call(built, seed=2)
        assert not living((fast_scheme.FastRun, plain_chunk.PlainRun))
        left.append(len(living()))
    assert left[0] == left[1] == left[2]


@pytest.mark.parametrize("report", [0, 1, 9, 20, 21, 22, 30, 54])
def test_a_window_that_grows_leaves_little_of_the_smaller_one(living, monkeypatch, report):
    """Only the old chunk graph that contains the initial state is alive when those for the larger window are built.

    A particle is reported to have left in the chunk of this number: the first 21 run forward, the others are recomputed.
    """
    built, seen, others = model(**little_memory(model())), [], []
    horizon = Horizon(3, 7)
    assert len(horizon.chunks(plan(horizon, built.sizes(), built.budget).longest)) == 21
    backward(*call(built))
    (smaller,) = living(particle_order.ParticleLayout)
    smaller.left = True
    del smaller
    outgrown, make = fast_scheme.outgrown, chunk_graph.ChunkGraph.__init__

    def left_once(words) -> bool:
        seen.append(words)
        return outgrown(words) or len(seen) == report + 1

    def making(self, model, window, *args):
        others.append(sum(one.buffers.layout is not window for one in living(chunk_graph.ChunkGraph)))
        make(self, model, window, *args)

    monkeypatch.setattr(fast_scheme, "outgrown", left_once)
    monkeypatch.setattr(chunk_graph.ChunkGraph, "__init__", making)
    backward(*call(built))
    assert len(seen) > report and others and max(others) <= 1


def test_a_backward_pass_keeps_no_more_states_than_planned(living, monkeypatch, device):
    """Checkpoints of the forward pass are freed as others take their slots; a second backward pass recomputes them."""
    monkeypatch.setattr(
        "softmpm.planning.memory.price_of_chunk", lambda particles: 1
    )  # the same chunks on a GPU
    built, kept, most, graphs = model(device=device, **little_memory(model())), [], [], []
    horizon, copied, runs = Horizon(3, 7), SortedState.copy, chunk_graph.ChunkGraph.run
    chosen = plan(horizon, built.sizes(), built.budget)
    assert len(horizon.chunks(chosen.longest)) > 2 * chosen.checkpoints > 4

    def copying(self):
        copy = copied(self)
        kept.append(weakref.ref(copy))
        return copy

    def running(self, *args):
        most.append(sum(ref() is not None for ref in kept))
        graphs.append(len(living(chunk_graph.ChunkGraph)))
        return runs(self, *args)

    monkeypatch.setattr(SortedState, "copy", copying)
    monkeypatch.setattr(chunk_graph.ChunkGraph, "run", running)
    end, inputs = call(built)
    weights = dot(cotangent(end), end)
    first = torch.autograd.grad(weights, list(inputs.values()), retain_graph=True)
    again = torch.autograd.grad(weights, list(inputs.values()))
    # The start takes a slot, but it is the user's; and the state that was dropped last is in hand.
    assert len(kept) > 2 * chosen.checkpoints and max(most) <= chosen.checkpoints
    assert max(graphs) < chosen.checkpoints  # checkpoints refer to none
    for got, want in zip(again, first, strict=True):
        assert_relative(got, want, 0.0 if device == "cpu" else 2e-5)


def tensor_bytes() -> int:
    """Of everything that Python can reach, shared memory once."""
    gc.collect()
    # Other tests leave tensors of other types, without memory.
    storages = (thing.untyped_storage() for thing in gc.get_objects() if type(thing) is torch.Tensor)
    return sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())


@pytest.mark.parametrize("kind", KINDS)
def test_calls_of_a_closed_loop_share_the_budget(kind, monkeypatch):
    """With memory for one call, a model that is told of four keeps no more than that, one that is not four times as much; and one
    with memory for four keeps what they need. It is what the formula says.
    """
    monkeypatch.setattr(memory, "LONGEST", 8)
    scene, calls, held, adj = busy_scene(2, per_law=400), 4, [], []
    sizes = softmpm.build(scene, device="cpu", **KINDS[kind]).sizes()
    budget = 21 * (sizes.inside + sizes.nodes) + 3 * sizes.inside
    for told, enough in ((1, budget), (calls, budget), (calls, calls * (budget + sizes.start))):
        built = softmpm.build(scene, device="cpu", memory_budget=enough, calls=told, **KINDS[kind])
        start, params, before = built.rest(), built.params(), tensor_bytes()
        for tensor in params:
            tensor.requires_grad_()
        activation = torch.zeros(3, 1, built.muscle_count, dtype=built.dtype)
        end = start._replace(v=start.v.requires_grad_())
        for _ in range(calls):
            end = softmpm.simulate(built, end, activation, params, substeps=7)
        held.append(tensor_bytes() - before)
        if told == calls:
            assert 0.9 < held[-1] / memory.memory(built, Horizon(3, 7)).kept < 1.15
        adj += torch.autograd.grad(end.x.sum(), start.v)
        # Else the next round would count them before, and then free them:
        del built, start, params, activation, end
    assert held[0] > calls * budget and held[1] < budget and held[2] > calls * budget
    assert_relative(adj[1], adj[0], 1e-12 if KINDS[kind].get("dtype") else 1e-5)
    assert_relative(adj[2], adj[0], 0.0)


@pytest.mark.parametrize("failing", ["forward", "backward"])
def test_a_call_that_does_not_fit_gives_everything_back(living, settings, failing, monkeypatch, device):
    """Also what the calls before left to be used again: it may be what there is no room for."""
    built = model(device=device, **settings)
    backward(*call(built))
    waiting = call(built) if failing == "backward" else None
    owner, name = (
        (particle_order.ParticleLayout, "update_staleness")
        if failing == "forward"
        else (fast_scheme.FastRun, "vjp")
    )

    def full(*args):
        raise torch.OutOfMemoryError("no room")

    if built.scheme == "plain":
        owner, name = plain_chunk.PlainRun, "__init__" if failing == "forward" else "vjp"
    monkeypatch.setattr(owner, name, full)
    try:
        backward(*(waiting or call(built)))
    except torch.OutOfMemoryError as error:
        (note,) = error.__notes__
        assert note.startswith("softmpm: a call of 21 substeps with ") and "smaller memory_budget" in note
    else:
        raise AssertionError("it did fit")
    del waiting
    for _ in range(100):  # PyTorch's own thread may hold the call for a moment longer
        left = living((chunk_graph.ChunkGraph, chunk_graph.ChunkGraphAdj, plain_chunk.PlainRun))
        if not left:
            return
        del left
        time.sleep(0.01)
    raise AssertionError("something is left")


def test_a_call_without_gradient_that_does_not_fit_says_so(monkeypatch):
    """Also where the budget is too small for any gradient."""

    def full(*args):
        raise torch.OutOfMemoryError("no room")

    monkeypatch.setattr(particle_order.ParticleLayout, "update_staleness", full)
    for settings, note in (({}, "takes 0."), ({"memory_budget": 1000}, "needs at least")):
        with torch.no_grad(), pytest.raises(torch.OutOfMemoryError) as caught:
            call(model(**settings))
        assert note in caught.value.__notes__[0]


def test_calls_of_many_lengths_leave_few_chunk_graphs(living, device):
    """Their memory is bounded by what two calls may keep; those of the last call are there for the next one like it."""
    sizes, lengths = model().sizes(), range(10, 40)
    budget = 3 * lengths[-1] * (sizes.inside + 2 * sizes.nodes)
    built = model(device=device, memory_budget=budget)
    for substeps in lengths:
        assert plan(Horizon(3, substeps), sizes, budget).keep_all
        backward(*call(built, substeps=substeps))
        last = living(chunk_graph.ChunkGraph)
        assert sum(one.buffers.bytes for one in last) <= 2 * budget
        backward(*call(built, substeps=substeps))
        assert living(chunk_graph.ChunkGraph) == last
        del last


def test_small_programs_all_stay(living, device):
    """As many lengths as fit into the budget of a call, in turn, make no program twice."""
    built, left = model(device=device), []
    for _ in range(2):
        for substeps in range(10, 20):
            backward(*call(built, substeps=substeps))
        left.append(living(chunk_graph.ChunkGraph))
    assert left[0] == left[1] and len(left[0]) >= 10


def test_a_recorded_graph_keeps_what_it_uses(living, budget, monkeypatch):
    """Objects created before its capture, model, particle layout and chunk graphs, are freed with the graph's resources."""
    built = model(**budget)
    backward(*call(built))  # makes what a recording must not
    before = {id(made) for made in living(HOLD_MEMORY)}
    with_graphs = [weakref.ref(made) for made in living((chunk_graph.ChunkGraph, chunk_graph.ChunkGraphAdj))]
    pretend_capture(monkeypatch)
    with capture.collected_resources() as resources:
        backward(*call(built))
        assert with_graphs and all(made() is not None for made in with_graphs), (
            "a graph that is destroyed ends the recording"
        )
    del built
    for kind in (softmpm.Model, particle_order.ParticleLayout, chunk_graph.ChunkGraph):
        assert living(kind)
    assert {id(held) for held in living(HOLD_MEMORY)} <= before, (
        "the recording owns the memory of what it made"
    )
    del resources
    assert not living()


@pytest.mark.gpu
def test_a_graph_runs_on_memory_of_its_own():
    """Once only the graph uses the model, new allocations do not overlap the memory that the graph writes to."""
    device = "cuda"
    built = {"model": model(device=device)}
    inputs = busy_inputs(built["model"])
    weights = cotangent(built["model"].rest())

    def work():
        end = run(softmpm.simulate, built["model"], inputs, 20)
        return *end.detach()[:4], *torch.autograd.grad(dot(weights, end), list(inputs.values()))

    graph = softmpm.Graph(work, built["model"].device)
    graph()
    want = [t.clone() for t in graph()]
    del built["model"]
    with torch.cuda.stream(graph._stream):  # which PyTorch gives memory back to
        others = [torch.zeros(2**k, device=device) for k in range(6, 18) for _ in range(32)]
    torch.cuda.synchronize()
    for got, first in zip(graph(), want, strict=True):
        assert_relative(got, first, 2e-5)
    assert not any(t.any() for t in others)


@pytest.mark.gpu
def test_garbage_does_not_end_a_recording(monkeypatch):
    """A graph that nothing but itself refers to waits for the collector, which is made to come at once."""
    built, launches, threshold = model(device="cuda"), chunk_graph.launch_chunk, gc.get_threshold()
    inputs, weights = busy_inputs(built, control_steps=3), cotangent(built.rest())

    def work():
        return torch.autograd.grad(
            dot(weights, run(softmpm.simulate, built, inputs, 7)), list(inputs.values())
        )

    knot = [softmpm.Graph(work, built.device)]
    knot.append(knot)
    want = [found.clone() for found in [knot[0]() for _ in range(3)][-1]]

    def launching(buffers, launch):
        nonlocal knot
        knot = None
        launches(buffers, launch)

    monkeypatch.setattr(chunk_graph, "launch_chunk", launching)
    gc.set_threshold(1)
    try:
        other = model(device="cuda")  # which records its own
        found = torch.autograd.grad(
            dot(weights, run(softmpm.simulate, other, inputs, 7)), list(inputs.values())
        )
    finally:
        gc.set_threshold(*threshold)
    for got, wanted in zip(found, want, strict=True):
        assert_relative(got, wanted, 2e-5)
