"""Recorded loops: what a recording has to itself, what it must not forget, and what follows when it fails."""

import gc
import queue
import threading

import pytest
import torch
from helpers import KINDS, assert_relative, bar, busy_inputs, busy_scene, pretend_capture, run
from surface_scenes import slab

import softmpm
from softmpm.errors import NEVER
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import plan
from softmpm.schemes import capture


def test_one_captures_at_a_time():
    """The garbage collector is disabled meanwhile. A second capture waits, or does not acquire the lock."""
    acquisitions = queue.Queue()

    def another():
        for wait in (False, True):
            with capture.exclusive_capture(wait) as acquired:
                acquisitions.put((acquired, gc.isenabled()))

    thread = threading.Thread(target=another, daemon=True)
    with capture.exclusive_capture(wait=True):
        thread.start()
        assert acquisitions.get(timeout=10) == (False, False)
        with pytest.raises(queue.Empty):
            acquisitions.get(timeout=0.05)
    assert acquisitions.get(timeout=10) == (True, False)
    thread.join(timeout=10)
    assert gc.isenabled()


@pytest.mark.parametrize("settings", KINDS.values(), ids=KINDS)
def test_a_gradient_that_failed_is_not_forgotten_for_one_that_did_not(settings, monkeypatch):
    """Two backward passes through one call inside a recording: what the first one reported is still there at the end."""
    built = softmpm.build(busy_scene(2), device="cpu", **settings)
    inputs = busy_inputs(built)
    run(softmpm.simulate, built, inputs, 5).x.sum().backward()
    pretend_capture(monkeypatch)
    with capture.collected_resources() as resources:
        end = run(softmpm.simulate, built, inputs, 5)
        torch.autograd.grad((end.x[0, 1] * torch.inf).sum(), inputs["v"], retain_graph=True)
        torch.autograd.grad(end.x.sum(), inputs["v"])
    *forward, first, second = (status.words.tolist() == [NEVER] for status in resources.statuses)
    assert all(forward) and second and not first


def test_a_recording_that_failed_is_not_tried_again_at_once(monkeypatch):
    """The missing objects may be built by a call outside of a capture, so such a call comes first."""
    graph, did = softmpm.Graph(lambda: None, "cpu"), []
    graph._stream = object()

    def record(self, stream):
        did.append("record")
        raise RuntimeError("not now")

    monkeypatch.setattr(softmpm.Graph, "_run", lambda self, stream: did.append("run"))
    monkeypatch.setattr(softmpm.Graph, "_capture", record)
    for _ in range(2):
        graph()
        with pytest.raises(RuntimeError, match="not now"):
            graph()
    assert did == ["run", "record", "run", "record"]


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:The CUDA Graph is empty")  # PyTorch, of the outer one
def test_a_recording_inside_another_is_refused():
    """It would wait for itself."""
    model = softmpm.build(busy_scene(2), device="cuda")

    def work():
        return run(softmpm.simulate, model, inputs, 5).x

    inputs = {name: tensor.detach() for name, tensor in busy_inputs(model).items()}
    inner = softmpm.Graph(work, model.device)
    outer = softmpm.Graph(inner, model.device)
    want = outer()
    with pytest.raises(RuntimeError, match="being captured already: call the inner graph's function"):
        outer()
    assert_relative(inner(), want, 2e-5)


@pytest.mark.gpu
def test_a_function_without_a_simulation_is_captured_too():
    """What its inputs hold at a replay is what it computes with, and nothing can have failed."""
    x = torch.ones(3, device="cuda")
    graph = softmpm.Graph(lambda: x * 2, x.device)
    for value in (1.0, 5.0, 7.0):
        x.fill_(value)
        assert graph().tolist() == [2 * value] * 3


@pytest.mark.gpu
def test_another_thread_may_allocate_during_a_capture():
    """Memory of the GPU and pinned memory, as a simulation in that thread does."""
    failed, x = [], torch.ones(3, device="cuda")

    def allocate() -> None:
        try:
            torch.empty(2**28, device="cuda")
            torch.empty(2**20, pin_memory=True)
        except Exception as error:
            failed.append(error)

    def work() -> torch.Tensor:
        if torch.cuda.is_current_stream_capturing():
            other = threading.Thread(target=allocate)
            other.start()
            other.join()
        return x * 2

    graph = softmpm.Graph(work, x.device)
    assert [graph().tolist() for _ in range(3)] == [[2.0] * 3] * 3 and not failed


