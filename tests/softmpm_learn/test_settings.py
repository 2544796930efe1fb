import numpy as np
import pytest

from softmpm_learn import settings
from softmpm_learn.config import DeviceConf
from softmpm_learn.tasks.image import ImageConf


@pytest.mark.parametrize(
    ("conf", "wrong", "says"),
    [
        ("ObserverConf", {"name": "latnt"}, "latent, centroids, kmeans, untrained, nothing"),
        ("ObserverConf", {"channels": []}, "channels"),
        ("ObserverConf", {"nodes": 2}, "nodes"),
        ("PolicyConf", {"name": "rnn"}, "linear, mlp, sinusoids, knots"),
        ("PolicyConf", {"hidden": [0]}, "hidden"),
        ("PolicyConf", {"gain": float("nan")}, "gain"),
        ("PolicyConf", {"knots": 1}, "knots"),
        ("DesignConf", {"per": "leg"}, "particle, region, uniform"),
        ("DesignConf", {"young_factor": [1.1, 2.0]}, "young_factor"),
        ("DesignConf", {"poisson_range": [0.3, 0.5]}, "poisson_range must be .* with -1 < low < high < 0.5"),
        ("DesignConf", {"strength_factor": [0.5, 0.9]}, "strength_factor must be .* with 0 < low < 1 < high"),
        ("DesignConf", {"viscosity_factor": [0.0, 2.0]}, "viscosity_factor"),
        ("OptimizerConf", {"policy_rate": 0.0}, "policy_rate must be > 0"),
        ("OptimizerConf", {"max_norm": -1.0}, "max_norm"),
        ("OptimizerConf", {"retries": -1}, "retries"),
        ("OptimizerConf", {"fallback_share": 1.0}, "fallback_share"),
        ("OptimizerConf", {"fallback_after": 0}, "fallback_after"),
        ("OptimizerConf", {"fallback_rate": 0.0}, "fallback_rate"),
        ("LearningConf", {"every": 0}, "every"),
        ("LearningConf", {"epochs": -1}, "epochs"),
        ("LearningConf", {"improvement": 1.0}, "improvement"),
        ("LearningConf", {"validation": 0.3}, "validation"),
        ("LearningConf", {"target_rate": 0.0}, "target_rate"),
        ("LearningConf", {"target_halving": 0.0}, "target_halving"),
        ("TrainConf", {"iterations": 0}, "iterations"),
        ("TrainConf", {"evaluate_every": 0}, "evaluate_every"),
        ("TrainConf", {"evaluation_goals": 0}, "evaluation_goals"),
        ("TrainConf", {"goal_spread": [0.1, -0.1]}, "goal_spread"),
        (
            "TrainConf",
            {"goal_spread": 0.05},
            r"goal_spread must be a list of lengths .*\[0.05, 0.05\], got 0.05",
        ),
        ("ObserverConf", {"channels": [4, 4.5]}, r"channels must be a list of whole numbers, got \[4, 4.5\]"),
        ("TrainConf", {"seeds": 2.5}, "train.seeds must be a whole number, got 2.5"),
        ("TrainConf", {"seeds": True}, "train.seeds must be a whole number, got True"),
        ("TrainConf", {"pictures": "false"}, "train.pictures must be True or False, got 'false'"),
        ("OptimizerConf", {"policy_rate": "1e-2"}, "optimizer.policy_rate must be a number, got '1e-2'"),
        ("TrainConf", {"goal_spread": ["a"]}, r"goal_spread must be a list of lengths .* got \['a'\]"),
    ],
)
def test_a_wrong_setting_fails_where_it_is_made(conf, wrong, says):
    """The message names the setting and what came."""
    with pytest.raises(ValueError, match=says):
        getattr(settings, conf)(**wrong)


def test_settings_do_not_share_lists():
    """Changing a list of one object leaves the next one's alone."""
    settings.ObserverConf().channels.append(99)
    assert 99 not in settings.ObserverConf().channels


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"cells": 33.3}, "task.cells must be a whole number, got 33.3"),
        ({"overlap": "no"}, "task.overlap must be True or False"),
        ({"resolution": "fine"}, "task.resolution must be one of Resolution.draft, .* got 'fine'"),
        ({"poisson": -1.0}, r"task.poisson must lie in \(-1, 0.5\), got -1.0"),
    ],
)
def test_a_wrong_setting_of_a_task_fails_too(wrong, says):
    """Those of the right kind do not, in any type of NumPy or Python."""
    with pytest.raises(ValueError, match=says):
        ImageConf(**wrong)
    assert ImageConf(cells=np.int64(33), size=np.float32(0.5), seconds=1, track=None).cells == 33


def test_memory_is_finite():
    """It becomes a number of bytes."""
    with pytest.raises(ValueError, match="device.memory must be > 0 MB or null, got inf"):
        DeviceConf(memory=float("inf"))
