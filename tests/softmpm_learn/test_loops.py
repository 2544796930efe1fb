"""Closed loops that are run again and again."""

import pytest
import torch
from learners import viscous

import softmpm
from softmpm_learn.design import Design
from softmpm_learn.episode import run_episode
from softmpm_learn.loops import ClosedLoop
from softmpm_learn.observe import Centroids
from softmpm_learn.policy import make_policy
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
