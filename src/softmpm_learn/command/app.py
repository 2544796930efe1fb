"""The bridge from Hydra to plain objects: command line and ``conf/`` in, a run in its folder out."""

import argparse
import dataclasses
import logging
import math
import os
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from softmpm_learn import plugins
from softmpm_learn.command import seeds
from softmpm_learn.command.jobs import (
    Job,
    JobError,
    RefusedError,
    experiments,
    fail,
    outcome,
    run_jobs,
    side_by_side,
)
from softmpm_learn.command.sentences import end, give_up, sentence
from softmpm_learn.command.stop import Signals
from softmpm_learn.config import RunConf, conf_dir, register, to_run
from softmpm_learn.distributed import Group, OtherProcessError, joined
from softmpm_learn.runs.identity import MAY_CHANGE
from softmpm_learn.runs.saved import load as saved_configuration
from softmpm_learn.storage import sweep
from softmpm_learn.training.optimisation import TrainingError

logger = logging.getLogger("softmpm_learn")

CHANGEABLE = (*(f"train.{name}" for name in MAY_CHANGE), "device")
"""Settings that may differ when a run is resumed: its length, checkpoints, recorded episodes, pictures, loggers, the jobs beside it and
the device."""


def main(signals: Signals | None = None, own: Sequence[str] = ()) -> None:
    """Entry of ``python -m softmpm_learn``: exit code 0, or 1 after one sentence on what went wrong.

    Args:
        own: Files of the user to import first.
    """
    full = bool(os.environ.get("HYDRA_FULL_ERROR"))  # the user asks for tracebacks
    os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints an error its own way, in several lines
    group, signals = Group(), signals or Signals()
    try:
        with joined() as group:
            if not group.first:
                signals.quiet = True
                logging.disable(logging.WARNING)  # the first process says it
            _load(own)
            sys.argv[1:] = map(with_infinity, sys.argv[1:])
            check_flags(sys.argv[1:])
            check_words(sys.argv[1:])
            register(group.broadcast(time.time()))
            waiting, failed = list[Job](), dict[int, Path]()
            run = hydra.main(version_base="1.3", config_path=conf_dir(), config_name="config")
            run(lambda config: job(config, group, signals, waiting, failed))()
            for jobs in side_by_side(waiting):
                run_jobs(jobs, group, signals, failed)
            if failed:
                numbers, table = ", ".join(map(str, failed)), next(iter(failed.values()))
                end(1, f"these jobs of {table} failed: {numbers}; the same command tries them again.")
    except Exception as error:
        if full:
            raise
        if not group.first:
            raise SystemExit(1) from None  # the first process says the same
        give_up(error)
    except KeyboardInterrupt:
        end(130, "" if signals.quiet else f"interrupted. {signals.advice}")


def load(own: Sequence[str]) -> None:
    """Import files of the user and installed packages, or end with one sentence on what went wrong."""
    try:
        _load(own)
    except Exception as error:
        if os.environ.get("HYDRA_FULL_ERROR"):
            raise
        give_up(error)


def _load(own: Sequence[str]) -> None:
    plugins.need_complete()
    plugins.load_packages()
    for path in own:
        plugins.load(path)


def job(
    config: DictConfig, group: Group, signals: Signals, waiting: list[Job], failed: dict[int, Path]
) -> float:
    """One run, or a job of a sweep; gives the objective, its lowest loss. An error ends a run with a sentence on stderr, and is the
    outcome of a job, whose number is added to ``failed``. A job that goes side by side with others is added to ``waiting``.
    """
    hydra_config = HydraConfig.get()
    out = Path(group.broadcast(hydra_config.runtime.output_dir))
    if hydra_config.mode == RunMode.MULTIRUN:
        return _swept(config, out, group, signals, waiting, failed)
    try:
        conf = _configured(config, out, group)
        about = {"job": conf.job, "settings": " ".join(conf.command_line), "folder": str(out)}
        try:
            (results,) = experiments([(conf, out)], group, signals)
        except JobError as failure:
            if group.first and isinstance(failure.__cause__, TrainingError):
                sweep.update(out, failure.outcome(about))
            raise
        found = outcome(conf, out, results, group, about)
        if found:
            group.once(sweep.update, out, found)
        if found and found.status == "failed":
            others = "The other seeds are finished; " if any(result.finished for result in results) else ""
            end(1, f"{found.error} {others}{plugins.resume(out)} tries again.")
        return seeds.median_loss(results)
    except JobError as failure:
        end(1, str(failure))


