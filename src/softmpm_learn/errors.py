"""Any error as one sentence for the person at the command line."""

import dataclasses

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    OmegaConfBaseException,
)

from softmpm_learn.config import unknown_key

EXPECTED = (ValueError, RuntimeError, OSError, ImportError, MemoryError, HydraException, OmegaConfBaseException)
"""Errors whose own message is meant for people; others are faults of the program."""


def sentence(error: BaseException) -> str:
    """What went wrong and, where it is known, what to do, in one line."""
    if isinstance(error, HydraException) and isinstance(error.__cause__, OmegaConfBaseException):
        return sentence(error.__cause__)
    if isinstance(error, InterpolationResolutionError) and isinstance(error.__cause__, ValueError):
        return sentence(error.__cause__)  # from a resolver of ours
    if isinstance(error, OverrideParseException):
        return f"cannot read {error.override!r}: write key=value, in quotes if it has spaces or brackets."
    if isinstance(error, (ConfigAttributeError, ConfigKeyError)) and dataclasses.is_dataclass(error.object_type):
        return unknown_key(str(error.full_key), error.object_type)  # type: ignore[arg-type]
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        return f"{error.full_key}: {_line(str(error).partition(chr(10))[0])}"
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        return f"there is no {group} called {name}; choose one of {', '.join(error.options)}."
    text = _line(str(error)) or "no details"
    return text if isinstance(error, EXPECTED) else f"{type(error).__name__}: {text} (a fault of the program)"


def _line(text: str) -> str:
    """A message on one line, without Hydra's list of search paths."""
    text = text.partition("Config search path:")[0]
    text = " ".join(text.split())
    return text if not text or text.endswith((".", "!", "?", ")")) else f"{text}."
