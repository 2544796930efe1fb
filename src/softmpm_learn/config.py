"""The settings of a run: one typed schema, and the check that nothing else slipped in.

A file in ``conf/`` holds data only. The task's name picks its settings from the table of tasks; nothing that
a file names is ever imported or called.
"""

import dataclasses
import difflib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from omegaconf import MISSING, DictConfig, OmegaConf

from softmpm_learn.register import CHOICES
from softmpm_learn.setting_checks import one_of, typed
from softmpm_learn.settings import (
    DesignConf,
    LearningConf,
    ObserverConf,
    OptimizerConf,
    PolicyConf,
    Settings,
    TrainConf,
)
from softmpm_learn.storage import sweep
from softmpm_learn.tasks import TASKS, TaskConf

DEVICES = ("auto", "cpu", "cuda")
DTYPES = ("float32", "float64")


@dataclass(kw_only=True)
class DeviceConf:
    """Device and precision of a run."""

    name: str = "auto"
    """auto takes a CUDA GPU if there is one; cpu; cuda."""
    dtype: str = "float32"
    """Precision of the simulation: float32 or float64."""
    threads: int | None = None
    """CPU threads of the simulation, which change no bit of a run; null for one on each core, or OMP_NUM_THREADS. PyTorch has one."""
    memory: float | None = None
    """Most memory that one simulation may keep for its gradient, in each process [MB]; null for a sensible choice."""
    deterministic: bool = False
    """The same bits in every run on one kind of GPU, as on a CPU anyway; slower. On a GPU walkers need task.formulation=reference
    or task.contact=nodes."""

    def __post_init__(self):
        typed("device", self)
        one_of("device.name", self.name, DEVICES)
        one_of("device.dtype", self.dtype, DTYPES)
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"device.threads must be at least 1 or null, got {self.threads}.")
        if self.memory is not None and not 0 < self.memory < math.inf:
            raise ValueError(f"device.memory must be > 0 MB or null, got {self.memory}.")


@dataclass(kw_only=True)
class RunConf:
    """Everything that a run depends on."""

    task: TaskConf = MISSING
    observer: ObserverConf = field(default_factory=ObserverConf)
    policy: PolicyConf = field(default_factory=PolicyConf)
    design: DesignConf = field(default_factory=DesignConf)
    optimizer: OptimizerConf = field(default_factory=OptimizerConf)
    learning: LearningConf = field(default_factory=LearningConf)
    train: TrainConf = field(default_factory=TrainConf)
    device: DeviceConf = field(default_factory=DeviceConf)
    resume: str | None = None
    """Folder of an earlier run to continue; its configuration is used again."""
    files: list[str] = field(default_factory=list)
    """Files that registered robots, observers and policies of one's own; filled in by the program, to name them if one is missing."""
    job: int = 0
    """Number of the job in its sweep; filled in by the program, as is the next, for the tables that a resumed run writes."""
    command_line: list[str] = field(default_factory=list)
    """Settings on the command line, with those that changed when the run was resumed."""

    @property
    def settings(self) -> Settings:
        """Settings of the learning loop."""
        return Settings(**{f.name: getattr(self, f.name) for f in dataclasses.fields(Settings)})


def conf_dir() -> str:
    """Folder of the YAML files: inside the installed package, or at the top of a checkout."""
    here = Path(__file__).resolve().parent
    places = (here / "conf", here.parents[1] / "conf")
    for place in places:
        if (place / "config.yaml").is_file():
            return str(place)
    raise FileNotFoundError(
        f"config.yaml is missing in {' and in '.join(map(str, places))}; install softmpm again."
    )


def register(began: float | None = None) -> None:
    """Give Hydra the schema, choices without a file in ``conf/``, and when the program began; a group that starts with an underscore is
    not offered to users."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    store.store(group="_schema", name="run", node=RunConf)
    for name, (conf, _) in TASKS.items():
        store.store(group="_schema/task", name=name, node=conf)
    for table in CHOICES:
        for name in table.added:
            own = {"name": name, "options": table.defaults(name)} if table is not TASKS else TASKS[name].kind
            store.store(group=table.what, name=name, node=own)
    OmegaConf.register_new_resolver("run_dir", _run_dir, replace=True)
    OmegaConf.register_new_resolver("sweep_name", _sweep_name(), replace=True)
    began = time.time() if began is None else began
    OmegaConf.register_new_resolver(
        "began", lambda pattern: time.strftime(pattern, time.localtime(began)), replace=True
    )


def _sweep_name() -> Callable[[DictConfig], str]:
    """Gives the name of a sweep's folder; jobs, whose command line is only their own part, get that of the whole sweep."""
    names: list[str] = []

    def name(_root_: DictConfig) -> str:
        if not names:
            asked = _root_.hydra.overrides
            sweeper = [text for text in asked.hydra if text.startswith(("hydra/sweeper", "hydra.sweeper"))]
            names.append(sweep.folder_name([*asked.task, *sweeper]))
        return names[0]

    return name


def _run_dir(resume: str | None, fresh: str) -> str:
    """Folder of a run: a resumed one goes on where it is."""
    if resume is None:
        return fresh
    if not (Path(resume) / "config.yaml").is_file():
        raise ValueError(no_run(Path(resume)))
    return resume


def no_run(folder: Path) -> str:
    """The sentence for a folder without a run, with the latest of the runs in it, which may be of several tasks."""
    inside = list(folder.glob("*/config.yaml")) or list(folder.glob("*/*/config.yaml"))
    latest = max(inside, key=lambda path: path.stat().st_mtime, default=None)
    named = f"; the latest run in it is {latest.parent}" if latest else ""
    return f"{folder} holds no run: there is no config.yaml in it{named}."


def to_run(config: DictConfig) -> RunConf:
    """Plain settings from what Hydra composed; raises ValueError for what no schema knows."""
    if OmegaConf.is_missing(config, "task"):
        raise ValueError(f"choose a task: task={', task='.join(TASKS)}.")
    check_keys(config)
    run = OmegaConf.to_object(config)
    if not isinstance(run, RunConf):
        raise ValueError("config.yaml lacks its schema; its defaults must start with /_schema/run@_here_.")
    return run


def check_keys(config: DictConfig, path: str = "") -> None:
    """Raise ValueError for keys that the schema does not have: Hydra lets ``+key=value`` pass."""
    kind = OmegaConf.get_type(config)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):  # else a dict, with names of the user's
        known = {field.name for field in dataclasses.fields(kind)}
        unknown = [str(key) for key in config if key not in known]
        if unknown:
            raise ValueError(unknown_key(f"{path}{unknown[0]}", kind))
    for key in config:
        if not OmegaConf.is_missing(config, key) and isinstance(child := config[key], DictConfig):
            check_keys(child, f"{path}{key}.")


def unknown_key(key: str, kind: type) -> str:
    """The sentence for a key that does not exist, with the nearest one that does."""
    group, _, name = key.rpartition(".")
    known = [f.name for f in dataclasses.fields(kind)]
    near = difflib.get_close_matches(name, known, n=1)
    start = f"{group}." if group else ""
    hint = f"did you mean {start}{near[0]}?" if near else f"known are {', '.join(start + k for k in known)}."
    return f"there is no setting {key}; {hint}"
