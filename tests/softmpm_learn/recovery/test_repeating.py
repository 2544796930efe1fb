"""The best of a run repeats itself: it is evaluated again, and gives way to the next best where that says something else."""

import csv
import dataclasses
import math

import pytest
import torch

import softmpm
from softmpm_learn.lasting import AGAIN, FURTHER, STARTS, Lasting
from softmpm_learn.objective import Progress, Tilt
from softmpm_learn.recovery.motions import OTHERS
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.storage import checkpoint
from softmpm_learn.train import train
from softmpm_learn.training import evaluation
from softmpm_learn.training.evaluation import ROUNDS, Evaluation, evaluate_best

INF = math.inf


@pytest.fixture
def run(task, model, settings, tmp_path):
    """One that settles, with a first loss of 0.5 and four bests, the weights of whose policies are their iterations."""
    run = Run(task, model, settings, tmp_path)
    run.fallback.first, run.settling.active = 0.5, True
    for run.iteration, (loss, lasts) in enumerate([(0.4, False), (-0.9, False), (-0.5, True), (-1.5, True)]):
        for weights in run.policy.parameters():
            torch.nn.init.constant_(weights, run.iteration)
        run.keep(loss, lasts)
    run.iteration = 9
    return run


@pytest.mark.parametrize(
    "again, repeats, left",
    [
        ((-1.1, True), True, [3, 2, 1, 0]),  # exactly 0.8 of the progress of 2
        ((-9.0, True), True, [3, 2, 1, 0]),
        ((-1.09, True), False, [3, 2, 1, 0]),
        ((-0.4, True), False, [2, 3, 1, 0]),
        ((-1.4, False), False, [2, 3, 1, 0]),
        ((-0.8, False), False, [2, 1, 3, 0]),
        ((INF, False), False, [2, 1, 0, 3]),
    ],
)
def test_a_best_that_does_not_repeat_itself(run, again, repeats, left):
    """It counts by the worse value among the others, and one that fails comes last."""
    first = run.best["loss"]
    assert run.recount(*again) is repeats
    assert [one["iteration"] for one in run.motions.all] == left
    values = {one["iteration"]: (one["loss"], one["lasts"]) for one in run.motions.all}
    assert values[3] == ((first, True) if repeats else again)
    assert all((weights == left[0]).all() for weights in run.best["policy"].values())


def test_a_best_that_is_not_worth_it_need_not_repeat_itself(task, model, settings, tmp_path):
    """What comes to be such a one does not last, however long, and stands behind what walks."""
    optimizer = dataclasses.replace(settings.optimizer, restart_above=-0.5)
    run = Run(task, model, dataclasses.replace(settings, optimizer=optimizer), tmp_path)
    run.fallback.first = 0.0
    run.keep(0.1, True)
    assert (
        not run.motions.best_is_worth_it
        and run.recount(0.3, True)
        and run.recount(INF, False)
        and run.best["loss"] == 0.1
    )
    run.keep(-1.4, False)
    run.keep(-1.5, True)
    assert not run.recount(-0.1, True) and run.motions.best_is_worth_it
    assert [(one["loss"], one["lasts"]) for one in run.motions.all] == [
        (-1.4, False),
        (-0.1, False),
        (0.1, False),
    ]


def test_the_first_loss_stays_when_a_run_begins_anew(run):
    """Or nothing could be told from it until the next evaluation."""
    run.begin_anew()
    assert run.fallback.first == 0.5 and run.fallback.iterations == 0 and not run.recount(-0.4, True)


def test_the_next_best_are_kept(run):
    """The best of those that were not, and of several alike the first; what is not known is none of them."""
    found = {4: -1.2, 5: -0.3, 6: -1.6, 7: math.nan, 8: -1.2, 9: INF}
    for run.iteration, loss in found.items():
        run.keep(loss, True)
    assert [one["iteration"] for one in run.motions.all] == [6, 3, 4, 8, 2, 5, 1] and OTHERS == 6
    assert all((weights == 3).all() for weights in run.motions.others[0]["policy"].values())


def test_a_checkpoint_has_the_next_best(run, task, model, settings, tmp_path):
    """One from before has none, and one with weights of another shape is not this run's."""
    other = Run(task, model, settings, tmp_path / "other")
    other.load_state_dict(run.state_dict())
    assert [one["iteration"] for one in other.motions.others] == [2, 1, 0]
    before = {name: value for name, value in run.state_dict().items() if name != "others"}
    other.load_state_dict(before)
    assert other.motions.others == [] and other.best["iteration"] == 3
    policy = {name: weights[..., :-1] for name, weights in run.best["policy"].items()}
    with pytest.raises(RuntimeError, match="size mismatch"):
        other.load_state_dict(before | {"others": [run.best | {"policy": policy}]})


