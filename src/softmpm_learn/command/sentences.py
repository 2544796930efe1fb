"""Error messages of the command line: one sentence in place of a traceback."""

import dataclasses
import sys
from typing import NoReturn

import torch
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    OmegaConfBaseException,
)

from softmpm_learn import plugins
from softmpm_learn.config import unknown_key
from softmpm_learn.distributed import in_full, is_lost
from softmpm_learn.register import CHOICES
from softmpm_learn.tasks.image import unknown_colour

EXPECTED = (
    ValueError,
    RuntimeError,
    OSError,
    ImportError,
    MemoryError,
    HydraException,
    OmegaConfBaseException,
)
"""Errors whose message is meant for people; any other is a fault of the program."""
QUOTES = "'\""


def sentence(error: BaseException) -> str:
    """Error message in one line, with the remedy where it is known."""
    if isinstance(error, HydraException) and isinstance(error.__cause__, OmegaConfBaseException):
        key, _, value = str(error).removeprefix("Error merging override ").partition("=")
        if value and "is not a ListConfig" in str(error.__cause__):
            written = f'"{key}=[{value.strip(QUOTES)}]"'
            return f"{key} must be a list, got {value}: write {written}, with a comma between several values."
        return sentence(error.__cause__)
    cause = error.__cause__ or error.__context__
    if isinstance(error, InterpolationResolutionError) and isinstance(cause, ValueError):
        return sentence(cause)  # from a resolver of ours
    if isinstance(error, OverrideParseException):
        return (
            f"cannot read {error.override!r}: write key=value; with spaces, brackets or letters with accents in quotes of its own, "
            "within those of the shell: \"key='value'\"."
        )
    if isinstance(error, (ConfigAttributeError, ConfigKeyError)):
        kind = error.object_type
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            return unknown_key(str(error.full_key), kind)
        if kind is dict:
            group, _, name = str(error.full_key).rpartition(".")
            if group == "task.legend" and isinstance(error.parent_node, DictConfig):
                return unknown_colour(name, map(str, error.parent_node))
            return f"{error.full_key} is not set yet: write +{error.full_key}=VALUE to add it."
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        return f"{error.full_key}: {_line(str(error).splitlines()[0])}"
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        file = ""
        if not plugins.loaded and group in (table.what for table in CHOICES):
            file = f" One of your own needs its file: {plugins.command()} FILE.py {group}={name}"
        return f"there is no {group} called {name}; choose one of {', '.join(error.options)}.{file}"
    if is_lost(error):
        return "another process of this run has ended; its own message says why, or torchrun reports the signal that killed it."
    text = in_full(error).strip() or "no details"
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    if isinstance(error, torch.OutOfMemoryError) or "memory_budget" in text:  # as the simulator calls it
        text += " Settings for that: train.worlds, task.resolution and device.memory."
    return _line(
        text if isinstance(error, EXPECTED) else f"{type(error).__name__}: {text} (a fault of the program)"
    )


def _line(text: str) -> str:
    """A message on one line, without Hydra's list of search paths."""
    text = " ".join(text.partition("Config search path:")[0].split())
    return text if text.endswith((".", "!", "?")) else f"{text}."


def give_up(error: Exception) -> NoReturn:
    end(1, sentence(error))


def end(code: int, said: str) -> NoReturn:
    if said:
        print(f"softmpm_learn: {said}", file=sys.stderr)
    raise SystemExit(code)
