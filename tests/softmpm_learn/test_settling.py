"""The last iterations of a run: from its best, with ever smaller steps, through features that stay as they are."""

import csv
import dataclasses
import math

import pytest
import torch

from softmpm_learn import checkpoint, optimisation
from softmpm_learn.fallback import Fallback
from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.settling import begins, pace
from softmpm_learn.train import train

LOSSES = [-0.1, -0.5, -0.9, -0.6, -0.7, -0.85, -0.7, -0.95, -0.9, -0.92]
"""The best before the last six is the third; of these the third is below 0.9 of the progress."""
SETTLE = 0.6
FIRST = 4


def test_the_pace_falls_in_the_last_iterations():
    """In equal steps, towards zero after the last; nothing changes in a run without."""
    assert [pace(k, 10, 0.45) for k in range(10)] == pytest.approx([1] * 6 + [0.8, 0.6, 0.4, 0.2])
    assert [k for k in range(10) if begins(k, 10, 0.45)] == [6]
    assert [pace(k, 4, 0.2) for k in range(4)] == [1.0] * 4 == [pace(k, 4, 0.0) for k in range(4)]
    assert not any(begins(k, 4, settle) for k in range(4) for settle in (0.0, 0.2))


def test_a_run_that_settles_goes_back_at_once():
    """After a single loss below 0.9 of the best progress, where another one waits for five below a half."""
    conf, due = OptimizerConf(fallback_from=0), []
    for settles in (False, True):
        fallback = Fallback()
        fallback.is_due(0.0, 0.0, conf)
        due.append([fallback.is_due(loss, -1.0, conf, settles) for loss in (-0.91, math.nan, -0.89)])
    assert due == [[False] * 3, [False, False, True]]
    assert not Fallback(first=0.0).is_due(-0.1, -1.0, OptimizerConf(fallback_share=0.0), True)


@pytest.fixture
def scripted(monkeypatch):
    """Makes the losses those of :data:`LOSSES`; gives policy and encoder of each iteration, and the length of its step in units of the
    first."""
    seen, real, step = {}, optimisation.attempt, torch.optim.Adam.step
    paces = {}

    def attempt(runs, *args):
        (episode, rows), (run,) = real(runs, *args), runs.all
        seen[run.iteration] = run.policy_snapshot()
        seen["now"] = run
        return episode, {0: rows[0] | {"loss": LOSSES[run.iteration]}}

    def scaled(self, *args):
        if "now" in seen and self is seen["now"].optimizer:
            paces[seen["now"].iteration] = self.param_groups[0]["lr"] / seen["now"]._first_rates[0]
        return step(self, *args)

    monkeypatch.setattr(optimisation, "attempt", attempt)
    monkeypatch.setattr(torch.optim.Adam, "step", scaled)
    return seen, paces


@pytest.fixture
def conf(settings):
    optimizer = dataclasses.replace(settings.optimizer, halving=None, settle=SETTLE, fallback_from=0)
    learning = dataclasses.replace(settings.learning, every=2)
    some = dataclasses.replace(settings.train, iterations=len(LOSSES), examine=False)
    return dataclasses.replace(settings, optimizer=optimizer, learning=learning, train=some)


def equal(one: dict, other: dict, *names: str) -> bool:
    return all(torch.equal(one[part][k], other[part][k]) for part in names or one for k in one[part])


def test_a_run_settles_from_its_best(task, model, conf, tmp_path, scripted, caplog):
    """It goes back to iteration 2 as it begins and once more, the steps get smaller, and no feature changes; it ends at its best."""
    result = train(task, model, conf, tmp_path)
    seen, paces = scripted
    assert not equal(seen[FIRST], seen[2]) and equal(seen[FIRST + 1], seen[2])
    assert "Iteration 4: the run settles; going back to iteration 2" in caplog.text
    assert "Iteration 6: the progress was below 0.9 of the best; going back to iteration 2" in caplog.text
    assert equal(seen[7], seen[2]) and not equal(seen[8], seen[7])
    assert all(equal(seen[k], seen[2], "observer") for k in range(5, 10))
    assert not equal(seen[4], seen[2], "observer")  # learning phases before
    assert paces == pytest.approx({0: 1, 1: 1, 2: 1, 3: 1, 5: 0.5 * 5 / 7, 7: 0.25 * 3 / 7, 8: 0.25 * 2 / 7})
    assert equal(result.run.policy_snapshot(), seen[7])
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["fallbacks"] for row in rows] == ["0"] * 4 + ["1", "0", "1", "0", "0", "1"]
    assert [k for k, row in enumerate(rows) if row["epochs"]] == [0, 1, 3]


def test_without_a_gait_a_run_does_not_settle(task, model, conf, tmp_path, scripted):
    """What has found nothing by then goes on looking for it, and learns."""
    optimizer = dataclasses.replace(conf.optimizer, restart_above=-2.0, restart_after=99, fallback_share=0.0)
    train(task, model, dataclasses.replace(conf, optimizer=optimizer), tmp_path)
    assert scripted[1] == dict.fromkeys(range(10), 1.0)


def test_a_killed_run_settles_as_well(task, model, conf, tmp_path, scripted):
    """Stopped within its last iterations it equals the run that was not."""
    train(task, model, conf, tmp_path / "whole")
    for after in (5, 8, 99):
        asked = iter([False] * after + [True])
        train(task, model, conf, tmp_path / "parts", stop=lambda asked=asked: next(asked))
    one, other = ((tmp_path / name / "metrics.csv").read_bytes() for name in ("whole", "parts"))
    assert one == other
    whole, parts = (checkpoint.load(tmp_path / name) for name in ("whole", "parts"))
    assert equal({"policy": whole["policy"]}, {"policy": parts["policy"]})