FORMULATIONS = {"moving": {}, "reference": dict(formulation="reference")}


@pytest.mark.gpu
@pytest.mark.parametrize("settings", FORMULATIONS.values(), ids=FORMULATIONS)
def test_a_captured_call_starts_at_a_moving_wall(settings):
    """From particles alone: the anchors of the surface points then depend on the normals that the call gives."""
    wall = softmpm.Wall(normal=(0.1, 1.0), offset=0.4752, friction=0.4)
    model = softmpm.build(
        bar(walls=[wall], gravity=(0.0, -9.8)), device="cuda", inputs=("wall_offset",), **settings
    )
    offset = (0.4752 + 2e-4 * torch.arange(2, dtype=torch.float64, device="cuda")).view(2, 1, 1)
    start = softmpm.State(*model.rest()[:4])

    @torch.no_grad()
    def work() -> softmpm.State:
        inputs = softmpm.Inputs(wall_offset=offset)
        return softmpm.simulate(model, start, None, model.params(), substeps=20, inputs=inputs)

    graph, want = softmpm.Graph(work, model.device), work()
    for _ in range(3):
        assert_relative(graph().x - start.x, want.x - start.x, 1e-3)


def falling_pair(device: str = "cpu", rate: float = -400.0, **settings):
    """A model and a start from which world 1 fails in the first of a few calls, while world 0 goes on.

    Args:
        rate: At which world 1 expands at the start [1/s]; at this one it collapses.
    """
    made = busy_scene(2, ("fixed_corotated",), walls=[], muscles=[], per_law=30)
    model = softmpm.build(made, device=device, worlds=2, **settings)
    start = model.rest()
    start.C[0, :, 0, 1] = 20.0  # without strains its gradient would be rounding
    start.C[1] = rate * torch.eye(2)
    start.x[:, :, 0] += 3.5 * made.grid.spacing
    return model, start


def healthy(C):
    """The same velocity gradients, none in world 1."""
    return torch.stack([C[0], torch.zeros_like(C[1])])


def three_calls(model, start, failures):
    """The end of three calls one after another."""
    with torch.no_grad():
        for _ in range(3):
            start = softmpm.simulate(model, start, None, model.params(), substeps=20, failures=failures)
    return start


def assert_goes_on(model, end, failures, alone):
    """World 0 is as if it were alone, world 1 started again from rest, and the failure has its name."""
    assert_relative(end.x[0] - model.rest().x[0], alone.x[0] - model.rest().x[0], 2e-5)
    away = (end.x[1] - model.rest().x[1]).norm(dim=-1).max()
    assert away < 0.1 * (end.x[0] - model.rest().x[0]).norm(dim=-1).min()
    (error,) = failures.errors
    assert (error.world, error.kind) == (1, "collapsed") and f"particle {error.particle} " in str(error)


@pytest.mark.parametrize("settings", FORMULATIONS.values(), ids=FORMULATIONS)
def test_a_recording_goes_on_without_a_world_that_failed(settings, monkeypatch):
    """Failures of a recorded loop are collected after a replay, by the same rules as those of a call."""
    model, start = falling_pair(**settings)
    alone = three_calls(model, start._replace(C=healthy(start.C)), None)
    called, recorded = softmpm.Failures("reset"), softmpm.Failures("reset")
    assert_goes_on(model, three_calls(model, start, called), called, alone)
    pretend_capture(monkeypatch)
    with capture.collected_resources() as resources:
        end = three_calls(model, start, recorded)
    assert not recorded.errors
    assert not resources.widen() and resources.collect()
    assert_goes_on(model, end, recorded, alone)
    assert recorded.errors[0].particle == called.errors[0].particle
    with capture.collected_resources() as resources:
        three_calls(model, start, None)
    assert not resources.collect()


def gradient(model, start, failures):
    """Of the end of two calls with respect to the start and the material of each world; the first call has a note."""
    v, params = start.v.clone().requires_grad_(), model.params()
    young = params.young.expand(2, -1).clone().requires_grad_()
    state = start._replace(v=v)
    params = params._replace(young=young)
    with softmpm.noted("Call 0."):
        state = softmpm.simulate(model, state, None, params, substeps=20, failures=failures)
    state = softmpm.simulate(model, state, None, params, substeps=20, failures=failures)
    weights = torch.linspace(1.0, 2.0, state.x.numel(), device=state.x.device).view_as(state.x)
    loss = (state.x * weights).sum()
    return torch.autograd.grad(loss, (v, young))


