"""Modules evaluated at once, against each of them alone."""

import pytest
import torch
from torch import Tensor, nn

from softmpm_learn.autoencoder import Encoder
from softmpm_learn.learning.target import TargetNetwork
from softmpm_learn.policy import Clock, Feedback, Goal, Knots
from softmpm_learn.runs.stacking import Stacked
from softmpm_learn.seeding import seeded

COUNT = 3


def policy(k: int) -> nn.Module:
    return Feedback(3, 2, [8], 1.0, Clock(0.4, 2), Goal(torch.zeros(2), torch.tensor([1.0, 2.0 + k])))


def encoder(k: int) -> nn.Module:
    return TargetNetwork(Encoder(2, (9, 7), 3, [4, 4], scale=1.0 + k, seen=2))


def knots(k: int) -> nn.Module:
    return Knots(2, 1.0, 4, seconds=1.0)


CASES = {
    "policy": (policy, (0, None, 0), lambda r: (r(COUNT, 5, 4, 3), torch.arange(5.0)[:, None], r(COUNT, 4, 2))),
    "knots": (knots, (0, None, 0), lambda r: (r(COUNT, 5, 4, 3), torch.arange(5.0)[:, None], None)),
    "encoder": (encoder, (0,), lambda r: (r(COUNT, 4, 2, 9, 7),)),
}  # fmt: skip


@pytest.fixture(params=CASES)
def case(request) -> tuple[list[nn.Module], Stacked, tuple]:
    """Modules in float64, the same stacked, and inputs."""
    make, dims, inputs = CASES[request.param]
    with seeded(0):
        modules = [make(k).double() for k in range(COUNT)]
        given = inputs(lambda *shape: torch.randn(*shape, dtype=torch.float64))
    return modules, Stacked(modules, dims, given), given


def in_turn(modules: list[nn.Module], dims: tuple, inputs: tuple) -> Tensor:
    def of(k: int) -> list:
        return [x if d is None or x is None else x[k] for x, d in zip(inputs, dims, strict=True)]

    return torch.stack([module(*of(k)) for k, module in enumerate(modules)])


def test_values_and_gradients_are_those_of_each_module(case):
    """Batched; the gradient with respect to the stacked weights, split, is that of each module's own."""
    modules, stack, given = case
    assert stack.batched
    got, want = stack(*given), in_turn(modules, stack.dims, given)
    torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)
    if not want.requires_grad:
        return
    parts = stack.split(torch.autograd.grad(got.sin().sum(), stack.weights))
    for module, part in zip(modules, parts, strict=True):
        own = torch.autograd.grad(want.sin().sum(), list(module.parameters()), retain_graph=True)
        torch.testing.assert_close(part, list(own), rtol=1e-10, atol=1e-12)


def test_a_change_in_place_is_seen(case):
    """Of an optimiser, of a checkpoint that is loaded, of a buffer."""
    modules, stack, given = case
    own = list(modules[1].parameters())
    optimizer = torch.optim.Adam(own, lr=0.1)
    for p in own:
        p.grad = torch.ones_like(p)
    optimizer.step()
    modules[0].load_state_dict({name: t + 0.5 for name, t in modules[0].state_dict().items()})
    for buffer in modules[2].buffers():
        buffer.mul_(1.5)
    torch.testing.assert_close(stack(*given), in_turn(modules, stack.dims, given), rtol=1e-12, atol=1e-12)


def test_a_replaced_tensor_is_taken_over(case):
    """Where a module is given new tensors instead of new values, ``attach`` makes them views again."""
    modules, stack, given = case
    for p in modules[2].parameters():
        p.data = torch.full_like(p, 0.1)
    stack.attach()
    for factor in (1.0, 2.0):
        for p in modules[2].parameters():
            p.data.mul_(factor)
        torch.testing.assert_close(stack(*given), in_turn(modules, stack.dims, given), rtol=1e-12, atol=1e-12)


def test_modules_of_other_shapes_are_evaluated_in_turn():
    """Their outputs must still have one shape."""
    modules = [nn.Sequential(nn.Linear(3, width), nn.Linear(width, 2)) for width in (4, 5)]
    stack, z = Stacked(modules, (0,), (torch.randn(2, 5, 3),)), torch.randn(2, 5, 3)
    assert not stack.batched
    torch.testing.assert_close(stack(z), in_turn(modules, (0,), (z,)))
    gradients = torch.autograd.grad(stack(z).sum(), stack.weights)
    assert [len(part) for part in stack.split(gradients)] == [4, 4]


class Later(nn.Module):
    """A number that is no weight matters after a second."""

    def __init__(self, begin: float):
        super().__init__()
        self.begin, self.layer = begin, nn.Linear(3, 2)

    def forward(self, z, time):
        return self.layer(z) * (time - self.begin).clamp(min=1.0)


@pytest.mark.parametrize("begin", [(0.5, 0.7), (0.5, 0.5)])
def test_modules_that_differ_where_the_probe_does_not_look(caplog, begin):
    """They are evaluated in turn, and the log says so; alike in all but their weights they are batched."""
    modules, z = [Later(one) for one in begin], torch.randn(2, 5, 3)
    with caplog.at_level("INFO", logger="softmpm_learn"):
        stack = Stacked(modules, (0, None), (z, torch.tensor(0.1)))
    assert stack.batched == (begin[0] == begin[1])
    assert ("Modules Later differ in more than their weights" in caplog.text) != stack.batched
    late = (z, torch.tensor(9.0))
    torch.testing.assert_close(stack(*late), in_turn(modules, stack.dims, late))
