"""Environments by name: ``softmpm/Elephant-v0`` and the others in gymnasium's registry."""

import dataclasses
from typing import Any, cast

import gymnasium

from softmpm_learn import plugins
from softmpm_learn.gym.env import SoftRobotEnv
from softmpm_learn.gym.vector import SoftRobotVectorEnv
from softmpm_learn.gym.worlds import EnvConf
from softmpm_learn.setting_checks import one_of
from softmpm_learn.tasks import TASKS, Resolution, Task, make_task


def identifier(name: str) -> str:
    """Name of a task in gymnasium's registry."""
    if name not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}, got {name!r}.")
    return f"softmpm/{name.title().replace('_', '')}-v0"


def register() -> None:
    """Register every task, those of installed packages among them."""
    plugins.load_packages()
    for name in TASKS:
        if identifier(name) not in gymnasium.registry:
            gymnasium.register(
                identifier(name),
                entry_point=make_single,
                vector_entry_point=make_vector,
                kwargs={"task": name},
            )


def _own(name: str) -> str:
    """:func:`identifier` of a task, registered by now."""
    register()  # tasks that were added since
    there = identifier(name)
    other = gymnasium.registry[there].kwargs.get("task")
    if other != name:
        raise ValueError(
            f"tasks {other!r} and {name!r} are both {there} in gymnasium; give one another name."
        )
    return there


def make(name: str, **settings: Any) -> SoftRobotEnv:
    """Environment of a task, without wrappers.

    Args:
        name: Of a registered task.
        settings: ``render_mode``, fields of :class:`EnvConf` and of the task's own settings, such as ``seconds=0.5``; ``resolution``
            may be a string.
    """
    there = _own(name)
    need_known(
        name, settings, "render_mode"
    )  # gymnasium.make takes words of its own, whose wrappers are not there
    return cast(SoftRobotEnv, gymnasium.make(there, disable_env_checker=True, **settings).unwrapped)


def make_vec(name: str, num_envs: int = 1, **settings: Any) -> SoftRobotVectorEnv:
    """Environment of ``num_envs`` worlds of a task; settings as of :func:`make`, and ``autoreset_mode``."""
    there = _own(name)
    need_known(name, settings, "render_mode", "autoreset_mode")
    return cast(SoftRobotVectorEnv, gymnasium.make_vec(there, num_envs=num_envs, **settings))


def make_single(task: str, render_mode: str | None = None, **settings: Any) -> SoftRobotEnv:
    """Entry point of gymnasium for one world."""
    return SoftRobotEnv(*parts(task, settings), render_mode=render_mode)


def make_vector(
    task: str,
    num_envs: int,
    render_mode: str | None = None,
    autoreset_mode: str = "NextStep",
    **settings: Any,
) -> SoftRobotVectorEnv:
    """Entry point of gymnasium for many worlds."""
    built, conf = parts(task, settings)
    return SoftRobotVectorEnv(built, num_envs, conf, render_mode, autoreset_mode)


def parts(name: str, settings: dict[str, Any]) -> tuple[Task, EnvConf]:
    """Task and settings of the environment from one set of keywords.

    Raises:
        ValueError: A keyword is a setting of neither, or there is no such resolution.
    """
    kind: Any = TASKS[name].kind
    own, theirs = need_known(name, settings)
    chosen = {key: value for key, value in settings.items() if key in theirs}
    if isinstance(chosen.get("resolution"), str):
        one_of("resolution", chosen["resolution"], tuple(Resolution.__members__))
        chosen["resolution"] = Resolution[chosen["resolution"]]
    conf = EnvConf(**{key: value for key, value in settings.items() if key in own})
    return make_task(kind(**chosen)), conf


def need_known(name: str, settings: dict[str, Any], *others: str) -> tuple[list[str], list[str]]:
    """Names of the settings of environments and of a task.

    Args:
        others: Further words that are known.

    Raises:
        ValueError: A word is none of them.
    """
    kind: Any = TASKS[name].kind
    own = [field.name for field in dataclasses.fields(EnvConf)]
    theirs = [field.name for field in dataclasses.fields(kind) if field.name != "name"]
    unknown = [key for key in settings if key not in (*own, *theirs, *others)]
    if unknown:
        known = ", ".join([*(others or ["render_mode"]), *own, *theirs])
        raise ValueError(f"there is no setting {unknown[0]}; known are {known}.")
    return own, theirs