def _swept(
    config: DictConfig,
    out: Path,
    group: Group,
    signals: Signals,
    waiting: list[Job],
    failed: dict[int, Path],
) -> float:
    """A job of a sweep: skipped if it has finished, gone on with if it has begun."""
    hydra_config = HydraConfig.get()
    number, table = int(hydra_config.job.num), Path(hydra_config.sweep.dir) / sweep.TABLE
    mine = Job(number=number, settings=" ".join(hydra_config.overrides.task), out=out, table=table)
    try:
        mine.conf = _configured(config, out, group)
        mine.seed = mine.conf.train.seed if mine.conf.train.seeds == 1 else None
        before = group.broadcast(group.once(sweep.outcome, out))
        if before and before.status == "finished" and before.iterations >= mine.conf.train.iterations:
            group.once(sweep.tabulate, table.parent)  # a kill may have come between outcome and table
            logger.info("Job %d had finished with the loss %.5g: %s", number, before.loss, out)
            return before.loss
        if mine.conf.train.side_by_side > 1:
            if not hydra_config.sweeper._target_.endswith("BasicSweeper"):
                raise ValueError(
                    "train.side_by_side begins once all jobs are known, but this sweeper needs the loss of one to choose the next; set "
                    f"it to 1. The sweeper is {hydra_config.sweeper._target_}."
                )
            waiting.append(mine)
            return math.nan
    except JobError as failure:
        return fail([mine], failure, group, failed)[0]
    except (ValueError, OSError) as error:
        give_up(error)
    return run_jobs([mine], group, signals, failed)[0]


def _configured(config: DictConfig, out: Path, group: Group) -> RunConf:
    """Settings of a run, of the one to resume or of one to begin."""
    try:
        with group.fail_together():
            conf, hydra_config = to_run(config), HydraConfig.get()
            conf.command_line = asked(hydra_config.overrides.task)
            conf.files = plugins.files()
            sweeps, begun = hydra_config.mode == RunMode.MULTIRUN, (out / "config.yaml").exists()
            if conf.resume is not None:
                if sweeps:
                    raise ValueError("resume=FOLDER is for one run; the same command goes on with a sweep.")
                return resumed(conf, hydra_config.overrides.task)
            conf.job = int(hydra_config.job.num) if sweeps else 0
            if begun and not sweeps:
                raise RefusedError(
                    f"{out} holds a run already; go on with {plugins.resume(out)}, or choose another folder."
                )
            if begun and _fixed(saved_configuration(out)) != _fixed(conf):
                raise RefusedError(
                    f"{out} holds a run with other settings; choose another folder for the sweep with hydra.sweep.dir=FOLDER."
                )
            return conf
    except JobError:
        raise
    except OtherProcessError:
        raise JobError from None  # the other process says it
    except Exception as error:
        raise JobError(sentence(error)) from error


def _fixed(conf: RunConf) -> dict:
    """Settings that a run keeps when it is resumed."""
    flat = dataclasses.asdict(conf)
    for key in (*CHANGEABLE, "resume", "files", "job", "command_line"):
        group, _, name = key.partition(".")
        del (flat[group] if name else flat)[name or group]
    return flat


def check_flags(words: Sequence[str]) -> None:
    """Raise ValueError for flags that Hydra does not have, for which it would print the usage of all that it has."""
    parser = get_args_parser()
    parser.exit_on_error = False
    try:
        _, unknown = parser.parse_known_args(words)
    except argparse.ArgumentError as error:
        raise ValueError(f"{error}; --hydra-help explains the flags.") from error
    flags = [word for word in unknown if word[:1] == "-"]
    if flags:
        raise ValueError(
            f"there is no flag {flags[0]}: settings are words such as train.iterations=5; --help lists them."
        )
    if unknown:
        raise ValueError(f"settings must follow each other: write {unknown[0]} before the flags.")


def check_words(words: Sequence[str]) -> None:
    """Raise ValueError for a setting on the command line that the run to resume must not have; before Hydra looks for it in those of
    the default task. A sweep refuses ``resume`` itself.
    """
    keys = [_key(text) for text in words if ("=" in text or text[:1] == "~") and text[:1] != "-"]
    one = "resume" in keys and not {"-m", "--multirun"} & set(words)
    for key in keys if one else ():
        if key not in (*CHANGEABLE, "resume") and not key.startswith(("device.", "hydra.", "hydra/")):
            raise ValueError(
                f"a run is resumed with its own settings; only {', '.join(CHANGEABLE)} may change, not {key}."
            )


def with_infinity(word: str) -> str:
    """A word of the command line whose values may be infinity as YAML writes it, ``.inf``, as Hydra reads it: ``inf``."""
    return re.sub(r"(?<=[=,])([+-]?)\.inf(?=,|$)", r"\1inf", word, flags=re.IGNORECASE)


def _key(text: str) -> str:
    return text.lstrip("+~").partition("=")[0]


def asked(overrides: Sequence[str]) -> list[str]:
    """Settings on the command line, without the folder to resume. Those that refer to others have their values, which Hydra's list of
    them gives: a saved configuration has no references.
    """
    return [text for text in overrides if _key(text) != "resume"]


def resumed(conf: RunConf, overrides: Sequence[str]) -> RunConf:
    """The configuration of the run to go on with, with what the command line may change of it; see :func:`check_words`."""
    saved = saved_configuration(Path(str(conf.resume)))
    saved.files = conf.files
    words = {_key(text): text for text in [*saved.command_line, *conf.command_line]}
    saved.command_line = list(words.values())
    for group, _, name in (_key(text).partition(".") for text in overrides):
        if group == "device":  # device=cuda is its name
            setattr(saved.device, name or "name", getattr(conf.device, name or "name"))
        elif group == "train":
            setattr(saved.train, name, getattr(conf.train, name))
    return saved
