import dataclasses
import math

import numpy as np
import pytest
import torch
from learners import viscous
from torch import nn

import softmpm
from softmpm_learn.design import Design
from softmpm_learn.episode import run_episode
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


def test_observer_and_policy_have_the_precision_of_the_model(task, model):
    """Others are refused, each by name; the remedy of the message helps."""
    exact = softmpm.build(task.scene, device="cpu", dtype=torch.float64)
    observer, policy = (
        Centroids(model, [np.arange(4)], 1.0),
        make_policy(PolicyConf(name="linear"), 4, 2, 0.1, seed=0),
    )
    about = task, exact, observer, policy, exact.params()
    with pytest.raises(
        ValueError, match=r"the observer must be torch.float64 .* use observer.to\(torch.float64\)"
    ):
        run_episode(*about)
    observer.to(torch.float64)
    with pytest.raises(
        ValueError, match=r"the policy must be torch.float64 .* use policy.to\(torch.float64\)"
    ):
        run_episode(*about)
    policy.to(torch.float64)
    assert run_episode(*about).loss.dtype == torch.float64


def test_a_failure_names_the_control_step(task, model):
    """An unstable simulation says in which control step; a fast throw out of the grid is one."""
    thrown = dataclasses.replace(task, substeps=400, objective=Objective(Progress()))
    observer = Centroids(model, [np.arange(4)], 1.0)
    with pytest.raises(softmpm.UnstableError) as caught:
        run_episode(thrown, model, observer, Constant([40.0, -40.0]), model.params())
    assert "control step 0 of 6" in caught.value.__notes__[0]


class NotAlways(nn.Module):
    """The square root of what has become negative in one world, from the third control step on."""

    def forward(self, z, time, goal=None):
        value = torch.full((len(z), 2), 0.25)
        value[1] -= 0.2 * float(time)
        return (value - 0.2499).sqrt()


def test_activations_that_are_not_finite_are_a_failure_of_their_world(task):
    """Collected, with the control step, while the other world goes on as alone; else raised."""
    model = softmpm.build(task.scene, device="cpu", worlds=2)
    observer, failures = Centroids(model, [np.arange(4)], 1.0), softmpm.Failures("reset")
    about = task, model, observer, NotAlways(), model.params()
    episode = run_episode(*about, failures=failures)
    (error,) = failures.errors
    assert (error.kind, error.world, error.limit) == ("activation", 1, "activations must be finite")
    assert "control step" in error.__notes__[0] and episode.end.x.isfinite().all()
    alone = softmpm.build(task.scene, device="cpu")
    want = run_episode(
        task, alone, Centroids(alone, [np.arange(4)], 1.0), Constant([0.01, 0.01]), alone.params()
    )
    torch.testing.assert_close(episode.end.x[:1], want.end.x, rtol=1e-4, atol=1e-6)
    with pytest.raises(
        softmpm.UnstableError, match="the policy gives an activation of nan for muscle 0 of world 1"
    ):
        run_episode(*about)


def test_a_failure_of_the_gradient_names_the_control_step(task, model):
    """That in which it overflows: of a loss of states two and five, whose own gradient does, the later one is met first."""
    observer = Centroids(model, [np.arange(4)], 1.0)
    params = model.params()._replace(young=model.params().young.clone().requires_grad_())
    path = run_episode(task, model, observer, Constant([0.5, -0.3]), params).path
    with pytest.raises(softmpm.UnstableError) as caught:
        (path.x[[2, 5]].sum() * 3e38 * 10).backward()
    assert (
        caught.value.kind == "gradient" and "control step 4 of 6, which began at" in caught.value.__notes__[0]
    )


def test_a_failure_of_the_gradient_of_an_observation_names_the_control_step(task, model):
    """A learned observer sees the grid, whose adjoint overflows."""
    picture = VelocityImage(model)
    net = nn.Sequential(nn.Flatten(), nn.Linear(2 * math.prod(picture.shape), 3))
    params = model.params()._replace(young=model.params().young.clone().requires_grad_())
    made = run_episode(task, model, Latent(picture, net, size=3), Constant([0.5, -0.3]), params).decisions
    with pytest.raises(softmpm.UnstableError, match="in the backward pass of rasterize") as caught:
        (made.features[3].sum() * 3e38 * 10).backward()
    assert "control step 3 of 6, which began at" in caught.value.__notes__[0]
