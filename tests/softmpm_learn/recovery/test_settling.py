"""The last iterations of a run: from its best, with ever smaller steps, through features that stay as they are."""

import dataclasses
import math

import pytest
import torch
from learners import changed, rows_of

from softmpm_learn.command.pictures import curves
from softmpm_learn.optimizer_settings import OptimizerConf
from softmpm_learn.recovery.fallback import Fallback
from softmpm_learn.recovery.settling import Settling, iterations, pace
from softmpm_learn.runs.identity import SettingsError
from softmpm_learn.runs.run import Run
from softmpm_learn.storage import checkpoint
from softmpm_learn.train import train
from softmpm_learn.training import optimisation

LOSSES = [-0.1, -0.5, -0.9, -0.6, -0.7, -0.85, -0.7, -0.95, -0.9, -0.92]
"""The best before the last six is the third; of these the third is below 0.9 of the progress."""
SETTLE = 0.6
FIRST = 4


def test_the_pace_falls_in_the_last_iterations():
    """In equal steps, towards zero after the last; a run too short for three such iterations does without."""
    assert [iterations(total, 0.2) for total in (4, 14, 15, 60)] == [0, 0, 3, 12]
    assert iterations(60, 0.0) == 0
    assert [pace(left, 4) for left in (4, 3, 2, 1)] == pytest.approx([0.8, 0.6, 0.4, 0.2])


def test_whether_a_run_settles_is_decided_once():
    """In the first of the iterations; what has found nothing by then does not settle."""
    settling = Settling()
    assert [settling.begins(left, 3, True) for left in (5, 4, 3, 2, 1)] == [False, False, True, False, False]
    assert settling.active and not settling.begins(3, 3, False) and not settling.active
    assert not settling.begins(2, 3, True) and not settling.active


def test_a_run_that_settles_goes_back_at_once():
    """After a single loss below 0.9 of the best progress, where another one waits for five below a half, also soon after a restart."""
    conf, due = OptimizerConf(), []
    for settles in (False, True):
        fallback = Fallback()
        fallback.is_due(0.0, 0.0, conf)
        due.append([fallback.is_due(loss, -1.0, conf, settles) for loss in (-0.91, math.nan, -0.89)])
    assert due == [[False] * 3, [False, False, True]]
    assert not Fallback(first=0.0).is_due(-0.1, -1.0, OptimizerConf(fallback_share=0.0), True)


@pytest.fixture
def scripted(monkeypatch):
    """Makes the losses those of a list; gives that, what moved the robot in each iteration, and the length of its step in units of the
    first rate."""
    losses, seen, paces, real, step = list(LOSSES), {}, {}, optimisation.attempt, torch.optim.Adam.step

    def attempt(runs, *args):
        (episode, rows), (run,) = real(runs, *args), runs.all
        seen[run.iteration] = run.policy_snapshot()
        seen["now"] = run
        return episode, {0: rows[0] | {"loss": losses[run.iteration]}}

    def scaled(self, *args):
        if "now" in seen and self is seen["now"].optimizer:
            paces[seen["now"].iteration] = self.param_groups[0]["lr"] / seen["now"]._first_rates[0]
        return step(self, *args)

    monkeypatch.setattr(optimisation, "attempt", attempt)
    monkeypatch.setattr(torch.optim.Adam, "step", scaled)
    return losses, seen, paces


@pytest.fixture
def conf(settings):
    optimizer = dataclasses.replace(settings.optimizer, halving=None, settle=SETTLE)
    learning = dataclasses.replace(settings.learning, every=2)
    some = dataclasses.replace(settings.train, iterations=len(LOSSES), examine=False)
    return dataclasses.replace(settings, optimizer=optimizer, learning=learning, train=some)


def equal(one: dict, other: dict, *names: str) -> bool:
    return all(torch.equal(one[part][k], other[part][k]) for part in names or one for k in one[part])


@pytest.mark.parametrize("target_network", [True, False])
def test_a_run_settles_from_its_best(task, model, conf, tmp_path, scripted, caplog, target_network):
    """It goes back to iteration 2 as it begins and once more, the steps get smaller, and no feature changes; it ends at its best."""
    caplog.set_level("INFO", "softmpm_learn")
    _, seen, paces = scripted
    result = train(task, model, changed(conf, learning=dict(target_network=target_network)), tmp_path)
    assert not equal(seen[FIRST], seen[2]) and equal(seen[FIRST + 1], seen[2])
    levels = {record.getMessage(): record.levelname for record in caplog.records}
    assert levels["Iteration 4: the run settles; going back to iteration 2."] == "INFO"
    assert levels["Iteration 9: the run ends; going back to iteration 7."] == "INFO"
    far = "Iteration 6: the progress was below 0.9 of the best; going back to iteration 2."
    assert levels[far] == "WARNING"
    assert equal(seen[7], seen[2]) and not equal(seen[8], seen[7])
    assert all(equal(seen[k], seen[2], "observer") for k in range(5, 10))
    assert not equal(seen[4], seen[2], "observer")  # learning phases before
    assert paces == pytest.approx({0: 1, 1: 1, 2: 1, 3: 1, 5: 0.5 * 5 / 7, 7: 0.25 * 3 / 7, 8: 0.25 * 2 / 7})
    assert equal(result.run.policy_snapshot(), seen[7])
    assert [row["fallbacks"] for row in rows_of(tmp_path)] == ["0"] * 6 + ["1"] + ["0"] * 3
    assert [k for k, row in enumerate(rows_of(tmp_path)) if row["epochs"]] == [0, 1, 3]


