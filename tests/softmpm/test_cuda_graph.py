"""Recorded loops: what a recording has to itself, what it must not forget, and what follows when it fails."""

import gc
import queue
import threading

import pytest
import torch
from helpers import KINDS, assert_relative, busy_inputs, busy_scene, run

import softmpm
from softmpm import autograd, rollout, runner
from softmpm.errors import NEVER
from softmpm.schemes import capture
from softmpm.schemes.fast import chunk_buffers
from softmpm.schemes.fast import scheme as fast_scheme


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
    for module in (autograd, fast_scheme, chunk_buffers, rollout, runner):
        monkeypatch.setattr(module, "is_capturing", lambda model: True)
    with capture.collected_resources() as resources:
        end = run(softmpm.simulate, built, inputs, 5)
        torch.autograd.grad((end.x[0, 1] * torch.inf).sum(), inputs["v"], retain_graph=True)
        torch.autograd.grad(end.x.sum(), inputs["v"])
    *forward, first, second = (words.tolist() == [NEVER] for words, _ in resources.words)
    assert all(forward) and second and not first


def test_a_recording_that_failed_is_not_tried_again_at_once(monkeypatch):
    """The missing objects may be built by a call outside of a capture, so such a call comes first."""
    graph, did = softmpm.Graph(lambda: None, torch.device("cpu")), []
    graph._stream = object()

    def record(self, stream):
        did.append("record")
        raise RuntimeError("not now")

    monkeypatch.setattr(softmpm.Graph, "_run", lambda self, stream, work: did.append("run"))
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
