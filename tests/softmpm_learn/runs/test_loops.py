"""Closed loops that are run again and again."""

import dataclasses
import math

import pytest
import torch
from learners import viscous

import softmpm
from softmpm_learn.design import Design
from softmpm_learn.episode import Frame, run_episode
from softmpm_learn.objective import Objective, Progress
from softmpm_learn.observe import Centroids
from softmpm_learn.policy import make_policy
from softmpm_learn.runs.loops import ClosedLoop
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.settings import DesignConf, PolicyConf


@pytest.mark.parametrize("name", ["mlp", "knots"])
def test_the_loop_gives_the_gradient_of_all_parameters(task, name):
    """The policy's, taken of all decisions at once, and the design's are those of autograd through the episode."""
    task = viscous(task)
    model = softmpm.build(task.scene, device="cpu")
    observer = Centroids(model, list(task.regions.values()), task.body_length)
    policy = make_policy(PolicyConf(name=name), observer.size, 2, 0.1, seed=0)
    design = Design(DesignConf(strength=True, viscosity=True), model, task.regions)
    free = list(design.parameters())
    episode, got = ClosedLoop(task, model, observer, policy, design, list(policy.parameters()), free)(None)
    assert not episode.loss.requires_grad and not episode.decisions.activations
    params, inputs = design()
    loss = run_episode(task, model, observer, policy, params, inputs=inputs).loss.mean()
    want = torch.autograd.grad(loss, [*policy.parameters(), *free])
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6 * b.abs().max().item())


def test_an_objective_may_end_before_the_episode(task):
    """The gradient is that of an episode without the control steps after its end, which do not count."""
    model = softmpm.build(task.scene, device="cpu")
    observer = Centroids(model, list(task.regions.values()), task.body_length)
    policy = make_policy(PolicyConf(name="linear"), observer.size, 2, 0.1, seed=0)
    design = Design(DesignConf(), model, task.regions)
    weights, free, found = list(policy.parameters()), list(design.parameters()), []
    for steps, end in ((3, math.inf), (6, 3 * task.control_period)):
        ends = dataclasses.replace(task, control_steps=steps, objective=Objective(Progress(end=end)))
        found.append(ClosedLoop(ends, model, observer, policy, design, weights, free)(None)[1])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-5, atol=1e-6 * a.abs().max().item())
        assert a.abs().max() > 0


class Noisy(Centroids):
    """Centroids as a sensor with noise measures them."""

    def observe(self, model, state):
        return super().observe(model, state) * (1.0 + 0.1 * torch.randn(len(state.x), 1, 1))


def test_noise_of_an_observer_leaves_the_gradient_right(task):
    """Observations are made once: the policy's gradient takes the features that it was given, and the states' the same noise."""
    task = viscous(task)
    model = softmpm.build(task.scene, device="cpu")
    observer = Noisy(model, list(task.regions.values()), task.body_length)
    policy = make_policy(PolicyConf(name="mlp"), observer.size, 2, 0.1, seed=0)
    design, weights = Design(DesignConf(strength=True), model, task.regions), list(policy.parameters())
    free, params, inputs = list(design.parameters()), *design()
    loop, losses = ClosedLoop(task, model, observer, policy, design, weights, free), []
    with torch.random.fork_rng([]):
        for seed in (1, 2):
            torch.manual_seed(seed)
            episode, got = loop(None)
            torch.manual_seed(seed)
            loss = run_episode(task, model, observer, policy, params, inputs=inputs).loss.mean()
            want = torch.autograd.grad(loss, [*weights, *free], retain_graph=True)
            for a, b in zip(got, want, strict=True):
                torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6 * b.abs().max().item())
            losses.append(episode.loss.item())
    assert losses[0] != losses[1]


