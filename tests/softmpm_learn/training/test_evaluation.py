"""Evaluation at fixed goals, for runs whose simulations draw their own."""

import csv
import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import softmpm
from softmpm_learn.objective import Objective, Reach
from softmpm_learn.runs import loops
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.train import train
from softmpm_learn.training import evaluation, optimisation


@pytest.fixture
def reaching(task):
    """The block brings its right end to a goal."""
    return dataclasses.replace(
        task, objective=Objective(Reach(particles=np.arange(28, 32), target=task.goal, begin=task.seconds))
    )


@pytest.fixture
def drawn(settings):
    """Settings with random goals and an evaluation every other iteration."""
    conf = dict(goal_spread=[0.2, 0.1], evaluate_every=2, evaluation_goals=4, iterations=4)
    observer = dataclasses.replace(settings.observer, name="centroids")
    return dataclasses.replace(settings, observer=observer, train=dataclasses.replace(settings.train, **conf))


def column(folder: Path, name: str) -> list[float]:
    with open(folder / "metrics.csv", newline="") as file:
        return [float(row[name] or "nan") for row in csv.DictReader(file)]


def test_the_goals_do_not_depend_on_the_seed(reaching, model, drawn, tmp_path):
    """They are in the box, differ from each other, and are those of every run; the seed moves the drawn ones only."""
    runs = [
        Run(
            reaching,
            model,
            dataclasses.replace(drawn, train=dataclasses.replace(drawn.train, seed=seed)),
            tmp_path,
        )
        for seed in range(2)
    ]
    first, other = (torch.cat(run.goals.fixed()) for run in runs)
    assert torch.equal(first, other) and not torch.equal(*(run.goals.draw() for run in runs))
    away = (first - torch.tensor([0.6, 0.3])).abs()
    assert first.shape == (4, 2) and first.unique(dim=0).shape == (4, 2)
    assert (away <= torch.tensor([0.2, 0.1])).all() and (away.mean(dim=0) > torch.tensor([0.05, 0.025])).all()


def test_worlds_share_the_goals(reaching, drawn, tmp_path):
    """The first goals are the same for any number of worlds, and all worlds have one."""
    alone = Run(reaching, softmpm.build(reaching.scene, device="cpu"), drawn, tmp_path).goals.fixed()
    conf = dataclasses.replace(drawn, train=dataclasses.replace(drawn.train, worlds=3))
    three = Run(reaching, softmpm.build(reaching.scene, device="cpu", worlds=3), conf, tmp_path).goals.fixed()
    assert [goal.shape for goal in three] == [(3, 2)] * 2
    assert torch.equal(torch.cat(three)[:4], torch.cat(alone))


def test_the_best_policy_is_that_of_the_best_evaluation(reaching, model, drawn, tmp_path):
    """A lucky draw of the goal does not count: the policy kept has the lowest loss at the fixed goals, and repeats it."""
    result = train(reaching, model, drawn, tmp_path)
    found, loss = column(tmp_path, "evaluation"), column(tmp_path, "loss")
    assert [math.isnan(value) for value in found] == [False, False, True, False]  # the first, and every 2
    assert result.best_loss == np.nanmin(found) != min(loss)
    assert result.best_iteration == int(np.nanargmin(found))
    result.run.load_policy(result.run.best)
    best = evaluation.Evaluation(result.best_loss, lasts=True)
    assert evaluation.evaluate(Runs([result.run]), [0]) == {0: best}


def test_an_evaluation_is_the_mean_over_its_goals(reaching, model, drawn, tmp_path):
    """Of the losses that the loop has with each goal alone; it keeps no gradient and leaves the goals to come as they were."""
    run = Run(reaching, model, drawn, tmp_path)
    state = run.goals.stream.get_state()
    runs = Runs([run])
    losses = [runs.loop(goal)[0].loss.item() for goal in run.goals.fixed()]
    found = evaluation.evaluate(runs, [0])[0]
    assert found.loss == pytest.approx(np.mean(losses), rel=1e-6) and found.lasts
    assert torch.equal(run.goals.stream.get_state(), state) and len(set(losses)) == 4


def test_a_failed_evaluation_is_no_best(reaching, model, drawn, tmp_path, monkeypatch, caplog):
    """The run goes on; its cell is empty, and the log says why."""
    run = Run(reaching, model, drawn, tmp_path)

    real = loops.run_episode

    def fails(*args, failures, **kwargs):
        kind = dict(kind="inverted", world=0, particle=3, substep=1, value=-1.0, limit="det F > 0")
        if failures is not None:  # of the evaluation
            with softmpm.noted("In control step 1 of 2."):
                failures.errors.append(softmpm.UnstableError("particle 3 is inverted.", **kind))
        return real(*args, **kwargs)

    monkeypatch.setattr(loops, "run_episode", fails)
    row = optimisation.optimise(Runs([run]), [], {})[0][0]
    assert math.isnan(row["evaluation"]) and run.best["iteration"] == -1
    assert "the evaluation failed: particle 3 is inverted. In control step 1 of 2." in caplog.text


def test_a_fixed_goal_needs_no_evaluation(reaching, model, drawn, tmp_path):
    """Its loss is without chance: the column is empty, and the best loss is the lowest."""
    conf = dataclasses.replace(drawn, train=dataclasses.replace(drawn.train, goal_spread=[]))
    result = train(reaching, model, conf, tmp_path)
    assert all(math.isnan(value) for value in column(tmp_path, "evaluation"))
    assert result.best_loss == min(column(tmp_path, "loss"))
