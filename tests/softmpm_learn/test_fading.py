"""Gradients that fade: values stay, and each gradient is the weighted one of simulations by hand."""

import math

import pytest
import torch

import softmpm
from softmpm_learn.episode import run_episode
from softmpm_learn.fading import Fading

STEPS = 3


class Replay(torch.nn.Module):
    """A policy that returns given activations."""

    def __init__(self, rows: torch.Tensor):
        super().__init__()
        self.rows = iter(rows)

    def forward(self, z, time, goal):
        return next(self.rows)


@pytest.fixture(params=["moving", "reference"])
def exact(request, make_block):
    """The block in float64, in both formulations."""
    return softmpm.build(make_block(), device="cpu", dtype=torch.float64, formulation=request.param)


def travelled(model, rows: torch.Tensor, factor: float) -> torch.Tensor:
    """Mean distance, whose gradient passes each control step by hand."""
    state, before, carry = model.rest(), model.rest().x.mean(), 0.0
    for row in rows:
        state = softmpm.simulate(model, state, row[None], model.params(), substeps=4)
        end = state.x[..., 0].mean() + carry
        carry = carry + (1 - factor) * (state.x[..., 0].mean() - state.x[..., 0].mean().detach())

        def faded(tensor):
            return tensor.detach() + factor * (tensor - tensor.detach())

        parts = [faded(tensor) for tensor in state.differentiable()]
        nodes = (
            None
            if state.nodes is None
            else state.nodes._replace(
                **{name: faded(getattr(state.nodes, name)) for name in ("u", "v", "anchor", "force")}
            )
        )
        state = softmpm.State.of(parts)._replace(low=state.low, nodes=nodes)
    return end - before


@pytest.mark.parametrize("time", [1e-3, 0.02, 0.5])
def test_the_gradient_is_that_of_weighted_states(exact, task, time):
    """Of the distance with respect to each activation: ≤ 1e-12; from little more than the last step to nearly all."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(task.control_steps, 1, exact.muscle_count, generator=generator, dtype=torch.float64)
    rows.requires_grad_()
    factor = math.exp(-task.control_period / time)
    observer = torch.nn.Identity()
    observer.observe, observer.encode = lambda model, state: state.v, lambda v: v.mean(dim=1)
    episode = run_episode(task, exact, observer, Replay(rows), exact.params(), fade=time)
    (got,) = torch.autograd.grad(episode.terms["progress"].sum(), rows)
    (want,) = torch.autograd.grad(-travelled(exact, rows, factor), rows)
    torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-15)
    whole = run_episode(task, exact, observer, Replay(rows), exact.params())
    (all_of_it,) = torch.autograd.grad(whole.terms["progress"].sum(), rows)
    torch.testing.assert_close(episode.terms["progress"], whole.terms["progress"], rtol=0, atol=0)
    assert not torch.allclose(got, all_of_it, rtol=1e-3)
    torch.testing.assert_close(got[-1], all_of_it[-1], rtol=1e-12, atol=0)


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_every_world_has_its_own_time(formulation, make_block, task):
    """With a time for each world its gradient is that of a simulation of its own: ≤ 1e-12; also with one that is infinite."""
    times = torch.tensor([0.02, 0.1, math.inf], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    observer = torch.nn.Identity()
    observer.observe, observer.encode = lambda model, state: state.v, lambda v: v.mean(dim=1)
    build = dict(device="cpu", dtype=torch.float64, formulation=formulation)
    model = softmpm.build(make_block(), worlds=len(times), **build)
    rows = torch.rand(task.control_steps, len(times), model.muscle_count, generator=generator).double()

    def gradient(model, rows, fade):
        rows = rows.clone().requires_grad_()
        episode = run_episode(task, model, observer, Replay(rows), model.params(), fade=fade)
        return torch.autograd.grad(episode.terms["progress"].sum(), rows)[0]

    got, alone = gradient(model, rows, times), softmpm.build(make_block(), **build)
    for k, time in enumerate(times.tolist()):
        want = gradient(alone, rows[:, k : k + 1], time)
        torch.testing.assert_close(got[:, k : k + 1], want, rtol=1e-12, atol=1e-15)


def test_a_distance_counts_every_step(exact, task):
    """With a very short time constant the first activation still moves the body by what it adds in its own step."""
    rows = torch.full((task.control_steps, 1, exact.muscle_count), 0.3, dtype=torch.float64).requires_grad_()
    (own,) = torch.autograd.grad(
        softmpm.simulate(exact, exact.rest(), rows[:1], exact.params(), substeps=4).x[..., 0].mean(), rows
    )
    (got,) = torch.autograd.grad(travelled(exact, rows, 0.0), rows)
    torch.testing.assert_close(got[0], own[0], rtol=1e-12, atol=0)


def test_nothing_is_changed_without_fading(exact):
    """An infinite time gives the very state."""
    state = exact.rest()
    state = state._replace(x=state.x.clone().requires_grad_())
    assert Fading(math.inf, 0.1)(state) == (state, state)
