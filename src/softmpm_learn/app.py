"""The bridge from Hydra to plain objects: command line and ``conf/`` in, a run in its folder out."""

import dataclasses
import logging
import math
import os
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from softmpm_learn import files, plugins, seeds, sweep
from softmpm_learn.checkpoint import LockedError
from softmpm_learn.config import RunConf, conf_dir, register, to_run
from softmpm_learn.distributed import Group, OtherProcessError, joined
from softmpm_learn.experiment import run_experiment
from softmpm_learn.log_file import log_file
from softmpm_learn.optimisation import TrainingError
from softmpm_learn.saved import load as saved_configuration
from softmpm_learn.sentences import EXPECTED, sentence
from softmpm_learn.stop import Signals
from softmpm_learn.train import Result

logger = logging.getLogger("softmpm_learn")

CHANGEABLE = (
    "train.iterations",
    "train.save_every",
    "train.record_every",
    "train.frame_every",
    "train.examine",
    "train.pictures",
    "train.log",
    "device",
)
"""Settings that may differ when a run is resumed: its length, checkpoints, recorded episodes, pictures, loggers and the device."""


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
            register(group.broadcast(time.time()))
            failed: dict[int, Path] = {}
            run = hydra.main(version_base="1.3", config_path=conf_dir(), config_name="config")
            run(lambda config: job(config, group, signals, failed))()
            if failed:
                numbers, table = ", ".join(map(str, failed)), next(iter(failed.values()))
                _end(1, f"these jobs of {table} failed: {numbers}; the same command tries them again.")
    except Exception as error:
        if full:
            raise
        if not group.first:
            raise SystemExit(1) from None  # the first process says the same
        _give_up(error)
    except KeyboardInterrupt:
        _end(130, "" if signals.quiet else f"interrupted. {signals.advice}")


def load(own: Sequence[str]) -> None:
    """Import files of the user and installed packages, or end with one sentence on what went wrong."""
    try:
        _load(own)
    except Exception as error:
        if os.environ.get("HYDRA_FULL_ERROR"):
            raise
        _give_up(error)


def _load(own: Sequence[str]) -> None:
    plugins.need_complete()
    plugins.load_packages()
    for path in own:
        plugins.load(path)


class JobError(Exception):
    """A run that failed: the sentence for people, empty where another process has it, and the iterations done before."""

    def __init__(self, text: str = "", iterations: int = 0):
        super().__init__(text)
        self.iterations = iterations


class RefusedError(JobError):
    """A run that is another's: its folder is left as it is."""


def job(config: DictConfig, group: Group, signals: Signals, failed: dict[int, Path]) -> float:
    """One run, or a job of a sweep; gives the objective, its lowest loss. An error ends a run with a sentence on stderr, and is the
    outcome of a job, whose number is added to ``failed``.
    """
    hydra_config = HydraConfig.get()
    out = Path(group.broadcast(hydra_config.runtime.output_dir))
    if hydra_config.mode == RunMode.MULTIRUN:
        return _swept(config, out, group, signals, failed)
    try:
        conf = _configured(config, out, group)
        results = _experiment(conf, out, group, signals)
        if conf.train.seeds > 1:
            words = [text for text in hydra_config.overrides.task if not text.startswith("resume=")]
            about = {"job": 0, "settings": " ".join(words), "folder": str(out)}
            found = seeds.record(conf, out, results, group, about)
            if found and found.status == "failed":
                _end(1, f"{found.error} The other seeds are finished; resume={out} tries again.")
        return seeds.median_loss(results)
    except JobError as failure:
        _end(1, str(failure))


def _swept(config: DictConfig, out: Path, group: Group, signals: Signals, failed: dict[int, Path]) -> float:
    """A job of a sweep: skipped if it has finished, gone on with if it has begun. Only its own failure lets the next one run."""
    hydra_config, loss = HydraConfig.get(), math.inf
    number, table = int(hydra_config.job.num), Path(hydra_config.sweep.dir) / sweep.TABLE
    about = {"job": number, "settings": " ".join(hydra_config.overrides.task), "folder": str(out)}
    try:
        conf = _configured(config, out, group)
        before = group.broadcast(group.once(sweep.outcome, out))
        if before and before.status == "finished" and before.iterations >= conf.train.iterations:
            group.once(sweep.tabulate, table.parent)  # a kill may have come between outcome and table
            logger.info("Job %d had finished with the loss %.5g: %s", number, before.loss, out)
            return before.loss
        results = _experiment(conf, out, group, signals)
        if conf.train.seeds > 1:
            found = seeds.record(conf, out, results, group, about)
        else:
            found = seeds.outcome(results[0], about) if results[0].finished else None
        if found is None:
            logger.info("The same command goes on with the sweep.")
            raise SystemExit(0)
        if found.status == "failed":
            raise JobError(found.error, found.iterations)
        loss = found.loss
    except JobError as failure:
        if isinstance(failure, RefusedError):
            _end(1, str(failure))
        if str(failure):
            print(f"softmpm_learn: job {number}: {failure}", file=sys.stderr)
        failed[number] = table
        found = sweep.Outcome(status="failed", error=str(failure), iterations=failure.iterations, **about)
    except (ValueError, OSError) as error:
        _give_up(error)
    if group.first:
        sweep.record(out, found)
        sweep.tabulate(table.parent)
    if failed and group.size > 1:
        raise SystemExit(1)  # the processes may no longer be in step; the same command goes on
    return loss


def _configured(config: DictConfig, out: Path, group: Group) -> RunConf:
    """Settings of a run, of the one to resume or of one to begin."""
    try:
        with group.fail_together():
            conf, hydra_config = to_run(config), HydraConfig.get()
            conf.files = plugins.files()
            sweeps, begun = hydra_config.mode == RunMode.MULTIRUN, (out / "config.yaml").exists()
            if conf.resume is not None:
                if sweeps:
                    raise ValueError("resume=FOLDER is for one run; the same command goes on with a sweep.")
                return resumed(conf, [text.lstrip("+~") for text in hydra_config.overrides.task])
            if begun and not sweeps:
                raise RefusedError(
                    f"{out} holds a run already; go on with resume={out}, or choose another folder."
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


def _experiment(conf: RunConf, out: Path, group: Group, signals: Signals) -> list[Result]:
    """The run; an error leaves its traceback in the folder, from where it happened."""
    with log_file() as begin_log:
        try:
            return run_experiment(conf, out, group, signals, lambda: begin_log(out / "softmpm_learn.log"))
        except Exception as error:
            if isinstance(error, OtherProcessError) or (isinstance(error, TrainingError) and not group.first):
                raise JobError from None
            kind = RefusedError if isinstance(error, LockedError) else JobError
            done = error.iteration if isinstance(error, TrainingError) else 0
            raise kind(f"{sentence(error)}{_left(error, out, group)}", done) from error


def _fixed(conf: RunConf) -> dict:
    """Settings that a run keeps when it is resumed."""
    flat = dataclasses.asdict(conf)
    for key in (*CHANGEABLE, "resume", "files"):
        group, _, name = key.partition(".")
        del (flat[group] if name else flat)[name or group]
    return flat


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


def resumed(conf: RunConf, overrides: list[str]) -> RunConf:
    """The configuration of the run to go on with, with what the command line may change of it."""
    saved = saved_configuration(Path(str(conf.resume)))
    saved.files = conf.files
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
