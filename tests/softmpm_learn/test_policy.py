import math

import pytest
import torch

from softmpm_learn.policy import Goal, make_policy
from softmpm_learn.settings import PolicyConf

at = torch.tensor
NAMES = ("linear", "mlp", "sinusoids", "knots")


def make(name: str, seed=0, goal=None, **settings):
    return make_policy(
        PolicyConf(name=name, **settings), size=4, muscles=3, seconds=2.0, seed=seed, goal=goal
    )


@pytest.mark.parametrize("name", NAMES)
def test_activation_is_bounded_and_follows_from_the_seed(name):
    """Each muscle of each world gets a value in (-1, 1); equal seeds give equal policies, other seeds others."""
    z = 3 * torch.randn(5, 4, generator=torch.Generator().manual_seed(0))
    activation = make(name)(z, at(0.3))
    assert activation.shape == (5, 3) and activation.abs().max() < 1
    assert torch.equal(activation, make(name)(z, at(0.3)))
    assert not torch.equal(activation, make(name, seed=1)(z, at(0.3)))


@pytest.mark.parametrize("name", NAMES)
def test_gain_zero_starts_at_rest_and_still_learns(name):
    """Without gain a policy does nothing at first, yet has a gradient to start with."""
    policy = make(name, gain=0.0)
    activation = policy(torch.ones(1, 4), at(0.1))
    assert (activation == 0).all()
    gradients = torch.autograd.grad(activation.sum(), list(policy.parameters()))
    assert sum(g.abs().sum() for g in gradients) > 0


def test_linear_is_tanh_of_wz_plus_b():
    """Without clock the linear policy is the formula of the paper, whatever the time."""
    policy, z = make("linear", clock=False), torch.randn(2, 4, generator=torch.Generator().manual_seed(0))
    layer = policy.layers[0]
    with torch.no_grad():
        layer.bias.copy_(torch.tensor([0.1, 0.2, 0.3]))
    want = torch.tanh(z @ layer.weight.T + layer.bias)
    torch.testing.assert_close(policy(z, at(0.0)), want)
    torch.testing.assert_close(policy(z, at(1.7)), want)


@pytest.mark.parametrize("name", ["linear", "mlp", "sinusoids"])
def test_clock_has_its_period(name):
    """With the clock the activation repeats after a period and differs in between."""
    policy, z = make(name, period=0.4), torch.ones(1, 4)
    torch.testing.assert_close(policy(z, at(0.1)), policy(z, at(0.5)), rtol=0, atol=1e-5)
    assert (policy(z, at(0.1)) - policy(z, at(0.27))).abs().max() > 0.01


@pytest.mark.parametrize("name", ["sinusoids", "knots"])
def test_open_loop_sees_nothing(name):
    """Open loop: features make no difference."""
    policy = make(name)
    assert torch.equal(policy(torch.zeros(2, 4), at(0.6)), policy(torch.randn(2, 4), at(0.6)))


def test_knots_are_joined_by_straight_lines():
    """At a knot its own value, between two their mean, after the end the last one."""
    policy = make("knots", knots=5)  # at 0, 0.5, 1, 1.5 and 2 s
    z, values = torch.zeros(1, 4), policy.values
    torch.testing.assert_close(policy(z, at(0.5))[0], torch.tanh(values[1]))
    torch.testing.assert_close(policy(z, at(0.75))[0], torch.tanh((values[1] + values[2]) / 2))
    torch.testing.assert_close(policy(z, at(2.0))[0], torch.tanh(values[4]))
    torch.testing.assert_close(policy(z, at(9.0))[0], torch.tanh(values[4]))


def test_goals_are_seen_in_units_of_their_box():
    """The centre of the box is 0, its corner ±1, an axis without spread always 0; a policy with a goal reacts to it."""
    goal = Goal(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.0]))
    torch.testing.assert_close(
        goal(torch.tensor([[1.5, 2.0], [0.5, 7.0]])), torch.tensor([[1.0, 0.0], [-1.0, 0.0]])
    )
    policy, z = make("linear", goal=goal), torch.zeros(1, 4)
    assert not torch.equal(
        policy(z, at(0.0), torch.tensor([[1.4, 2.0]])), policy(z, at(0.0), torch.tensor([[0.6, 2.0]]))
    )


def test_first_weights_are_scaled_by_the_number_of_inputs():
    """Whatever its width, a fresh policy answers features of order one with activations of the order of the gain."""
    for size in (4, 400):
        policy = make_policy(PolicyConf(name="linear", clock=False, gain=0.1), size, 50, 1.0, seed=0)
        spread = (
            policy(torch.randn(50, size, generator=torch.Generator().manual_seed(0)), at(0.0)).std().item()
        )
        assert math.isclose(spread, 0.1, rel_tol=0.2)


@pytest.mark.parametrize("name", ["linear", "mlp"])
def test_features_may_count_less_than_the_clock_at_first(name):
    """Features times the gain give the same; a policy without a clock has only them and takes them as they are."""
    z, time = torch.linspace(-1.0, 1.0, 4)[None], at(0.07)
    whole, less = make(name), make(name, feature_gain=0.3)
    assert torch.allclose(less(z, time), whole(0.3 * z, time)) and not torch.equal(
        less(z, time), whole(z, time)
    )
    blind = [make(name, clock=False, feature_gain=gain) for gain in (0.3, 1.0)]
    assert torch.equal(*(policy(z, time) for policy in blind))


@pytest.mark.parametrize("name", NAMES)
def test_many_control_steps_at_once_are_each_alone(name):
    """Features and times of many control steps give the activations of each."""
    policy, times = make(name, goal=Goal(torch.zeros(2), torch.ones(2))), torch.tensor([0.0, 0.3, 1.1, 2.5])
    z = torch.randn(4, 5, 4, generator=torch.Generator().manual_seed(0))
    goal = torch.rand(5, 2, generator=torch.Generator().manual_seed(1))
    each = torch.stack([policy(features, time, goal) for features, time in zip(z, times, strict=True)])
    torch.testing.assert_close(policy(z, times[:, None], goal), each)


def test_needs_muscles():
    """A scene without muscles is told so."""
    with pytest.raises(ValueError, match="no"):
        make_policy(PolicyConf(), 4, 0, 1.0, seed=0)
