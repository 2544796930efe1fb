import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import nn

import softmpm
from softmpm_learn.design import Design
from softmpm_learn.episode import ClosedLoop, run_episode
from softmpm_learn.objective import Objective, Progress
from softmpm_learn.observe import Centroids, Latent, VelocityImage
from softmpm_learn.policy import make_policy
from softmpm_learn.seeding import seeded
from softmpm_learn.settings import DesignConf, PolicyConf


class Constant(nn.Module):
    """The same activation always."""

    def __init__(self, value: list[float]):
        super().__init__()
        self.value = torch.tensor([value])

    def forward(self, z, time, goal=None):
        return self.value.expand(len(z), -1).to(z)


def test_equals_one_call_of_simulate(task, model):
    """Under a constant activation the closed loop is one long simulation up to rounding, and its losses are the objective's."""
    observer = Centroids(model, list(task.regions.values()), task.body_length)
    episode = run_episode(task, model, observer, Constant([0.5, -0.3]), model.params())
    activation = torch.tensor([0.5, -0.3]).expand(task.control_steps, 1, 2).contiguous()
    start = model.rest()
    end = softmpm.simulate(model, start, activation, model.params(), substeps=task.substeps)
    for got, want in zip(episode.end[:4], end[:4], strict=True):
        torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(episode.terms["progress"], (start.x - end.x)[..., 0].mean(dim=1))
    torch.testing.assert_close(episode.terms["effort"], torch.full((1,), 1e-3 * (0.25 + 0.09) / 2))
    torch.testing.assert_close(episode.loss, episode.terms["progress"] + episode.terms["effort"])
    torch.testing.assert_close(episode.activation, activation)
    assert episode.observations is None


def viscous(task):
    """The task with a material that can have its viscosity designed."""
    (body,) = task.scene.bodies
    body = dataclasses.replace(body, material=dataclasses.replace(body.material, viscosity=0.1))
    return dataclasses.replace(task, scene=dataclasses.replace(task.scene, bodies=[body]))


def test_gradient_of_policy_and_design(task):
    """Autograd through policy, observer, simulator and design agrees with a central difference along a random direction: for the
    policy, and for each quantity of the design."""
    task = viscous(task)
    model = softmpm.build(task.scene, device="cpu", dtype=torch.float64, worlds=2)
    with seeded(0):
        picture = VelocityImage(model)
        net = nn.Sequential(nn.Flatten(), nn.Linear(2 * math.prod(picture.shape), 3), nn.Tanh()).double()
    observer = Latent(picture, net, size=3)
    policy = make_policy(PolicyConf(name="linear"), 3, 2, 0.1, seed=0).double()
    design = Design(DesignConf(strength=True, viscosity=True), model, task.regions)
    variables = [*policy.parameters(), *design.parameters()]

    def loss():
        params, inputs = design()
        return run_episode(task, model, observer, policy, params, inputs=inputs).loss.mean()

    gradient = torch.autograd.grad(loss(), variables)
    generator = torch.Generator().manual_seed(0)
    direction = [torch.randn(v.shape, generator=generator, dtype=v.dtype) for v in variables]
    assert len(variables) == 2 + len(design.free) == 7
    for part in (slice(0, 2), *(slice(k, k + 1) for k in range(2, 7))):  # policy, each of the design

        def shifted(h, part=part):
            with torch.no_grad():
                for v, d in zip(variables[part], direction[part], strict=True):
                    v += h * d
                value = loss()
                for v, d in zip(variables[part], direction[part], strict=True):
                    v -= h * d
            return value

        want = (shifted(1e-5) - shifted(-1e-5)) / 2e-5
        got = sum((g * d).sum() for g, d in zip(gradient[part], direction[part], strict=True))
        assert abs(want) > 1e-8  # not a difference of nothing
        torch.testing.assert_close(got, want, rtol=1e-5, atol=0)


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


def test_frames_and_pictures(task, model):
    """A frame at every control step and one at the end; every second look is kept, and keeps no graph."""
    picture = VelocityImage(model)
    encoder = nn.Sequential(nn.Flatten(), nn.Linear(2 * math.prod(picture.shape), 3))
    observer = Latent(picture, encoder, size=3)
    frames = []
    episode = run_episode(
        task, model, observer, Constant([0.5, 0.5]), model.params(), keep_every=2, on_frame=frames.append
    )
    assert len(frames) == task.control_steps + 1 and frames[-1].activation is None
    np.testing.assert_allclose([f.time for f in frames], 0.016 * np.arange(7))
    assert episode.observations.shape == (3, 1, 2, *picture.shape) and not episode.observations.requires_grad
    torch.testing.assert_close(episode.observations[1], observer.observe(model, frames[2].state))
    assert torch.equal(frames[-1].state.x, episode.end.x)


def test_a_failure_names_the_control_step(task, model):
    """An unstable simulation says in which control step; a fast throw out of the grid is one."""
    thrown = dataclasses.replace(task, substeps=400, objective=Objective(Progress()))
    observer = Centroids(model, [np.arange(4)], 1.0)
    with pytest.raises(softmpm.UnstableError) as caught:
        run_episode(thrown, model, observer, Constant([40.0, -40.0]), model.params())
    assert "control step 0 of 6" in caught.value.__notes__[0]
