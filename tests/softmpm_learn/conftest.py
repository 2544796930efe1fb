"""A crawler small enough to train in a test, a soft block on a rough floor with a muscle in each half; and the command line in this
process.
"""

import logging
import sys

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra

import softmpm
from softmpm_learn.command import app
from softmpm_learn.objective import Effort, Objective, Progress
from softmpm_learn.settings import LearningConf, ObserverConf, PolicyConf, Settings, TrainConf
from softmpm_learn.tasks.task import Task


def block_scene(**changes) -> softmpm.Scene:
    x, y = np.meshgrid(0.35 + 0.05 * np.arange(8), 0.22 + 0.05 * np.arange(4), indexing="ij")
    positions = np.stack([x.ravel(), y.ravel()], axis=1)
    material = softmpm.NeoHookean(density=1.0, young=20.0, poisson=0.3)
    settings = dict(
        grid=softmpm.Grid(shape=(13, 9), spacing=0.1),
        bodies=[softmpm.Body(softmpm.Particles(positions, 0.05**2), material)],
        muscles=[
            softmpm.Muscle(particles=np.arange(16), direction=(1.0, 0.0), strength=5.0),
            softmpm.Muscle(particles=np.arange(16, 32), direction=(1.0, 0.4), strength=5.0),
        ],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.2, contact="separate", friction=0.5)],
        gravity=(0.0, -2.0),
        dt=4e-3,
    )
    return softmpm.Scene(**(settings | changes))


@pytest.fixture(scope="session")
def make_block():
    """:func:`block_scene`, for tests that need another block."""
    return block_scene


@pytest.fixture(scope="session")
def task() -> Task:
    return Task(
        name="block",
        scene=block_scene(),
        control_steps=6,
        substeps=4,
        regions={"left": np.arange(12), "right": np.arange(16, 32)},  # 12 to 15 are in no region
        objective=Objective(Progress(), Effort(weight=1e-3)),
        body_length=0.4,
        goal=np.array([0.6, 0.3]),
    )


@pytest.fixture(scope="session")
def model(task) -> softmpm.Model:
    return softmpm.build(task.scene, device="cpu")


@pytest.fixture
def settings() -> Settings:
    return small_settings()


@pytest.fixture(scope="session")
def make_settings():
    """:func:`small_settings`, for fixtures that several tests share."""
    return small_settings


def small_settings() -> Settings:
    return Settings(
        observer=ObserverConf(latent_size=3, channels=[4, 4]),
        policy=PolicyConf(name="linear"),
        learning=LearningConf(every=2, epochs=3, batches=2, batch=4, validation=0.25, frame_every=2),
        train=TrainConf(iterations=5, record_every=0, examine=False),
    )


@pytest.fixture
def fresh_hydra(monkeypatch):
    """Hydra keeps what it has composed, and handlers of the log; main() also sets an environment variable."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(logging.getLogger(), "handlers", logging.getLogger().handlers[:])
    GlobalHydra.instance().clear()
    yield
    GlobalHydra.instance().clear()


@pytest.fixture
def in_folder(fresh_hydra, monkeypatch, tmp_path):
    """The same, in a folder of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def main(monkeypatch):
    """``python -m softmpm_learn`` in this process; gives the exit code and the objectives, which Hydra's sweeper gets."""
    real = app.job

    def go(*words: str) -> tuple[int, list[float]]:
        objectives = []
        monkeypatch.setattr(app, "job", lambda *args: objectives.append(real(*args)) or objectives[-1])
        quiet = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
        monkeypatch.setattr(sys, "argv", ["softmpm_learn", *words, *quiet])
        GlobalHydra.instance().clear()
        try:
            app.main()
        except SystemExit as stop:
            return stop.code, objectives
        return 0, objectives

    return go