def test_a_best_that_comes_last_is_the_end(task, model, conf, tmp_path, scripted):
    """No step is taken after it; and one that comes first in settling is no reason to go back."""
    losses, seen, paces = scripted
    losses[FIRST], losses[-1] = -0.96, -0.97
    result = train(task, model, conf, tmp_path)
    assert result.best_iteration == 9 and equal(result.run.policy_snapshot(), seen[9])
    assert not equal(seen[FIRST + 1], seen[FIRST]) and paces[FIRST] == pytest.approx(6 / 7)


def test_without_a_gait_a_run_does_not_settle(task, model, conf, tmp_path, scripted):
    """What has found nothing by then goes on looking for it and learning, also if it is found later."""
    losses, _, paces = scripted
    losses[6] = -2.5
    optimizer = dict(restart_above=-2.0, restart_after=99, fallback_share=0.0)
    train(task, model, changed(conf, optimizer=optimizer), tmp_path)
    assert paces == dict.fromkeys(range(10), 1.0)
    assert [k for k, row in enumerate(rows_of(tmp_path)) if row["epochs"]] == [0, 1, 3, 5, 7, 9]


def test_a_run_that_settles_does_not_begin_anew(task, model, conf, tmp_path):
    """Although no loss of an episode since its last beginning is low enough: it has a best, that of an evaluation."""
    for settles, anew in ((True, 0), (False, 1)):
        run = Run(task, model, changed(conf, optimizer=dict(restart_above=-1.0)), tmp_path)
        run.motions.best = {"loss": -1.5, "iteration": 2, **run.policy_snapshot()}
        run.iteration, run.restart.iterations, run.settling.active = 6, 99, settles
        optimisation.step(run, 0.0, math.nan)
        assert run.returns == {"fallbacks": 0, "restarts": anew}


def test_a_killed_run_settles_as_well(task, model, conf, tmp_path, scripted):
    """Stopped twice within its last iterations it equals the run that was not."""
    train(task, model, conf, tmp_path / "whole")
    for more in (5, 2, 99):
        asked = iter([False] * more + [True])
        train(task, model, conf, tmp_path / "parts", stop=lambda asked=asked: next(asked))
    one, other = ((tmp_path / name / "metrics.csv").read_bytes() for name in ("whole", "parts"))
    assert one == other
    whole, parts = (checkpoint.load(tmp_path / name) for name in ("whole", "parts"))
    assert equal({"policy": whole["policy"]}, {"policy": parts["policy"]})
    assert whole["optimizer"]["param_groups"] == parts["optimizer"]["param_groups"]
    assert [whole[name] for name in ("fallback", "settling")] == [
        parts[name] for name in ("fallback", "settling")
    ]
    assert whole["best"]["iteration"] == parts["best"]["iteration"] == 7


def test_the_end_is_simulated_once_more(task, model, conf, tmp_path):
    """On a CPU with the value of the best, to the last bit; beside the examination, and in no curve of the evaluations."""
    result = train(task, model, changed(conf, train=dict(examine=True)), tmp_path)
    *_, last = rows_of(tmp_path)
    assert float(last["end"]) == result.best_loss == result.examination["end"] and not last["evaluation"]
    assert not any(
        values for name, (_, values) in curves(tmp_path / "metrics.csv").items() if "evaluation" in name
    )


def test_the_last_iteration_is_evaluated(task, model, conf, tmp_path):
    """Or the smallest steps would be taken for nothing."""
    evaluations = dict(endurance=2, evaluate_every=4)
    train(task, model, changed(conf, train=evaluations), tmp_path / "settles")
    train(task, model, changed(conf, train=evaluations, optimizer=dict(settle=0.0)), tmp_path / "never")
    found = {
        name: [k for k, row in enumerate(rows_of(tmp_path / name)) if row["evaluation"]]
        for name in ("settles", "never")
    }
    assert found == {"settles": [0, 3, 7, 9], "never": [0, 3, 7]}


def test_a_checkpoint_from_before_does_not_settle(task, model, conf, tmp_path):
    """It goes on as it began, where that is asked for, and says what is different where it is not."""
    plain = changed(conf, optimizer=dict(settle=0.0))
    run = Run(task, model, plain, tmp_path)
    content = run.state_dict()
    content["about"] = content["about"].replace('"optimizer.settle": 0.0, ', "")
    del content["settling"]
    assert "settle" not in content["about"]
    Run(task, model, plain, tmp_path / "same").load_state_dict(content)
    with pytest.raises(SettingsError, match=r"optimizer\.settle: 0\.0 then, 0\.6 now"):
        Run(task, model, conf, tmp_path / "other").load_state_dict(content)
