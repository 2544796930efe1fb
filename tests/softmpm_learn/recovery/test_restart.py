"""A run that gets nowhere begins anew with other first weights."""

import csv
import dataclasses
import math

import pytest
import torch

from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.recovery.restart import Restart
from softmpm_learn.runs.run import Run
from softmpm_learn.storage import checkpoint
from softmpm_learn.train import train
from softmpm_learn.training import optimisation


def due(losses: list[float], after: int, above: float) -> list[int]:
    """Iterations after which the run begins anew."""
    conf, restart, found = OptimizerConf(restart_after=after, restart_above=above), Restart(), []
    for k, loss in enumerate(losses):
        if restart.is_due(loss, conf):
            restart = restart.next()
            found.append(k)
    assert restart.count == len(found)
    return found


def test_a_run_begins_anew_until_a_loss_is_low_enough():
    """After so many iterations without such a loss, of each attempt; one is enough for ever."""
    assert due([0.1] * 7, 3, -0.2) == [2, 5]
    assert due([0.1, -0.3, *[0.1] * 7], 3, -0.2) == []
    assert due([0.1, 0.1, 0.1, -0.3, 0.1, 0.1, 0.1], 3, -0.2) == [2]
    assert due([-0.2] * 3, 3, -0.2) == [2]  # not below
    assert due([math.inf, 5.0, math.inf], 2, math.inf) == []


@pytest.fixture
def restarting(settings):
    """Settings of a run that begins anew after three iterations, whatever happens."""
    return with_optimizer(settings, restart_above=-1e9, restart_after=3, halving=2.0)


def with_optimizer(settings, **conf):
    train = dataclasses.replace(settings.train, iterations=5, examine=False)
    return dataclasses.replace(
        settings, optimizer=dataclasses.replace(settings.optimizer, **conf), train=train
    )


def test_policy_design_and_rates_are_those_of_a_new_run(
    task, model, restarting, tmp_path, monkeypatch, caplog
):
    """Weights are others than the first and than those of the attempt after, and follow from the seed; the encoder is kept."""
    seen, real = {}, optimisation.attempt

    def attempt(runs, *args):
        (run,) = runs.all
        rates = [group["lr"] for group in run.optimizer.param_groups]
        parts = {name: [t.clone() for t in part.state_dict().values()] for name, part in run._moving.items()}
        seen[run.iteration] = (parts, rates, len(run.optimizer.state))
        return real(runs, *args)

    monkeypatch.setattr(optimisation, "attempt", attempt)
    conf = dataclasses.replace(restarting, train=dataclasses.replace(restarting.train, iterations=7))
    result = train(task, model, conf, tmp_path)
    (first, rates, _), (before, low, _), (anew, again, moments), (third, _, _) = (
        seen[k] for k in (0, 2, 3, 6)
    )
    assert low < rates == again and moments == 0
    for name in ("policy", "design", "observer"):
        same = all(torch.equal(a, b) for a, b in zip(anew[name], first[name], strict=True))
        kept = all(torch.equal(a, b) for a, b in zip(anew[name], before[name], strict=True))
        assert (same, kept) == {"policy": (False, False), "design": (True, False), "observer": (False, True)}[
            name
        ]
    assert not torch.equal(anew["policy"][0], third["policy"][0])
    other = Run(task, model, conf, tmp_path)
    other.begin_anew()
    assert all(
        torch.equal(a, b) for a, b in zip(other.policy.state_dict().values(), anew["policy"], strict=True)
    )
    with open(tmp_path / "metrics.csv", newline="") as file:
        assert [row["restarts"] for row in csv.DictReader(file)] == ["0", "0", "1", "0", "0", "1", "0"]
    assert result.run.restart.count == 2
    assert "in 3 iterations no loss was below -1e+09; beginning anew with other first weights" in caplog.text


def test_a_stopped_run_begins_anew_as_well(task, model, restarting, tmp_path):
    """Stopped within the count and after the restart, it equals the run that was not."""
    train(task, model, restarting, tmp_path / "whole")
    for stop_after in (2, 3, 5):
        conf = dataclasses.replace(
            restarting, train=dataclasses.replace(restarting.train, iterations=stop_after)
        )
        train(task, model, conf, tmp_path / "parts")
    one, other = ((tmp_path / name / "metrics.csv").read_bytes() for name in ("whole", "parts"))
    assert one == other
    whole, parts = (checkpoint.load(tmp_path / name) for name in ("whole", "parts"))
    assert whole["restart"] == parts["restart"] and whole["restart"]["count"] == 1


def test_a_run_does_not_go_back_to_what_is_not_worth_it(task, model, settings, tmp_path):
    """It begins anew instead, with the count of the times that it went back as it was."""
    run = Run(task, model, with_optimizer(settings, restart_above=-1.0), tmp_path)
    run.motions.best = {"loss": -0.5, "iteration": 3, **run.policy_snapshot()}
    assert run.fall_back() == "beginning anew with other first weights"
    assert (run.restart.count, run.fallback.count) == (1, 0)
    run.motions.best = {"loss": -1.5, "iteration": 4, **run.policy_snapshot()}
    assert run.fall_back() == "going back to iteration 4"
    assert (run.restart.count, run.fallback.count) == (1, 1)
