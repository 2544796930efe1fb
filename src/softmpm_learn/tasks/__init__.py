"""The robots: one file each. ``conf/task/`` has a file of the same name for each."""

from softmpm_learn import register
from softmpm_learn.register import TASKS
from softmpm_learn.tasks.arm import ArmConf, arm
from softmpm_learn.tasks.biped import BipedConf, biped
from softmpm_learn.tasks.elephant import ElephantConf, elephant
from softmpm_learn.tasks.image import ImageConf, image
from softmpm_learn.tasks.mesh import MeshConf, mesh
from softmpm_learn.tasks.task import Resolution, Task, TaskConf
from softmpm_learn.tasks.voxels import VoxelsConf, voxels
from softmpm_learn.tasks.walker import WalkerConf

register.task("elephant", ElephantConf)(elephant)
register.task("arm", ArmConf)(arm)
register.task("biped", BipedConf)(biped)
register.task("image", ImageConf)(image)
register.task("mesh", MeshConf)(mesh)
register.task("voxels", VoxelsConf)(voxels)


def make_task(conf: TaskConf) -> Task:
    """Build the task that some settings describe."""
    for name, (kind, build) in TASKS.items():
        if type(conf) is kind:
            task = build(conf)
            if not isinstance(task, Task):
                raise ValueError(
                    f"the builder of task {name} must return a softmpm_learn.tasks.Task, got {type(task).__name__}."
                )
            return task
    raise ValueError(f"no task has settings of type {type(conf).__name__}; known are {', '.join(TASKS)}.")


__all__ = [
    "TASKS",
    "ArmConf",
    "BipedConf",
    "ElephantConf",
    "ImageConf",
    "MeshConf",
    "Resolution",
    "Task",
    "TaskConf",
    "VoxelsConf",
    "WalkerConf",
    "arm",
    "biped",
    "elephant",
    "image",
    "make_task",
    "mesh",
    "voxels",
]