def assert_gradient(got, want):
    """That of world 0 is as if it were alone; world 1 has none of its first call, and that of a robot at rest of the second."""
    for one, wanted in zip(got, want, strict=True):
        assert_relative(one[0], wanted[0], 2e-5)
        assert wanted[0].abs().max() > 0 and torch.isfinite(one[1]).all()
    assert (got[0][1] == 0).all() and (want[0][1] != 0).any()


def assert_one_failure(failures, kind):
    """World 1 failed in the first call."""
    (error,) = failures.errors
    assert (error.world, error.kind, error.__notes__) == (1, kind, ["Call 0."])


BUDGETS = {"all states are kept": None, "states are computed again": 30_000}


FAILS = {"collapsed": -400.0, "not_finite": 1e10}
"""Rates at which world 1 expands at the start [1/s], by how it fails."""


@pytest.mark.parametrize("kind", FAILS)
@pytest.mark.parametrize("budget", BUDGETS.values(), ids=BUDGETS)
@pytest.mark.parametrize("settings", FORMULATIONS.values(), ids=FORMULATIONS)
def test_a_recording_differentiates_the_worlds_that_did_not_fail(settings, budget, kind, monkeypatch):
    """The one that failed has no gradient, and no failure of its backward pass is reported."""
    model, start = falling_pair(rate=FAILS[kind], memory_budget=budget, **settings)
    assert plan(Horizon(1, 20), model.sizes(), model.budget).keep_all == (budget is None)
    still = start._replace(C=healthy(start.C))
    want, called, recorded = (
        gradient(model, still, None),
        softmpm.Failures("reset"),
        softmpm.Failures("reset"),
    )
    assert_gradient(gradient(model, start, called), want)
    assert_one_failure(called, kind)
    pretend_capture(monkeypatch)
    with capture.collected_resources() as resources:
        got = gradient(model, start, recorded)
    assert resources.collect()
    assert_gradient(got, want)
    assert_one_failure(recorded, kind)


def test_a_recording_names_the_depth_in_the_wall_as_a_call_does(monkeypatch):
    """The wall has moved since the chunk began: three control steps at rest, then 12 cells in one."""
    model = softmpm.build(
        slab(),
        device="cpu",
        formulation="moving",
        inputs=("wall_offset",),
        alarms=softmpm.Alarms(collapse=None, step=None, gap=None, overlap=None),
    )
    offset = torch.full((5, 1, 1), model.scene.walls[0].offset, dtype=torch.float64)
    offset[-1] += 12 * model.scene.grid.spacing
    called, recorded = softmpm.Failures("freeze"), softmpm.Failures("freeze")

    def go(failures: softmpm.Failures) -> None:
        inputs = softmpm.Inputs(wall_offset=offset)
        with torch.no_grad():
            softmpm.simulate(
                model, model.rest(), None, model.params(), substeps=20, inputs=inputs, failures=failures
            )

    go(called)
    pretend_capture(monkeypatch)
    with capture.collected_resources() as resources:
        go(recorded)
    assert not resources.widen() and resources.collect()
    (want,), (got,) = called.errors, recorded.errors
    assert (got.kind, got.substep, got.value) == ("in_wall", want.substep, want.value)


def torn_in_flight():
    """A bar in free space whose halves part at 0.04 cells per substep each: it is torn after the first chunk of a call, and leaves the
    window if it goes on."""
    made = bar(grid=softmpm.Grid(shape=(400, 400), spacing=1 / 32))
    model = softmpm.build(made, device="cpu", worlds=2, alarms=softmpm.Alarms(step=None, collapse=None))
    start = model.rest()
    start.x[:] += 5.0
    right = start.x[1, :, 0] > start.x[1, :, 0].median()
    speed = 5 / 32 / (128 * made.dt)
    start.v[1, right, 0], start.v[1, ~right, 0] = speed, -speed
    soft = model.params()._replace(young=0.01 * model.params().young)
    return model, start, soft


