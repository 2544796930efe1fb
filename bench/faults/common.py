"""Common parts of the fault scripts: the smallest run that has every phase, forked child processes, tables of outcomes."""

import argparse
import collections
import contextlib
import dataclasses
import functools
import logging
import math
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar
from unittest import mock

import torch
import torch._dynamo  # any optimiser loads it, which here would take most of the time of each child
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

import softmpm
from softmpm_learn.command import app, experiment, farewell
from softmpm_learn.command.sentences import sentence
from softmpm_learn.command.stop import SIGNALS, Signals
from softmpm_learn.config import RunConf, conf_dir, to_run
from softmpm_learn.storage import checkpoint
from softmpm_learn.storage.log_file import log_file

TINY = [
    *("task=arm", "experiment=smoke", "task.seconds=0.025", "task.control_period=0.0125", "device=cpu"),
    *("task.young=1e3", "task.strength=50", "task.safety=0.8"),  # so soft that two substeps will do
    *("learning.epochs=1", "learning.batches=1", "learning.simulations=2", "train.iterations=4"),
    "train.pictures=false",
]
LIMIT = 60.0
"""Time limit of a child [s], beyond which it counts as hung; an undisturbed one takes about a second."""


@dataclass(frozen=True)
class Ended:
    """End of a child process."""

    code: int
    """Exit code; minus the signal that killed it."""
    output: str
    """Its stdout and stderr."""
    hung: bool
    megabytes: float = 0.0
    """Memory [MB] beyond that of this process."""


def forked(work: Callable[[], None], during: Callable[[int], None] = lambda pid: None, limit=LIMIT) -> Ended:
    """Run ``work`` in a child process, and meanwhile ``during`` with its process id in this process."""
    reader, writer = os.pipe()  # holds 64 kB; a file would be subject to a limit on the size of files
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # until the child answers them
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            os.dup2(writer, 1)
            os.dup2(writer, 2)
            code = _code_of(work)
        finally:
            os._exit(code)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.close(writer)
    during(pid)
    end = time.monotonic() + limit
    while (found := os.wait4(pid, os.WNOHANG))[0] == 0 and time.monotonic() < end:
        time.sleep(0.005)
    hung = found[0] == 0
    if hung:
        os.kill(pid, signal.SIGKILL)
        found = os.wait4(pid, 0)
    with os.fdopen(reader, "rb") as pipe:
        text = pipe.read().decode(errors="replace")
    here = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    megabytes = (found[2].ru_maxrss - here) * 1024 / 1e6
    return Ended(os.waitstatus_to_exitcode(found[1]), text, hung, megabytes)


def _code_of(work: Callable[[], None]) -> int:
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
    code = 0
    try:
        work()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 70
    sys.stdout.flush()
    sys.stderr.flush()
    return code


def program(*arguments: str) -> Callable[[], None]:
    """``python -m softmpm_learn`` with these arguments, as work of a child; pictures included."""

    def work() -> None:
        GlobalHydra.instance().clear()
        signals = Signals()
        signals.install()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        sys.argv = ["softmpm_learn", *arguments]
        app.main(signals)

    return work


def fresh(folder: Path, *more: str) -> Callable[[], None]:
    """The smallest run, as work of a child, written to this folder."""
    conf = _composed(*TINY, *more)
    return _training(lambda: conf, folder)


def resume(folder: Path, iterations: int = 4) -> Callable[[], None]:
    """Resume the run in this folder, as work of a child."""
    asked = dataclasses.replace(_composed(*TINY, f"train.iterations={iterations}"), resume=str(folder))
    overrides = [f"resume={folder}", f"train.iterations={iterations}"]
    return _training(lambda: app.resumed(asked, overrides), folder)


@functools.cache
def _composed(*overrides: str) -> RunConf:
    """Configuration that Hydra composes, cached: composition would take most of the time of a child."""
    app.register()
    GlobalHydra.instance().clear()
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return to_run(compose("config", list(overrides)))


def _training(conf: Callable[[], RunConf], folder: Path) -> Callable[[], None]:
    """As :func:`softmpm_learn.command.app.job`, without pictures."""

    def work() -> None:
        logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout, force=True)
        try:
            with log_file() as begin, unconverted():
                experiment.run_experiment(conf(), folder, begin=lambda: begin(folder / "softmpm_learn.log"))
        except Exception as error:
            print(f"softmpm_learn: {sentence(error)}", file=sys.stderr)
            raise SystemExit(1) from None

    return work


def unconverted() -> contextlib.AbstractContextManager:
    """Runs end without the conversion for Rerun."""
    return mock.patch.object(farewell, "convert", return_value="nothing")


@contextlib.contextmanager
def workshop() -> Iterator[Path]:
    """An empty folder, removed at the end; a single thread, so that equal runs are bitwise identical."""
    torch.set_num_threads(1)
    _rehearse()
    folder = Path(tempfile.mkdtemp(prefix="faults-"))
    here = os.getcwd()
    os.chdir(folder)
    try:
        yield folder
    finally:
        os.chdir(here)
        shutil.rmtree(folder)


