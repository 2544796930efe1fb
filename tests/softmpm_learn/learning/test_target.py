import pytest
import torch
from torch import nn

from softmpm_learn.learning.target import TargetNetwork


def network() -> nn.Module:
    net = nn.Linear(3, 2)
    net.register_buffer("scale", torch.tensor(2.0))
    return net


def test_follows_a_share_of_the_way():
    """(L2): each tensor, buffers too, moves that share; rate 1 copies exactly; a wrong rate is an error."""
    net, other = network(), network()
    target = TargetNetwork(net)
    before = {k: t.clone() for k, t in target.copy.state_dict().items()}
    other.scale.fill_(4.0)
    target.follow(other, 0.25)
    for name, tensor in target.copy.state_dict().items():
        torch.testing.assert_close(tensor, 0.75 * before[name] + 0.25 * other.state_dict()[name])
    target.follow(other, 1.0)
    assert all(torch.equal(t, other.state_dict()[k]) for k, t in target.copy.state_dict().items())
    with pytest.raises(ValueError, match="rate"):
        target.follow(other, 0.0)


def test_is_no_other_name_for_the_network():
    """Training the network leaves the target alone; gradients pass through the target but none stays in it."""
    net = network()
    target, x = TargetNetwork(net), torch.ones(1, 3, requires_grad=True)
    want = target(x).detach()
    with torch.no_grad():
        net.weight.add_(1.0)
    assert torch.equal(target(x), want)
    target(x).sum().backward()
    assert x.grad.abs().sum() > 0 and all(p.grad is None and not p.requires_grad for p in target.parameters())
