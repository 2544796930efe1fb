"""Load a run at its best, for simulations in a program of one's own."""

import tempfile
from pathlib import Path

import torch

import softmpm
from softmpm_learn.design import declared_inputs
from softmpm_learn.runs import saved
from softmpm_learn.runs.resuming import restore
from softmpm_learn.runs.run import Run
from softmpm_learn.storage import checkpoint
from softmpm_learn.tasks import make_task


def load(folder: str | Path, device: str | None = None) -> Run:
    """Load the run of a folder with the policy, the design and the observer of its best motion; nothing in the folder changes.

    ``run.policy``, ``run.observer`` and ``run.design()``, which gives the material and the inputs of the robot, take part in
    :func:`softmpm_learn.episode.run_episode`; ``run.task`` is its task, and ``run.model_of(task, worlds)`` a model of the task or of
    one that was changed. The replay buffer is not loaded.

    Args:
        folder: Folder that ``python -m softmpm_learn`` left, with ``config.yaml`` and ``checkpoint.pt``; of several seeds that of one.
        device: Device of the model, None for CUDA if there is one.

    Raises:
        ValueError: There is no run in the folder, or it needs a file that registers its robot, observer or policy and was not imported.
        softmpm_learn.storage.checkpoint.CheckpointError: Every checkpoint is damaged.
    """
    folder = Path(folder)
    try:
        conf = saved.load(folder)
    except saved.MissingFileError as error:
        raise ValueError(f"{error}. A program imports that file before it loads the run.") from error
    if not checkpoint.exists(folder):
        seeds = f"; each seed has one: load {folder / 'seed_…'}" if conf.train.seeds > 1 else ""
        raise ValueError(f"{folder} must have a {checkpoint.NAME}, and has none{seeds}.")
    task, content = make_task(conf.task), checkpoint.load(folder)
    model = softmpm.build(
        task.scene,
        device=device,
        dtype=getattr(torch, conf.device.dtype),
        worlds=conf.train.worlds,
        inputs=declared_inputs(conf.design),
        **task.build,
    )
    with tempfile.TemporaryDirectory() as empty:  # for the replay buffer, which makes its folder
        run = Run(task, model, conf.settings, Path(empty))
    run.out = folder
    if content["learner"]:
        content["learner"]["replay"] = {}
    restore(run, content, folder)
    if run.best["iteration"] >= 0:
        run.load_policy(run.best)
    return run
