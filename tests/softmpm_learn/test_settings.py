import pytest

from softmpm_learn import settings


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
