"""softmpm_learn: controller and body of a soft robot optimised together, through an observer that is learned during the optimisation.

``python -m softmpm_learn --help`` for experiments; :mod:`softmpm_learn.register` for robots, observers and policies of one's own;
:func:`softmpm_learn.train.train` for the loop in a program of one's own; :func:`softmpm_learn.load` for a policy that was trained.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from softmpm_learn import register

if TYPE_CHECKING:
    from softmpm_learn.runs.run import Run
    from softmpm_learn.settings import Settings
    from softmpm_learn.tasks.task import Task


def main() -> None:
    """The command line, from a program that registers its own: ``if __name__ == "__main__": softmpm_learn.main()``."""
    from softmpm_learn.__main__ import main as run

    run()


def load(
    folder: str | Path,
    device: str | None = None,
    *,
    task: "Task | None" = None,
    settings: "Settings | None" = None,
) -> "Run":
    """Load the run of a folder at its best, see :func:`softmpm_learn.runs.loading.load`."""
    from softmpm_learn.runs.loading import load as load_run

    return load_run(folder, device, task=task, settings=settings)


__all__ = ["load", "main", "register"]
