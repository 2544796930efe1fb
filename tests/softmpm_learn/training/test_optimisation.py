"""What the log has of an optimisation step that goes wrong."""

import dataclasses

import torch

import softmpm
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.settings import ObserverConf
from softmpm_learn.training import optimisation
from softmpm_learn.training.optimisation import go_back


def test_activations_at_their_bounds_are_reported_once(task, model, settings, tmp_path, caplog):
    """With the rate that brought them there; activations of an ordinary size are not."""
    conf = dataclasses.replace(settings, observer=ObserverConf(name="centroids"))
    run = Run(task, model, conf, tmp_path)
    optimisation.optimise(Runs([run]), [], {})
    assert "at their bounds" not in caplog.text
    with torch.no_grad():
        for parameter in run.policy.parameters():
            parameter.fill_(50.0)
    run.safe = []
    for _ in range(2):
        rows, _ = optimisation.optimise(Runs([run]), [], {})
        assert rows[0]["activation"] > optimisation.SATURATED and rows[0]["gradient_policy"] < 1e-3
    assert caplog.text.count("the activations are at their bounds (root mean square 1.000)") == 1
    assert "a lower optimizer.policy_rate, which is 0.005 here" in caplog.text


def test_steps_are_halved_before_there_is_a_best(task, model, settings, tmp_path, caplog):
    """As after a first evaluation that failed; without a retry left the run begins anew."""
    conf = dataclasses.replace(settings, observer=ObserverConf(name="centroids"))
    conf.optimizer.retries = 2
    run = Run(task, model, conf, tmp_path)
    optimisation.optimise(Runs([run]), [], {})
    runs, error = (
        Runs([run]),
        softmpm.UnstableError(
            "torn", kind="torn", world=0, particle=0, substep=0, value=2.0, limit="1.4 cells"
        ),
    )
    run.best["iteration"] = -1
    with caplog.at_level("WARNING", logger="softmpm_learn"):
        for retries in range(3):
            go_back(runs, 0, error, retries)
    said = [text.split("torn ")[-1] for text in caplog.messages if "torn" in text]
    assert said == [
        "Going halfway back.",
        "Going halfway back.",
        "The run is beginning anew with other first weights.",
    ]
