"""Load a run at its best, for simulations in a program of one's own."""

import json
import tempfile
from pathlib import Path

import torch

import softmpm
from softmpm_learn.design import declared_inputs
from softmpm_learn.runs import saved
from softmpm_learn.runs.resuming import restore
from softmpm_learn.runs.run import Run
from softmpm_learn.settings import Settings
from softmpm_learn.storage import checkpoint
from softmpm_learn.tasks import make_task
from softmpm_learn.tasks.task import Task


def load(
    folder: str | Path,
    device: str | None = None,
    *,
    task: Task | None = None,
    settings: Settings | None = None,
) -> Run:
    """Load the run of a folder with the policy, the design and the observer of its best motion; nothing in the folder changes.

    ``run.policy``, ``run.observer`` and ``run.design()``, which gives the material and the inputs of the robot, take part in
    :func:`softmpm_learn.episode.run_episode`; ``run.task`` is its task, and ``run.model_of(task, worlds)`` a model of the task or of
    one that was changed. The replay buffer is not loaded.

    Args:
        folder: Folder with ``checkpoint.pt`` of one seed, and with the ``config.yaml`` that ``python -m softmpm_learn`` leaves.
        device: Device of the model, None for CUDA if there is one.
        task, settings: What :func:`softmpm_learn.train.train` was given, for a folder that it left: that has no ``config.yaml``.

    Raises:
        ValueError: There is no run in the folder, it needs a file that registers its robot, observer or policy and was not imported, or
            task and settings are not those of the run.
        softmpm_learn.storage.checkpoint.CheckpointError: Every checkpoint is damaged.
    """
    folder = Path(folder)
    if (task is None) != (settings is None):
        raise ValueError(
            "load takes both task= and settings=, or neither where the folder has a config.yaml."
        )
    if task is None or settings is None:
        task, settings = _of_config(folder)
    if not checkpoint.exists(folder):
        seeds = f"; each seed has one: load {folder / 'seed_…'}" if settings.train.seeds > 1 else ""
        raise ValueError(f"{folder} must have a {checkpoint.NAME}, and has none{seeds}.")
    content = checkpoint.load(folder)
    model = softmpm.build(
        task.scene,
        device=device,
        dtype=_precision(content),
        worlds=settings.train.worlds,
        inputs=declared_inputs(settings.design),
        **task.build,
    )
    with tempfile.TemporaryDirectory() as empty:  # for the replay buffer, which makes its folder
        run = Run(task, model, settings, Path(empty))
    run.out = folder
    if content["learner"]:
        content["learner"]["replay"] = {}
    restore(run, content, folder)
    if run.best["iteration"] >= 0:
        run.load_policy(run.best)
    return run


def _of_config(folder: Path) -> tuple[Task, Settings]:
    if checkpoint.exists(folder) and not (folder / saved.NAME).exists():
        raise ValueError(
            f"{folder} must have a {saved.NAME}, and has none; of a run that a program trained, give what train() was given: "
            "load(folder, task=…, settings=…)."
        )
    try:
        conf = saved.load(folder)
    except saved.MissingFileError as error:
        raise ValueError(f"{error}. A program imports that file before it loads the run.") from error
    return make_task(conf.task), conf.settings


def _precision(content: dict) -> torch.dtype:
    """Precision of the model of a checkpoint."""
    return getattr(torch, json.loads(content["about"])["dtype"].removeprefix("torch."))