@pytest.fixture
def scripted(monkeypatch):
    """Makes the further evaluations those of a list for each run; gives that, and the weight that each was made with."""
    answers, asked = {}, []

    def simulate(runs, of, starts):
        assert starts == runs.evaluator.again
        asked.append({k: next(runs.all[k].policy.parameters()).flatten()[0].item() for k in of})
        return {k: Evaluation(*answers[k].pop(0)) for k in of}

    monkeypatch.setattr(evaluation, "simulate", simulate)
    return answers, asked


def test_the_next_one_is_evaluated_until_one_repeats(run, scripted, caplog):
    """The next best, and so on; the policy is that of the best then, and the log says what happened."""
    caplog.set_level("INFO", "softmpm_learn")
    answers, asked = scripted
    answers[0] = [(INF, False), (-0.2, True), (-0.2, True)]
    assert evaluate_best(Runs([run]), [0]) == {0: Evaluation(-0.2, True)}
    assert asked == [{0: 3.0}, {0: 2.0}, {0: 2.0}] and (run.best["iteration"], run.best["loss"]) == (2, -0.2)
    first, second = (record.getMessage() for record in caplog.records)
    both = "Iteration 9: evaluated again, the best has "
    assert first == f"{both}inf instead of -1.5 and does not last; the best is that of iteration 2 now."
    assert second == f"{both}-0.2 instead of -0.5; the best is that of iteration 2 now."


@pytest.mark.parametrize("others", [True, False])
def test_where_all_fail_the_best_is_kept(run, scripted, others, caplog):
    """There is nothing to go back to; its further evaluation says that it failed."""
    caplog.set_level("INFO", "softmpm_learn")
    answers, asked = scripted
    run.motions.others = run.motions.others if others else []
    before, tried = run.motions.all, [3.0, 2.0, 1.0, 0.0] if others else [3.0]
    answers[0] = [(INF, False)] * 4
    assert evaluate_best(Runs([run]), [0]) == {0: Evaluation(INF, False)}
    assert [one[0] for one in asked] == tried and run.motions.all == before
    assert next(run.policy.parameters()).flatten()[0] == 3.0
    assert caplog.messages[-1].endswith("no other is better.") and len(caplog.messages) == len(tried)


def test_a_run_that_does_not_settle_keeps_its_best(run, scripted):
    """It could go on, and would not be the unbroken run then."""
    run.settling.active, (answers, asked) = False, scripted
    answers[0] = [(INF, False)]
    assert evaluate_best(Runs([run]), [0]) == {0: Evaluation(INF, False)} and len(asked) == 1
    assert run.best["iteration"] == 3 and run.best["loss"] == -1.5


def test_there_is_an_end_to_it(run, scripted):
    """The last evaluation stands and belongs to the best, whose value is the one before."""
    run.motions.others, (answers, asked) = [], scripted
    values = [0.5 - 2 * 0.7**k for k in range(1, 20)]
    answers[0] = [(value, True) for value in values]
    assert evaluate_best(Runs([run]), [0]) == {0: Evaluation(values[ROUNDS - 1], True)}
    assert len(asked) == ROUNDS and run.best["loss"] == values[ROUNDS - 2]


def test_runs_side_by_side_go_back_on_their_own(task, settings, tmp_path, scripted):
    """What repeats itself is not evaluated again for the sake of another."""
    model, answers, asked = softmpm.build(task.scene, device="cpu", worlds=2), *scripted
    runs = Runs([Run(task, model, settings, tmp_path / str(k), runs=2) for k in range(2)])
    for number, one in enumerate(runs.all):
        one.fallback.first = 0.0
        for one.iteration in range(2):
            for weights in one.policy.parameters():
                torch.nn.init.constant_(weights, 10 * number + one.iteration)
            one.keep(-1.0 - one.iteration, True)
        one.settling.active, one.iteration = True, 9
    answers |= {0: [(-1.9, True)], 1: [(-0.1, True), (-0.9, True)]}
    found = evaluate_best(runs, [0, 1])
    assert asked == [{0: 1.0, 1: 11.0}, {1: 10.0}] and [one.best["iteration"] for one in runs.all] == [1, 0]
    assert found == {0: Evaluation(-1.9, True), 1: Evaluation(-0.9, True)}


@pytest.fixture
def conf(settings):
    """Settings of a run that settles in the last four of ten iterations and is evaluated in every other one."""
    optimizer = dataclasses.replace(settings.optimizer, settle=0.4)
    some = dataclasses.replace(settings.train, iterations=10, evaluate_every=2, endurance=2, examine=True)
    return dataclasses.replace(settings, optimizer=optimizer, train=some)


def script(monkeypatch, values: dict[int, float], again: list[float]) -> list[int]:
    """Makes the evaluations of iterations these values, and the further ones those of a list; gives the iterations of the latter."""
    asked = []

    def simulate(runs, of, starts):
        (run,) = runs.all
        value = values[run.iteration]
        if starts == AGAIN:
            asked.append(run.iteration)
            value = again.pop(0)
        return {0: Evaluation(value, True)}

    monkeypatch.setattr(evaluation, "simulate", simulate)
    return asked


