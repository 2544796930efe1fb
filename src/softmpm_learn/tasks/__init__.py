"""The robots: one file each, and the table of their names."""

from collections.abc import Callable

from softmpm_learn.tasks.arm import ArmConf, arm
from softmpm_learn.tasks.biped import BipedConf, biped
from softmpm_learn.tasks.elephant import ElephantConf, elephant
from softmpm_learn.tasks.task import Resolution, Task, TaskConf

TASKS: dict[str, tuple[type[TaskConf], Callable[..., Task]]] = {
    "elephant": (ElephantConf, elephant),
    "arm": (ArmConf, arm),
    "biped": (BipedConf, biped),
}
"""Settings and builder of each task; ``conf/task/`` has a file of the same name."""


def make_task(conf: TaskConf) -> Task:
    """Build the task that some settings describe."""
    for kind, build in TASKS.values():
        if type(conf) is kind:
            return build(conf)
    raise ValueError(f"no task has settings of type {type(conf).__name__}; known are {', '.join(TASKS)}.")


__all__ = [
    "TASKS",
    "ArmConf",
    "BipedConf",
    "ElephantConf",
    "Resolution",
    "Task",
    "TaskConf",
    "arm",
    "biped",
    "elephant",
    "make_task",
]
