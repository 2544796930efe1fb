"""A run that stays far below its best goes back to it."""

import csv
import dataclasses
import math
from pathlib import Path

import pytest
import torch

from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.recovery.fallback import Fallback
from softmpm_learn.storage import checkpoint
from softmpm_learn.train import train
from softmpm_learn.training import optimisation

LOSSES = [-0.1, -0.5, -0.9, -0.4, -0.4, -0.4, -0.9, -0.8]
"""After the third the progress, 0.3, is below half of the best, 0.8, three times in a row."""


def due(losses: list[float], **conf) -> list[int]:
    """Iterations that end with a fallback."""
    fallback, best, found = Fallback(), math.inf, []
    for k, loss in enumerate(losses):
        best = min(best, loss) if not math.isnan(loss) else best
        if fallback.is_due(loss, best, OptimizerConf(**dict(fallback_from=0) | conf)):
            found.append(k)
    return found


def test_progress_counts_from_the_first_loss():
    """A loss that falls to zero and one that goes below it are judged alike: by the share of what was gained."""
    assert due(LOSSES, fallback_after=3) == [5] == due([loss + 2 for loss in LOSSES], fallback_after=3)
    assert due([-loss for loss in LOSSES], fallback_after=9) == []
    assert due(LOSSES, fallback_after=4) == [] == due(LOSSES, fallback_after=3, fallback_share=0.3)
    assert due(LOSSES, fallback_after=1, fallback_share=0.0) == []


def test_a_best_above_the_first_loss_is_not_below_itself():
    """A best that lasts may have a higher loss than a first motion that did not last: a loss like it goes on, half of it does not."""
    fallback = Fallback(first=-0.5)
    assert not fallback.is_below(-0.3, -0.3, 0.9) and not fallback.is_below(-0.4, -0.3, 0.9)
    assert fallback.is_below(-0.1, -0.3, 0.5) and fallback.is_below(math.inf, -0.3, 0.5)
    assert not Fallback().is_below(math.inf, -0.3, 0.5)


def test_the_first_iterations_do_not_count():
    """Where they would be the ones below the share."""
    assert due(LOSSES, fallback_after=3, fallback_from=3) == [5]
    assert due(LOSSES, fallback_after=3, fallback_from=4) == []


def test_only_iterations_in_a_row_count():
    """One that is better begins the count anew, and so does a fallback."""
    low, high, best = -0.4, -0.7, -0.9
    assert due([-0.1, best, low, low, high, low, low], fallback_after=3) == []
    assert due([-0.1, best, *[low] * 6], fallback_after=3) == [4, 7]


def test_a_loss_that_is_not_known_decides_nothing():
    """Between two evaluations at fixed goals iterations count, but only an evaluation sends the run back."""
    nan = math.nan
    assert due([-0.1, -0.9, nan, nan, nan, nan], fallback_after=2) == []
    assert due([-0.1, -0.9, nan, -0.4, nan, nan, -0.4, nan], fallback_after=4) == [6]
    assert due([-0.1, -0.9, nan, -0.4, nan, nan, -0.8, nan], fallback_after=4) == []
    assert due([nan, -0.1, -0.9, -0.4], fallback_after=1) == [3]


@pytest.fixture
def scripted(monkeypatch):
    """Makes the losses those of :data:`LOSSES`; gives what moved the robot in each iteration and the rates."""
    seen, real = {}, optimisation.attempt

    def attempt(runs, *args):
        (episode, rows), (run,) = real(runs, *args), runs.all
        rates = [group["lr"] for group in run.optimizer.param_groups]
        moments = [*run.optimizer.state, *run.learner.optimizer.state]
        seen[run.iteration] = (run.policy_snapshot(), rates, len(moments))
        return episode, {0: rows[0] | {"loss": LOSSES[run.iteration]}}

    monkeypatch.setattr(optimisation, "attempt", attempt)
    return seen


@pytest.fixture
def falling(settings):
    optimizer = dataclasses.replace(
        settings.optimizer, halving=None, fallback_after=3, fallback_from=0, settle=0.0
    )
    learning = dataclasses.replace(settings.learning, every=2)
    conf = dataclasses.replace(settings.train, iterations=len(LOSSES), examine=False)
    return dataclasses.replace(settings, optimizer=optimizer, learning=learning, train=conf)


def equal(one: dict, other: dict) -> bool:
    return all(torch.equal(one[part][k], other[part][k]) for part in one for k in one[part])


@pytest.mark.parametrize("target_network", [True, False])
def test_the_run_goes_back_to_its_best(task, model, falling, tmp_path, scripted, caplog, target_network):
    """Policy, design and autoencoder of the best iteration, half the rates, no moments of any; counted and logged."""
    learning = dataclasses.replace(falling.learning, target_network=target_network, every=99)
    result = train(task, model, dataclasses.replace(falling, learning=learning), tmp_path)
    (best, rates, _), (low, _, _), (again, smaller, moments) = (scripted[k] for k in (2, 5, 6))
    assert not equal(low, best) and equal(again, best)
    assert smaller == [rate / 2 for rate in rates] and moments == 0
    assert not equal(scripted[7][0], again)  # it goes on from there
    with open(tmp_path / "metrics.csv", newline="") as file:
        assert [row["fallbacks"] for row in csv.DictReader(file)] == ["0"] * 5 + ["1"] + ["0"] * 2
    assert result.run.fallback.count == 1
    assert "progress was below 0.5 of the best; going back to iteration 2" in caplog.text


def test_a_killed_run_goes_back_as_well(task, model, falling, tmp_path, scripted):
    """Stopped within the count and after the fallback, it equals the run that was not, rates included."""
    train(task, model, falling, tmp_path / "whole")
    for stop_after in (5, 6, len(LOSSES)):
        conf = dataclasses.replace(falling, train=dataclasses.replace(falling.train, iterations=stop_after))
        train(task, model, conf, tmp_path / "parts")
    files = [Path(tmp_path / name / "metrics.csv").read_bytes() for name in ("whole", "parts")]
    assert files[0] == files[1]
    whole, parts = (checkpoint.load(tmp_path / name) for name in ("whole", "parts"))
    assert whole["fallback"] == parts["fallback"] and whole["fallback"]["count"] == 1
    assert whole["optimizer"]["param_groups"] == parts["optimizer"]["param_groups"]
    assert equal({"policy": whole["policy"]}, {"policy": parts["policy"]})