@pytest.fixture
def lasting(task):
    """The task, whose motion should last."""
    x = task.scene.bodies[0].particles.positions
    term = Progress()
    tilt = Tilt(front=[30, 31], back=[0, 1], rest=x)
    return dataclasses.replace(task, lasting=Lasting(progress=term, tilt=tilt, seconds=task.seconds))


VALUES = {0: 0.0, 1: -1.0, 3: -2.0, 5: -1.9, 6: 0.0, 7: -1.3, 9: -1.5, 10: 0.0}


def test_a_run_settles_from_a_best_that_repeats_itself(lasting, model, conf, tmp_path, monkeypatch):
    """Those of iterations 3 and 5 do not in iteration 6, so that of iteration 1 takes their place, and its successors are better.

    At the end the best fails, and the run ends at the next one: in memory, in the checkpoint and in the tables.
    """
    asked = script(monkeypatch, VALUES, [-0.9, -0.9, -0.9, INF, -1.25])
    result = train(lasting, model, conf, tmp_path)
    assert asked == [6, 6, 6, 10, 10] and result.run.settling.active
    assert (result.best_iteration, result.best_loss, result.examination["end"]) == (7, -1.3, -1.25)
    saved = checkpoint.load(tmp_path)
    assert saved["best"]["iteration"] == 7 and [one["iteration"] for one in saved["others"]] == [
        1,
        5,
        3,
        0,
        9,
    ]
    for name, part in (("policy", result.run.policy), ("observer", result.run.observer)):
        for key, value in part.state_dict().items():
            assert torch.equal(value, saved["best"][name][key])
    assert all(torch.equal(saved["policy"][key], v) for key, v in saved["best"]["policy"].items())
    with open(tmp_path / "metrics.csv", newline="") as file:
        best = [float(row["best"]) for row in csv.DictReader(file)]
    assert best == [0.0, -1.0, -1.0, -2.0, -2.0, -2.0, -1.0, -1.3, -1.3, -1.5, -1.3]


def test_a_finished_run_stays_as_it_is(lasting, model, conf, tmp_path, monkeypatch):
    """Begun again it knows its end, which on a GPU would be another one."""
    script(monkeypatch, VALUES, [-1.9, INF, -1.85])
    once = train(lasting, model, conf, tmp_path)
    asked = script(monkeypatch, VALUES, [])
    twice = train(lasting, model, conf, tmp_path)
    assert asked == [] and twice.best_iteration == once.best_iteration == 5
    assert twice.examination["end"] == once.examination["end"] == -1.85


def test_what_a_run_went_back_from_is_forgotten(lasting, model, conf, tmp_path, monkeypatch):
    """If it is extended it has no moments of the motion that was given up, nor goes halfway back to it."""
    script(monkeypatch, VALUES, [-0.9, -0.9, -0.9, INF, -1.25])
    run = train(lasting, model, conf, tmp_path).run
    assert not run.optimizer.state
    assert all(torch.equal(p, safe) for p, safe in zip(run.parameters, run.safe, strict=True))


def test_a_run_that_does_not_settle_goes_on_as_if_unbroken(lasting, model, conf, tmp_path, monkeypatch):
    """Ended in between, with a best that fails then."""
    values, rows = VALUES | {11: -1.0, 13: -1.2, 14: 0.0}, []
    optimizer = dataclasses.replace(conf.optimizer, settle=0.0)
    for name, lengths in (("whole", [14]), ("parts", [10, 14])):
        for length in lengths:
            script(monkeypatch, values, [INF])
            some = dataclasses.replace(conf.train, iterations=length)
            train(lasting, model, dataclasses.replace(conf, optimizer=optimizer, train=some), tmp_path / name)
        with open(tmp_path / name / "metrics.csv", newline="") as file:
            rows.append([(row["loss"], row["best"]) for row in csv.DictReader(file)])
    assert rows[0] == rows[1] and rows[0][-1][1] == "-2.0"


def test_a_run_settles_although_nothing_repeats_itself(lasting, model, conf, tmp_path, monkeypatch):
    """From its best, and with the best of settling as its end."""
    optimizer = dataclasses.replace(conf.optimizer, restart_above=-0.5)
    asked = script(monkeypatch, VALUES | {7: -1.9, 9: -2.1}, [INF, INF, INF, -2.1])
    result = train(lasting, model, dataclasses.replace(conf, optimizer=optimizer), tmp_path)
    assert asked == [6, 6, 6, 10] and result.run.settles
    assert (result.best_iteration, result.run.restart.count) == (9, 0)


def test_the_further_starts_are_others():
    """Within the range of the first ones, or a best would repeat itself on a CPU to the last bit."""
    assert not set(AGAIN) & {*STARTS, *FURTHER} and len(AGAIN) == len({*STARTS, *FURTHER})
    assert max(map(abs, AGAIN)) <= max(map(abs, {*STARTS, *FURTHER}))
