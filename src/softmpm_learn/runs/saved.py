"""The ``config.yaml`` of a run: written whole, and read as data that somebody else may have written.

YAML can name other parts of itself, so that nine lines become a billion, and Python objects; OmegaConf can name other settings
and, by interpolation, variables of the environment. A saved configuration needs none of that, and is refused if it has any.
"""

from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from softmpm_learn import plugins
from softmpm_learn.config import RunConf, no_run, to_run
from softmpm_learn.register import CHOICES, LOGGERS
from softmpm_learn.storage import files
from softmpm_learn.tasks import TASKS

NAME = "config.yaml"
_MOST = 2**20  # bytes; a run's own has about two thousand
_DEPTH = 20


def save(run: RunConf, folder: Path) -> None:
    """Write the resolved configuration, for people and for :func:`load`."""
    files.replace(folder / NAME, OmegaConf.to_yaml(OmegaConf.structured(run)).encode())


def load(folder: Path) -> RunConf:
    """Read the configuration that a run left in its folder.

    Raises:
        ValueError: There is none, or it is not one; names the file.
    """
    plugins.load_packages()
    files.check_folder(folder)
    path = folder / NAME
    if not path.exists():
        raise ValueError(no_run(folder))
    data = files.read(path, _MOST + 1)
    try:
        text = data.decode()
        _check_plain(text)
        saved: Any = OmegaConf.create(text)
        name = OmegaConf.select(saved, "task.name") if isinstance(saved, DictConfig) else None
        if isinstance(saved, DictConfig):
            _need_files(saved, folder)
        if name not in TASKS:
            known = ", ".join(TASKS)
            raise ValueError(
                f"it names the task {name!r}; known are {known}. One of a package needs the package."
            )
        task: Any = TASKS[str(name)].kind
        return to_run(DictConfig(OmegaConf.merge(OmegaConf.structured(RunConf(task=task())), saved)))
    except MissingFileError:
        raise
    except (
        yaml.YAMLError,
        OmegaConfBaseException,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
    ) as error:
        raise ValueError(
            f"{path} is not the configuration of a run: {_problem(error)} Put the right file there."
        ) from error


class MissingFileError(ValueError):
    """A run needs files that were not loaded."""


def _need_files(saved: DictConfig, folder: Path) -> None:
    """Raise MissingFileError for a name that is not registered, if files had registered names when the run began.

    They are named and not imported: a configuration is data.
    """
    names = [path for path in saved.get("files") or [] if isinstance(path, str)]
    missing = [path for path in names if path not in plugins.files()]
    named = [(table, OmegaConf.select(saved, f"{table.what}.name")) for table in CHOICES if missing]
    named += [(LOGGERS, name) for name in OmegaConf.select(saved, "train.log") or [] if missing]
    for table, name in named:
        if name not in table:
            raise MissingFileError(
                f"the {table.what} {name!r} of the run in {folder} was registered by a file: "
                f"{plugins.command(names)} {plugins.resume(folder)}"
            )


def _check_plain(text: str) -> None:
    """Raise ValueError for a file that is too large or too deep, or has anything but plain values."""
    if len(text) > _MOST:
        raise ValueError(f"it has more than {_MOST} bytes.")
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth == 0 and isinstance(event, (yaml.ScalarEvent, yaml.SequenceEndEvent)):
            raise ValueError("it is a value or a list, not settings by name.")
        where = f"in line {event.start_mark.line + 1}"
        if depth > _DEPTH:
            raise ValueError(f"it is more than {_DEPTH} levels deep {where}.")
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise ValueError(f"it has an anchor or an alias {where}.")
        if getattr(event, "tag", None):
            raise ValueError(f"it has a tag, {event.tag}, {where}.")
        if "${" in getattr(event, "value", ""):
            raise ValueError(f"it has an interpolation, {event.value}, {where}.")


def _problem(error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        text = f"it is not UTF-8 at byte {error.start}"
    elif isinstance(error, yaml.MarkedYAMLError) and error.problem_mark:
        text = f"it is no YAML in line {error.problem_mark.line + 1}: {error.problem}"
    elif isinstance(error, OmegaConfBaseException):
        text = f"{error.full_key}: {str(error).splitlines()[0]}"
    else:
        text = " ".join(str(error).split())
    return text if text.endswith(".") else f"{text}."
