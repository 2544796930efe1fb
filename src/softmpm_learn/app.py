"""The bridge from Hydra to plain objects: command line and ``conf/`` in, a run in its folder out."""

import dataclasses
import logging
import os
import sys
import time
import traceback
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

from softmpm_learn.config import RunConf, conf_dir, load, save, to_run, unknown_key
from softmpm_learn.distributed import Group, OtherProcessError, in_full, joined
from softmpm_learn.experiment import run_experiment
from softmpm_learn.tasks import TASKS
from softmpm_learn.train import TrainingError

CHANGEABLE = ("train.iterations", "train.record_every", "train.frame_every", "device")
"""What may differ when a run is resumed: how far it goes, what it records and where it runs."""
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


def main() -> None:
    """Entry of ``python -m softmpm_learn``: exit code 0, or 1 after one sentence on what went wrong."""
    full = bool(os.environ.get("HYDRA_FULL_ERROR"))  # the user asks for tracebacks
    os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints an error its own way, in several lines
    group = Group()
    try:
        with joined() as group:
            if not group.first:
                logging.disable(logging.WARNING)  # the first process says it
            register(group.tell(time.time()))
            run = hydra.main(version_base="1.3", config_path=conf_dir(), config_name="config")
            run(lambda config: job(config, group))()
    except Exception as error:
        if full:
            raise
        if not group.first:
            raise SystemExit(1) from None  # the first process says the same
        _give_up(error)
    except KeyboardInterrupt:
        _interrupted(group, "No iteration had begun.")


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


def job(config: DictConfig, group: Group) -> None:
    """One run. An error ends it with a sentence on stderr and the traceback in its folder, both from where it happened."""
    out = Path(group.tell(HydraConfig.get().runtime.output_dir))
    try:
        with group.together():
            conf = to_run(config)
            if conf.resume is not None:
                conf = resumed(conf, [text.lstrip("+~") for text in HydraConfig.get().overrides.task])
            elif (out / "config.yaml").exists():
                raise ValueError(
                    f"{out} holds a run already; go on with resume={out}, or choose another folder."
                )
        group.once(save, conf, out / "config.yaml")
    except OtherProcessError:
        raise SystemExit(1) from None  # the other process says it
    except Exception as error:
        _give_up(error)
    try:
        run_experiment(conf, out, group)
    except Exception as error:
        if isinstance(error, OtherProcessError) or (isinstance(error, TrainingError) and not group.first):
            raise SystemExit(1) from None
        place = out / (f"error.{group.rank}.txt" if group.rank else "error.txt")
        place.write_text(traceback.format_exc(), encoding="utf-8")
        _give_up(error, "" if isinstance(error, EXPECTED) else f" The traceback is in {place}.")
    except KeyboardInterrupt:
        _interrupted(group, f"Finished iterations are saved; to go on, or to draw the pictures: resume={out}")


def resumed(conf: RunConf, overrides: list[str]) -> RunConf:
    """The configuration of the run to go on with, with what the command line may change of it."""
    saved = load(Path(str(conf.resume)) / "config.yaml")
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


def _interrupted(group: Group, advice: str) -> NoReturn:
    _end(130, f"interrupted. {advice}" if group.first else "")


def _end(code: int, said: str) -> NoReturn:
    if said:
        print(f"softmpm_learn: {said}", file=sys.stderr)
    raise SystemExit(code)


def sentence(error: BaseException) -> str:
    """What went wrong and, where it is known, what to do, in one line."""
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
    if isinstance(error, torch.OutOfMemoryError) or "memory_budget" in text:  # as the simulator calls it
        text += " Settings for that: train.worlds, task.resolution and device.memory."
    return _line(
        text if isinstance(error, EXPECTED) else f"{type(error).__name__}: {text} (a fault of the program)"
    )


def _line(text: str) -> str:
    """A message on one line, without Hydra's list of search paths."""
    text = " ".join(text.partition("Config search path:")[0].split())
    return text if text.endswith((".", "!", "?")) else f"{text}."