@pytest.mark.parametrize("policy", ["reset", "freeze"])
def test_a_world_that_failed_in_a_recording_stops(policy, monkeypatch):
    """In the chunks after it is where it failed, so it leaves no window."""
    model, start, soft = torn_in_flight()
    softmpm.simulate(model, start._replace(v=torch.zeros_like(start.v)), None, soft, substeps=256)
    pretend_capture(monkeypatch)
    failures = softmpm.Failures(policy)
    with capture.collected_resources() as resources, torch.no_grad():
        softmpm.simulate(model, start, None, soft, substeps=256, failures=failures)
    assert len(resources.statuses) >= 2  # two chunks
    assert not resources.widen() and resources.collect()
    (error,) = failures.errors
    assert (error.world, error.kind) == (1, "torn") and error.substep < 128


def test_a_failure_is_counted_once_where_another_is_raised(monkeypatch):
    """The work is then done again outside of the recording, which counts it."""
    model, start = falling_pair()
    gradient(model, start._replace(C=healthy(start.C)), None)
    pretend_capture(monkeypatch)
    failures, v = softmpm.Failures("reset"), start.v.clone().requires_grad_()
    with capture.collected_resources() as resources:
        end = softmpm.simulate(
            model, start._replace(v=v), None, model.params(), substeps=20, failures=failures
        )
        torch.autograd.grad((end.x[0] * torch.inf).sum(), v)
    assert not resources.collect() and not failures.errors


@pytest.mark.parametrize("settings", FORMULATIONS.values(), ids=FORMULATIONS)
def test_a_recording_keeps_no_history_of_its_tensors(settings, monkeypatch):
    """It belongs to the stream of the graph, where a gradient that is taken outside of the graph would meet it."""
    model, start = falling_pair(**settings)
    gradient(model, start._replace(C=healthy(start.C)), None)
    young = model.params().young.expand(2, -1).clone().requires_grad_()
    pretend_capture(monkeypatch)

    def marks() -> dict:
        """Of the node that adds up the gradient of ``young``, which lives as long as a history that contains it."""
        return torch.autograd.graph.get_gradient_edge(young).node.metadata

    with capture.collected_resources() as resources:
        params = model.params()._replace(young=young * 1.0)
        end = softmpm.simulate(model, start, None, params, substeps=20, failures=softmpm.Failures("reset"))
        marks()["seen"] = True
        torch.autograd.grad(end.x.sum(), young)
    assert "seen" in marks()
    del params, end
    assert resources.statuses and "seen" not in marks()


@pytest.mark.gpu
@pytest.mark.parametrize("kind", FAILS)
@pytest.mark.parametrize("settings", FORMULATIONS.values(), ids=FORMULATIONS)
def test_a_graph_differentiates_the_worlds_that_did_not_fail(settings, kind):
    """In each replay anew."""
    model, start = falling_pair("cuda", FAILS[kind], **settings)
    C = start.C.clone()
    want = gradient(model, start._replace(C=healthy(C)), None)
    failures = softmpm.Failures("reset")
    graph = softmpm.Graph(lambda: gradient(model, start, failures), model.device)
    for fails in (True, True, True, False, True):
        start.C.copy_(C if fails else healthy(C))
        failures.errors.clear()
        got = graph()
        if fails:
            assert_gradient(got, want)
            assert_one_failure(failures, kind)
        else:
            for one, wanted in zip(got, want, strict=True):
                assert_relative(one, wanted, 2e-5)
            assert not failures.errors


@pytest.mark.gpu
@pytest.mark.parametrize("settings", FORMULATIONS.values(), ids=FORMULATIONS)
def test_a_graph_goes_on_without_a_world_that_failed(settings):
    """In each replay anew; one in which no world fails has no failures."""
    model, start = falling_pair("cuda", **settings)
    still, C = healthy(start.C), start.C.clone()
    alone = three_calls(model, start._replace(C=still), None)
    failures = softmpm.Failures("reset")
    graph = softmpm.Graph(lambda: three_calls(model, start, failures), model.device)
    for _ in range(4):
        failures.errors.clear()
        assert_goes_on(model, graph(), failures, alone)
    assert graph._graph is not None  # kept: a robot that is back at its start is in the window
    start.C.copy_(still)
    failures.errors.clear()
    assert_relative(graph().x, alone.x, 2e-5)
    assert not failures.errors
    start.C.copy_(C)
    assert_goes_on(model, graph(), failures, alone)