@pytest.mark.parametrize("dtype, deterministic", [("float32", False), ("float64", False), ("float64", True)])
def test_sums_in_order_are_not_captured(task, dtype, deterministic):
    """They wait for the device, which a CUDA graph cannot; every other loop goes through the graph."""
    model = softmpm.build(task.scene, device="cpu", dtype=getattr(torch, dtype), deterministic=deterministic)
    observer = Centroids(model, list(task.regions.values()), task.body_length)
    policy = make_policy(PolicyConf(name="linear"), observer.size, 2, 0.1, seed=0).to(model.dtype)
    weights = list(policy.parameters())
    loop = ClosedLoop(task, model, observer, policy, lambda: (model.params(), softmpm.Inputs()), weights, [])
    work, calls = loop._graph, []
    loop._graph = lambda: calls.append(1) or work()
    loop(None)
    assert len(calls) == (0 if deterministic else 1)


def recording_loop(task, device="cpu") -> ClosedLoop:
    """A loop whose episodes will be recorded."""
    model = softmpm.build(task.scene, device=device)
    observer = Centroids(model, list(task.regions.values()), task.body_length)
    policy = make_policy(PolicyConf(name="linear"), observer.size, 2, 0.1, seed=0).to(model.device)
    weights = list(policy.parameters())
    return ClosedLoop(
        task, model, observer, policy, lambda: (model.params(), softmpm.Inputs()), weights, [], records=True
    )


def torn(text: str) -> softmpm.UnstableError:
    return softmpm.UnstableError(
        text, kind="fracture", world=0, particle=0, substep=0, value=math.nan, limit=math.nan
    )


def assert_same_frames(got: list[Frame], want: list[Frame]) -> None:
    assert [frame.time for frame in got] == [frame.time for frame in want]
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close((*a.state[:4], a.features), (*b.state[:4], b.features))
        assert (a.activation is None) == (b.activation is None)
        if b.activation is not None:
            torch.testing.assert_close(a.activation, b.activation)


def test_the_frames_of_a_replay_are_shown(task):
    """Those that the graph kept, in their order; only to a call that asks."""
    loop, live, replayed = recording_loop(task), list[Frame](), list[Frame]()
    episode, gradients = loop(None, live.extend)
    assert len(live) == task.control_steps + 1
    loop._graph = lambda: (episode, gradients, [frame.detach() for frame in live])
    loop(None)
    assert loop(None, replayed.extend) == (episode, gradients)
    assert_same_frames(replayed, live)


def test_frames_after_a_failure_are_not_shown(task):
    """A replay goes on with the robot that failed; the one that is recorded is simulated again, up to its failure."""
    loop, shown = recording_loop(task), list[Frame]()
    episode, gradients, work = *loop(None), loop._work

    def replay():
        loop._failures.errors.append(torn("it tore"))
        return episode, gradients, ["after the failure"]

    def again():
        work()
        raise torn("it tore again")

    loop._graph, loop._work = replay, again
    with pytest.raises(softmpm.UnstableError, match="it tore again"):
        loop(None, shown.extend)
    assert [type(frame) for frame in shown] == [Frame] * (task.control_steps + 1)
    with pytest.raises(softmpm.UnstableError, match="it tore$"):
        loop(None)


@pytest.mark.parametrize("every", [0, 2])
def test_runs_that_record_nothing_keep_no_frames(task, model, settings, tmp_path, every):
    """Or the states of many robots would lie in the memory of a graph for nothing."""
    train = dataclasses.replace(settings.train, record_every=every)
    run = Run(task, model, dataclasses.replace(settings, train=train), tmp_path)
    assert Runs([run]).loop.records == (every > 0)


@pytest.mark.gpu
def test_a_captured_graph_keeps_the_frames(task):
    """They are those of the simulation outside of a graph, of every replay, and nothing is captured for them a second time."""
    loop, frames = recording_loop(viscous(task), "cuda"), [list[Frame]() for _ in range(3)]
    loop(None, frames[0].extend)
    loop(None)
    graph = loop._graph._graph
    for some in frames[1:]:
        loop(None, some.extend)
        assert_same_frames(some, frames[0])
    assert graph is not None and loop._graph._graph is graph
