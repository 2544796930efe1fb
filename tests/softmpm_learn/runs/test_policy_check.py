"""Policies that are no functions of their inputs are refused before a run, by their names and with a remedy that works."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from torch import nn

import softmpm
from softmpm_learn import register
from softmpm_learn.policy import Goal, make_policy
from softmpm_learn.runs.policy_check import check_policy
from softmpm_learn.runs.run import Run
from softmpm_learn.settings import PolicyConf

TIMES = torch.arange(20) * 0.1


class Odd(nn.Module):
    """tanh of a layer, changed; a layer of zeros hides what is between it and the features."""

    def __init__(
        self, change: Callable = lambda u, time: u, between: nn.Module | None = None, zeros: bool = False
    ):
        super().__init__()
        self.between, self.layer, self.change = between or nn.Identity(), nn.Linear(3, 2), change
        if zeros:
            nn.init.zeros_(self.layer.weight)

    def forward(self, z, time, goal=None):
        return self.change(torch.tanh(self.layer(self.between(z))), time)


class Noise(nn.Module):
    """Drawn once, in the shape of a control step."""

    def __init__(self):
        super().__init__()
        self.register_buffer("drawn", torch.randn(3))

    def forward(self, z):
        return z + self.drawn


class Smooth(Odd):
    """With a memory of its last activation."""

    last = 0.0

    def forward(self, z, time, goal=None):
        self.last = 0.5 * self.last + 0.5 * super().forward(z, time)
        return self.last


class Walk(nn.Module):
    """Noise times a learned number that is 0 at first."""

    def __init__(self):
        super().__init__()
        self.size = nn.Parameter(torch.zeros(2))

    def forward(self, z, time, goal=None):
        return torch.tanh(self.size * torch.randn(*z.shape[:-1], 2).to(z))


def late(u, time):
    """Noise from 1 s on."""
    return u + (time > 1.0)[..., None] * 0.1 * torch.randn_like(u)


ODD = {
    "noise": lambda: Odd(lambda u, time: u + 0.01 * torch.randn_like(u)),
    "late noise": lambda: Odd(late),
    "dropout": lambda: Odd(between=nn.Dropout(0.5)),
    "hidden dropout": lambda: Odd(between=nn.Dropout(0.5), zeros=True),
    "learned noise": Walk,
    "memory": Smooth,
    "steps that see each other": lambda: Odd(lambda u, time: u - u.mean(dim=0) if u.dim() == 3 else u),
}  # fmt: skip
FINE = {
    "noise in a buffer": lambda: Odd(between=Noise()),
    "dropout that is off": lambda: Odd(between=nn.Dropout(0.5)).eval(),
    "activations that add up to 1": lambda: Odd(lambda u, time: u.softmax(dim=-1)),
    "zeros": lambda: Odd(lambda u, time: 0.0 * u),
    "no numbers": lambda: Odd(lambda u, time: (u - 2.0).log()),
}  # fmt: skip


def ask(policy: nn.Module, device="cpu", dtype=torch.float64) -> None:
    check_policy("odd", policy.to(device, dtype), 3, 2, TIMES.to(device, dtype), 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ODD)
def test_what_is_no_function_of_its_inputs_is_refused(kind, dtype):
    """Also where it shows late, or only in the gradient."""
    with pytest.raises(
        ValueError, match=r"policy odd must be a function of features, time and goal alone.*eval\(\)"
    ):
        ask(ODD[kind](), dtype=dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", FINE)
def test_functions_are_not_refused(kind, dtype):
    """The remedies that the message names, and policies whose numbers or gradients are none or cancel."""
    ask(FINE[kind](), dtype=dtype)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", [*ODD, *FINE])
def test_the_same_is_refused_on_a_gpu(kind):
    """Whose random numbers stay those of the run."""
    before = torch.cuda.get_rng_state()
    if kind in FINE:
        ask(FINE[kind](), "cuda", torch.float32)
    else:
        with pytest.raises(ValueError, match="policy odd must be a function"):
            ask(ODD[kind](), "cuda", torch.float32)
    assert torch.equal(torch.cuda.get_rng_state(), before)


def test_activations_of_another_shape_are_refused():
    """A policy of one control step alone."""
    with pytest.raises(
        ValueError,
        match=r"shape \(step, world, muscle\) = \(7, 2, 2\) for 7 control steps at once, got \(2, 2\)",
    ):
        ask(Odd(lambda u, time: u[-1] if u.dim() == 3 else u))


def test_an_open_loop_without_worlds_is_refused():
    """It forgets the axis; the sentence has the remedy, which is one."""
    wave = lambda time: torch.sin(time[..., None] * torch.tensor([1.0, 2.0]).double())  # noqa: E731
    with pytest.raises(
        ValueError, match=r"of shape \(world, muscle\) = \(2, 2\) for one control step, got \(2,\); .*expand"
    ):
        ask(Odd(lambda u, time: wave(time)))
    ask(Odd(lambda u, time: wave(time).expand(*u.shape[:-1], -1)))


def test_what_was_asked_is_said():
    """Where a policy fails on many control steps at once."""
    with pytest.raises(RuntimeError) as error:
        ask(Odd(lambda u, time: u + time * torch.ones(2).double()))
    assert (
        "asked for 7 control steps at once, with features of shape (7, 2, 3) and times of shape (7, 1)"
        in error.value.__notes__[0]
    )


@pytest.mark.parametrize("name", [name for name, entry in register.POLICIES.items() if entry.is_own])
@pytest.mark.parametrize("goal", [None, torch.rand(2, 2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_policies_of_the_package_are_not_refused(name, goal, dtype):
    """With goals and without, and a gain of 0 too; no random number of a run is used up."""
    box, before = Goal(torch.zeros(2), torch.ones(2)), torch.get_rng_state()
    for gain in (0.0, 1.0):
        conf = PolicyConf(name=name, gain=gain)
        policy = make_policy(conf, 3, 2, 2.0, seed=0, goal=None if goal is None else box).to(dtype)
        check_policy(name, policy, 3, 2, TIMES.to(dtype), 2, None if goal is None else goal.to(dtype))
    assert torch.equal(torch.get_rng_state(), before)


def test_a_run_is_refused_before_it_is_simulated(task, model, settings, tmp_path, monkeypatch):
    """By the name of its policy, with the random numbers of everything else as they were."""
    monkeypatch.setattr(register.POLICIES, "_entries", dict(register.POLICIES._all()))
    register.policy("noisy")(lambda conf, space: Walk())
    settings, before = dataclasses.replace(settings, policy=PolicyConf(name="noisy")), torch.get_rng_state()
    monkeypatch.setattr(softmpm, "simulate", lambda *args, **options: pytest.fail("simulated"))
    with pytest.raises(ValueError, match="policy noisy must be a function of features, time and goal alone"):
        Run(task, model, settings, tmp_path)
    assert torch.equal(torch.get_rng_state(), before)