@functools.cache
def _rehearse() -> None:
    """The smallest run in this process: its children inherit the kernels and imports, which would take most of their time."""
    with tempfile.TemporaryDirectory(prefix="rehearsal-") as folder, unconverted():
        experiment.run_experiment(_composed(*TINY), Path(folder))


def fingerprint(folder: Path) -> dict[str, object]:
    """Data in which two equal runs agree to the bit: metrics, checkpoint, replay buffer and recorded numbers."""
    saved = checkpoint.load(folder)
    del saved["seals"]["timing.csv"]  # depends on the clock
    found: dict[str, object] = {"metrics.csv": (folder / "metrics.csv").read_bytes()}
    found |= {f"checkpoint {k}": v for k, v in _flat(saved)}
    for path in sorted((folder / "replay").iterdir()):
        found[path.name] = path.read_bytes()
    with softmpm.Recording(folder / "run.h5") as recording:
        for iteration in recording.episodes:
            for name, values in recording.frames(iteration).items():
                found[f"episode {iteration} {name}"] = values.tobytes()
        for name, columns in recording.scalars.items():
            found[f"scalar {name}"] = tuple(column.tobytes() for column in columns)
    return found


def _flat(value: object, path: str = "") -> Iterable[tuple[str, object]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(item, f"{path}.{key}")
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _flat(item, f"{path}[{k}]")
    else:
        yield path, (value.numpy().tobytes() if isinstance(value, torch.Tensor) else repr(value))


def killed_run(folder: Path, rows: int = 3) -> None:
    """A run killed by SIGKILL once metrics.csv has ``rows`` rows."""

    def kill(pid: int) -> None:
        metrics = folder / "metrics.csv"
        while not (metrics.exists() and metrics.read_text().count("\n") > rows):
            if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                return  # it ended by itself, and says why
            time.sleep(0.002)
        os.kill(pid, signal.SIGKILL)

    ended = forked(fresh(folder), kill)
    assert ended.code == -signal.SIGKILL, ended.output


def same(folder: Path, whole: dict[str, object]) -> str:
    """``same``, or the first item that differs."""
    found = fingerprint(folder)
    for name in whole.keys() | found.keys():
        if whole.get(name) != found.get(name):
            return f"differs: {name}"
    return "same"


def unclear(output: str) -> bool:
    """True for an uninformative error: a traceback, an internal error, a bare error number."""
    words = ("Traceback", "fault of the program", "[Errno", "ModuleNotFoundError")
    return any(word in output for word in words)


class Table:
    """Outcomes of trials, counted by kind."""

    def __init__(self, title: str, bad: Iterable[str]):
        self.title, self.bad = title, tuple(bad)
        self.counts: dict[str, collections.Counter] = {}
        self.details: list[str] = []

    def add(self, row: str, outcome: str, detail: str = "") -> None:
        """One trial of a row; ``outcome`` is a column."""
        self.counts.setdefault(row, collections.Counter())[outcome] += 1
        if outcome in self.bad:
            self.details.append(f"{row}: {outcome}: {detail.strip()[-600:]}")

    def total(self, outcome: str | None = None) -> int:
        return sum(c.total() if outcome is None else c[outcome] for c in self.counts.values())

    @property
    def failures(self) -> int:
        """Trials with a bad outcome."""
        return sum(self.total(outcome) for outcome in self.bad)

    def __str__(self) -> str:
        columns = list(dict.fromkeys([*(o for c in self.counts.values() for o in c), *self.bad]))
        width = max(map(len, [*self.counts, "total"]))
        lines = [f"{self.title}: {self.total()} trials, {self.failures} bad"]
        lines += ["  ".join([" " * width, "trials", *columns])]
        for row, count in [*self.counts.items(), ("total", None)]:
            cells = [self.total(c) if count is None else count[c] for c in columns]
            trials = self.total() if count is None else count.total()
            numbers = [f"{n:>{len(c)}}" for n, c in zip([trials, *cells], ["trials", *columns], strict=True)]
            lines.append("  ".join([f"{row:<{width}}", *numbers]))
        return "\n".join([*lines, *self.details])


T = TypeVar("T")


def some(trials: list[T], share: float) -> list[T]:
    """A share of the trials, always the same ones; all of them for a share of 1."""
    return trials if share == 1.0 else random.Random(0).sample(trials, math.ceil(len(trials) * share))


def damaged(data: bytes, chance: random.Random) -> bytes:
    """The bytes with one bit flipped."""
    spoilt = bytearray(data)
    spoilt[chance.randrange(len(spoilt))] ^= 1 << chance.randrange(8)
    return bytes(spoilt)


def report(*rounds: Callable[[float], Table]) -> None:
    """Print the tables of the given scripts; exit with code 1 if a trial had a bad outcome."""
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="share of the trials, 1 for all")
    share = parser.parse_args().share
    failures = 0
    for main in rounds:
        table = main(share)
        print(table, flush=True)
        failures += table.failures
    raise SystemExit(1 if failures else 0)
