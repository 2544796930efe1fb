"""Failures of single worlds that are counted instead of raised: the world stops, the others never notice."""

import pickle

import pytest
import torch
from helpers import bar

import softmpm

FIELDS = ("x", "v", "C", "F")


def kicked(scheme, device, worlds=3, kick=400.0, dtype=torch.float32):
    """Three bars, the second of which has one particle that flies off the grid after some substeps."""
    model = softmpm.build(bar(), device=device, worlds=worlds, scheme=scheme, dtype=dtype)
    start = model.rest()
    start.v[:, :, 1] = torch.linspace(0.1, 0.3, worlds, dtype=dtype, device=model.device)[:, None]
    start.v[..., 0] = start.x[..., 0] - 0.5  # it vibrates
    bad = start.clone()
    bad.v[1, 5, 0] = kick
    return model, start, bad


def simulate(model, start, substeps=150, **options):
    return softmpm.simulate(model, start, None, model.params(), substeps=substeps, **options)


@pytest.mark.parametrize("policy", ["freeze", "reset"])
def test_a_failed_world_stops_and_the_others_go_on(policy, scheme, device):
    """It returns finite and in its place, is reported with what would have been raised, and the others are the same bits."""
    model, start, bad = kicked(scheme, device)
    with pytest.raises(softmpm.UnstableError) as caught:
        simulate(model, bad)
    failures = softmpm.Failures(policy)
    end, reset_status = simulate(model, bad, failures=failures), simulate(model, start)
    assert len(failures) == 1 and failures.worlds == [1] and str(failures.errors[0]) == str(caught.value)
    for name in FIELDS:
        got, want = getattr(end, name), getattr(reset_status, name)
        if model.device.type == "cpu":
            assert torch.equal(got[[0, 2]], want[[0, 2]]), name
        else:
            torch.testing.assert_close(got[[0, 2]], want[[0, 2]], rtol=1e-4, atol=1e-4)
        assert torch.isfinite(got).all()
    stopped = bad if policy == "freeze" else model.rest()  # it failed in the first chunk
    torch.testing.assert_close(end.x[1], stopped.x[1], rtol=0, atol=1e-6)
    torch.testing.assert_close(end.v[1], stopped.v[1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("budget", [None, "little"])
def test_a_failed_world_gives_no_gradient(budget, scheme, device):
    """Its gradient is zero, that of the others is what it is without it, also where chunks are recomputed."""
    model, start, bad = kicked(scheme, device)
    if budget:
        sizes = model.sizes()
        little = 40 * (sizes.inside + sizes.nodes) + 3 * sizes.between
        model = softmpm.build(model.scene, device=device, worlds=3, scheme=scheme, memory_budget=little)

    def gradient(given, failures):
        v, params = given.v.clone().requires_grad_(), model.params()
        young = params.young.expand(3, -1).clone().requires_grad_()
        end = softmpm.simulate(
            model, given._replace(v=v), None, params._replace(young=young), substeps=300, failures=failures
        )
        return torch.autograd.grad(end.x.square().sum() + end.F.sum(), (v, young))

    failures = softmpm.Failures("freeze")
    for got, want in zip(gradient(bad, failures), gradient(start, None), strict=True):
        assert (got[1] == 0).all() and want[1].abs().max() > 0
        torch.testing.assert_close(got[[0, 2]], want[[0, 2]], rtol=1e-4, atol=1e-5 * want.abs().max().item())
    assert failures.worlds == [1]


def test_a_start_off_the_grid_comes_back_as_it_was(scheme, device):
    """It is counted once, returns unchanged, and has no gradient, whatever its kernels would make of it."""
    model, start, _ = kicked(scheme, device)
    start.x[1, 4] = 1e15
    start.v.requires_grad_()
    failures = softmpm.Failures("freeze")
    end = simulate(model, start, failures=failures)
    assert failures.worlds == [1] and [error.kind for error in failures.errors] == ["start"]
    assert torch.equal(end.x[1], start.x[1]) and torch.isfinite(end.F).all()
    (grad,) = torch.autograd.grad(end.F.sum() + end.v.sum(), start.v)
    assert (grad[1] == 0).all() and grad[0].abs().max() > 0


def test_every_world_may_fail_at_a_time_of_its_own(scheme, device):
    """Two worlds fail in different chunks, one of them at its start; each is named with its own substep."""
    model, bad, _ = kicked(scheme, device)
    bad.v[1, :, 0] = 1.0  # it leaves the grid after some 280 substeps
    bad.F[2, 7] = -bad.F[2, 7].flip(-1)
    failures = softmpm.Failures("reset")
    end = simulate(model, bad, substeps=600, failures=failures)
    assert failures.worlds == [1, 2] and {e.world: e.kind for e in failures.errors}[2] == "start"
    assert torch.isfinite(end.x).all() and failures.errors[-1].substep > 128


def test_failures_cross_processes_and_refuse_other_policies():
    """They are pickled with their errors; a policy that is none is refused with those that are."""
    failures = softmpm.Failures("reset")
    simulate(*(lambda model, _, bad: (model, bad))(*kicked("plain", "cpu")), failures=failures)
    again = pickle.loads(pickle.dumps(failures))
    assert again.policy == "reset" and [str(e) for e in again.errors] == [str(e) for e in failures.errors]
    with pytest.raises(ValueError, match="policy must be one of freeze, reset, got 'ignore'"):
        softmpm.Failures("ignore")
