"""The bridge from Hydra to plain objects: command line and ``conf/`` in, a run in its folder out."""

import contextlib
import dataclasses
import logging
import logging.handlers
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import hydra
import torch
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    OmegaConfBaseException,
)

from softmpm_learn import files
from softmpm_learn.checkpoint import LockedError
from softmpm_learn.config import RunConf, conf_dir, to_run, unknown_key
from softmpm_learn.distributed import Group, OtherProcessError, in_full, joined
from softmpm_learn.experiment import run_experiment
from softmpm_learn.optimisation import TrainingError
from softmpm_learn.saved import load
from softmpm_learn.stop import Signals
from softmpm_learn.tasks import TASKS

CHANGEABLE = ("train.iterations", "train.record_every", "train.frame_every", "train.examine", "device")
"""Settings that may differ when a run is resumed: its length, the recorded episodes and the device."""
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


def main(signals: Signals | None = None) -> None:
    """Entry of ``python -m softmpm_learn``: exit code 0, or 1 after one sentence on what went wrong."""
    full = bool(os.environ.get("HYDRA_FULL_ERROR"))  # the user asks for tracebacks
    os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints an error its own way, in several lines
    group, signals = Group(), signals or Signals()
    try:
        with joined() as group:
            if not group.first:
                signals.quiet = True
                logging.disable(logging.WARNING)  # the first process says it
            register(group.broadcast(time.time()))
            run = hydra.main(version_base="1.3", config_path=conf_dir(), config_name="config")
            run(lambda config: job(config, group, signals))()
    except Exception as error:
        if full:
            raise
        if not group.first:
            raise SystemExit(1) from None  # the first process says the same
        _give_up(error)
    except KeyboardInterrupt:
        _end(130, "" if signals.quiet else f"interrupted. {signals.advice}")


def register(began: float | None = None) -> None:
    """Give Hydra the schema, and when the program began; a group that starts with an underscore is not offered to users."""
    store = ConfigStore.instance()
    store.store(group="_schema", name="run", node=RunConf)
    for name, (conf, _) in TASKS.items():
        store.store(group="_schema/task", name=name, node=conf)
    OmegaConf.register_new_resolver("run_dir", _run_dir, replace=True)
    began = time.time() if began is None else began
    OmegaConf.register_new_resolver(
        "began", lambda pattern: time.strftime(pattern, time.localtime(began)), replace=True
    )


def _run_dir(resume: str | None, fresh: str) -> str:
    """Folder of a run: a resumed one goes on where it is."""
    if resume is None:
        return fresh
    if not (Path(resume) / "config.yaml").is_file():
        raise ValueError(f"there is no run to resume in {resume}: it has no config.yaml.")
    return resume


def job(config: DictConfig, group: Group, signals: Signals) -> None:
    """One run. An error ends it with a sentence on stderr and the traceback in its folder, both from where it happened."""
    out = Path(group.broadcast(HydraConfig.get().runtime.output_dir))
    try:
        with group.fail_together():
            conf = to_run(config)
            if conf.resume is not None:
                conf = resumed(conf, [text.lstrip("+~") for text in HydraConfig.get().overrides.task])
            elif (out / "config.yaml").exists():
                raise ValueError(
                    f"{out} holds a run already; go on with resume={out}, or choose another folder."
                )
    except OtherProcessError:
        raise SystemExit(1) from None  # the other process says it
    except Exception as error:
        _give_up(error)
    with log_file() as begin_log:
        try:
            run_experiment(conf, out, group, signals, lambda: begin_log(out / "softmpm_learn.log"))
        except Exception as error:
            if isinstance(error, OtherProcessError) or (isinstance(error, TrainingError) and not group.first):
                raise SystemExit(1) from None
            _give_up(error, _left(error, out, group))


def _left(error: Exception, out: Path, group: Group) -> str:
    """Leave the traceback in the folder of the run, unless that is another's; gives a note on where it is, if people need it."""
    place = out / (f"error.{group.rank}.txt" if group.rank else "error.txt")
    if isinstance(error, LockedError):
        return ""
    try:
        files.replace(place, "".join(traceback.format_exception(error)).encode())
    except OSError as other:
        return "" if isinstance(error, EXPECTED) else f" The traceback could not be saved: {other}"
    return "" if isinstance(error, EXPECTED) else f" The traceback is in {place}."


class _LogFile(logging.FileHandler):
    """A log file that cannot be written ends the run, as any other file does."""

    def handleError(self, record: logging.LogRecord) -> None:
        with files.named("write", Path(self.baseFilename)):
            raise


@contextlib.contextmanager
def log_file() -> Iterator[Callable[[Path], None]]:
    """Gives a function that begins the log file; what was logged before it is called, while the folder may be another's, follows."""
    root = logging.getLogger()
    early = logging.handlers.MemoryHandler(10**6, flushLevel=logging.CRITICAL + 1, flushOnClose=False)
    root.addHandler(early)

    def begin(path: Path) -> None:
        before = files.read(path) if path.exists() else b""
        files.replace(path, before)  # a file of its own, whatever else had its name
        early.setTarget(_LogFile(path, encoding="utf-8"))
        early.flush()
        early.flushLevel = logging.NOTSET

    try:
        yield begin
    finally:
        root.removeHandler(early)
        if early.target is not None:
            early.target.close()
        early.close()


def resumed(conf: RunConf, overrides: list[str]) -> RunConf:
    """The configuration of the run to go on with, with what the command line may change of it."""
    saved = load(Path(str(conf.resume)))
    for key in (text.partition("=")[0] for text in overrides):
        group, _, name = key.partition(".")
        if group == "device":
            saved.device = conf.device
        elif key in CHANGEABLE:
            setattr(saved.train, name, getattr(conf.train, name))
        elif key != "resume":
            raise ValueError(
                f"a run is resumed with its own settings; only {', '.join(CHANGEABLE)} may change, not {key}."
            )
    return saved


def _give_up(error: Exception, more: str = "") -> NoReturn:
    _end(1, f"{sentence(error)}{more}")


def _end(code: int, said: str) -> NoReturn:
    if said:
        print(f"softmpm_learn: {said}", file=sys.stderr)
    raise SystemExit(code)


def sentence(error: BaseException) -> str:
    """Error message in one line, with the remedy where it is known."""
    if isinstance(error, HydraException) and isinstance(error.__cause__, OmegaConfBaseException):
        return sentence(error.__cause__)
    cause = error.__cause__ or error.__context__
    if isinstance(error, InterpolationResolutionError) and isinstance(cause, ValueError):
        return sentence(cause)  # from a resolver of ours
    if isinstance(error, OverrideParseException):
        return f"cannot read {error.override!r}: write key=value, in quotes if it has spaces or brackets."
    if isinstance(error, (ConfigAttributeError, ConfigKeyError)):
        kind = error.object_type
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            return unknown_key(str(error.full_key), kind)
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        return f"{error.full_key}: {_line(str(error).splitlines()[0])}"
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        return f"there is no {group} called {name}; choose one of {', '.join(error.options)}."
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
