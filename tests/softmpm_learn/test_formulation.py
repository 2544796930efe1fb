"""Training of each task in the reference formulation and of a walker on the moving grid, from the settings to the pictures, and again
from a checkpoint."""

import math

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from learners import rows_of

import softmpm
from softmpm_learn.command import app, experiment
from softmpm_learn.config import RunConf, conf_dir, to_run
from softmpm_learn.runs.identity import SettingsError
from softmpm_learn.runs.saved import load
from softmpm_learn.storage import checkpoint

SETTINGS = [
    *("experiment=smoke", "device=cpu", "task.seconds=0.05", "task.control_period=0.025"),
    *("task.formulation=reference", "task.retardation=1e-3", "design.viscosity=true", "design.strength=true"),
    *("learning.epochs=1", "learning.batches=1", "train.iterations=2", "train.examine=false"),
]
"""The smallest run that has every phase, with all that may be designed."""


def conf_of(task: str, *changes: str) -> RunConf:
    app.register()
    GlobalHydra.instance().clear()
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return to_run(compose("config", [f"task={task}", *SETTINGS, *changes]))


@pytest.mark.parametrize(
    ("task", "formulation"),
    [*((task, "reference") for task in ("elephant", "arm", "biped")), ("biped", "moving")],
)
def test_a_run_is_whole(task, formulation, tmp_path):
    """Finite gradients of policy and design in every iteration; the folder has the recording, the pictures and a configuration that
    gives the same model; a run of one iteration continued by a second, with two threads, equals one of two."""
    chosen = (task, f"task.formulation={formulation}")
    experiment.run_experiment(conf_of(*chosen), tmp_path / "whole")
    found = rows_of(tmp_path / "whole")
    assert len(found) == 2
    for row in found:
        for name in ("loss", "gradient_policy", "gradient_design"):
            assert math.isfinite(float(row[name])) and float(row[name]) != 0.0
    for name in ("robot.png", "loss.png", "latent.png", "run.rrd"):
        assert (tmp_path / "whole" / name).stat().st_size > 0
    with softmpm.Recording(tmp_path / "whole" / "run.h5") as recording:
        frames = recording.frames(recording.episodes[-1])
    assert len(frames["x"]) == 3 and np.abs(frames["x"][-1] - frames["x"][0]).max() > 1e-6
    assert load(tmp_path / "whole").task == conf_of(*chosen).task

    parts = (*chosen, "train.pictures=false", "device.threads=2")
    experiment.run_experiment(conf_of(*parts, "train.iterations=1"), tmp_path / "parts")
    experiment.run_experiment(conf_of(*parts), tmp_path / "parts")
    assert rows_of(tmp_path / "parts") == found
    one, two = (checkpoint.load(tmp_path / name) for name in ("whole", "parts"))
    assert all(torch.equal(one["policy"][name], two["policy"][name]) for name in one["policy"])
    assert all(torch.equal(one["design"][name], two["design"][name]) for name in one["design"])


def test_another_formulation_does_not_resume(tmp_path):
    """A checkpoint continues in its own formulation, contact and width only."""
    experiment.run_experiment(conf_of("biped", "train.iterations=1", "train.pictures=false"), tmp_path)
    for change, name in (
        (("task.contact_width=0.02",), "contact_width"),
        (("task.contact=nodes",), "contact: "),
        (("task.formulation=moving",), "formulation: reference then, moving now"),
        (("task.formulation=moving", "task.contact=nodes"), "formulation: reference then, None now"),
    ):
        with pytest.raises(SettingsError, match=name):
            experiment.run_experiment(conf_of("biped", *change), tmp_path)


def test_a_contact_that_is_not_there_is_refused(tmp_path):
    """The arm has no walls that separate, and contact at nodes has no width."""
    for task, changes, message in (
        ("arm", ("task.contact=surface",), "needs a wall of the kind 'separate'"),
        ("arm", ("task.contact_width=0.01",), "contact_width is for contact at surface points"),
        (
            "biped",
            ("task.contact=nodes", "task.contact_width=0.01"),
            "contact_width is for contact at surface points",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            experiment.run_experiment(conf_of(task, *changes), tmp_path / "refused")
