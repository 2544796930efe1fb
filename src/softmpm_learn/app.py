"""The bridge from Hydra to plain objects: command line and ``conf/`` in, a run in its folder out."""

import os
import sys
import traceback
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from softmpm_learn.config import RunConf, conf_dir, load, save, to_run
from softmpm_learn.errors import EXPECTED, sentence
from softmpm_learn.run import run
from softmpm_learn.tasks import TASKS

CHANGEABLE = ("train.iterations", "train.record_every", "device")
"""What may differ when a run is resumed: how far it goes, what it records and where it runs."""


def main() -> None:
    """Entry of ``python -m softmpm_learn``: exit code 0, or 1 after one sentence that says what went wrong."""
    full = bool(os.environ.get("HYDRA_FULL_ERROR"))  # the user asks for tracebacks
    os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints an error its own way, in several lines
    register()
    try:
        hydra.main(version_base="1.3", config_path=conf_dir(), config_name="config")(job)()
    except Exception as error:
        if full:
            raise
        _give_up(error)


def register() -> None:
    """Give Hydra the schema; a group that starts with an underscore is not offered to users."""
    store = ConfigStore.instance()
    store.store(group="_schema", name="run", node=RunConf)
    for name, (conf, _) in TASKS.items():
        store.store(group="_schema/task", name=name, node=conf)
    OmegaConf.register_new_resolver("run_dir", _run_dir, replace=True)


def _run_dir(resume: str | None, fresh: str) -> str:
    """Folder of a run: a resumed one goes on where it is."""
    if resume is None:
        return fresh
    if not (Path(resume) / "config.yaml").is_file():
        raise ValueError(f"there is no run to resume in {resume}: it has no config.yaml.")
    return resume


def job(config: DictConfig) -> None:
    """One run. An error ends it with a sentence on stderr and the traceback in its folder."""
    out = Path(HydraConfig.get().runtime.output_dir)
    try:
        conf = to_run(config)
        resume = conf.resume is not None
        if resume:
            conf = resumed(conf, [text.lstrip("+~") for text in HydraConfig.get().overrides.task])
        elif (out / "config.yaml").exists():
            raise ValueError(f"{out} holds a run already; go on with resume={out}, or choose another folder.")
    except Exception as error:
        _give_up(error)
    save(conf, out / "config.yaml")
    try:
        run(conf, out, resume=resume)
    except Exception as error:
        (out / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")
        _give_up(error, "" if isinstance(error, EXPECTED) else f" The traceback is in {out / 'error.txt'}.")


def resumed(conf: RunConf, overrides: list[str]) -> RunConf:
    """The configuration of the run to go on with, with what the command line may change of it."""
    saved = load(Path(str(conf.resume)) / "config.yaml")
    for key in (text.partition("=")[0] for text in overrides):
        if key == "train.iterations":
            saved.train.iterations = conf.train.iterations
        elif key == "train.record_every":
            saved.train.record_every = conf.train.record_every
        elif key.partition(".")[0] == "device":
            saved.device = conf.device
        elif key != "resume":
            raise ValueError(
                f"a run is resumed with its own configuration; only {', '.join(CHANGEABLE)} may change, not {key}."
            )
    return saved


def _give_up(error: Exception, more: str = "") -> NoReturn:
    print(f"softmpm_learn: {sentence(error)}{more}", file=sys.stderr)
    raise SystemExit(1)
