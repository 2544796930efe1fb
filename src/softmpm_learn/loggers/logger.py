"""The interface of a logger, and the loggers of a run together.

The files of a run do not depend on them. One that cannot begin ends the run before anything is simulated, in a sentence. One that fails
later is switched off with a warning; when the run is resumed, it receives the rows that it has missed, from metrics.csv and timing.csv.
"""

import contextlib
import csv
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from softmpm_learn.register import LOGGERS

log = logging.getLogger("softmpm_learn")


class Logger(Protocol):
    """Receives what a run writes, in the order of the iterations. Seeds side by side have one each, whose calls come one after another,
    but from different threads.
    """

    def scalars(self, iteration: int, row: Mapping[str, float]) -> None:
        """A row of metrics.csv without empty cells, and one of timing.csv as ``seconds/NAME`` [s]; or the answers of the examination.
        What has returned must survive a kill: no later call repeats it.
        """

    def picture(self, iteration: int, name: str, path: Path) -> None:
        """A PNG file that was drawn: robot, loss or latent."""

    def close(self) -> None:
        """The run ends here, for now."""


class Loggers:
    """Loggers of a run; use as a context manager. Nothing begins before :meth:`open`.

    Args:
        names: Registered names.
        out: Folder of the run.
    """

    def __init__(self, names: Sequence[str], out: Path):
        self.names, self.out = list(names), out
        self._open: dict[str, Logger] = {}
        self._known: dict[str, int] = {}

    def open(self, iteration: int, known: Mapping[str, int], settings: Mapping[str, Any]) -> None:
        """Begin, or go on where the run goes on, after the rows that a logger has missed.

        Args:
            iteration: The next one of the run.
            known: What :meth:`known` gave for the checkpoint.
            settings: Settings of the run, plain.

        Raises:
            ImportError: A package is missing; has the command that installs it.
            RuntimeError: A logger cannot begin; names it.
        """
        for name in self.names:
            first = min(known.get(name, 0), iteration)
            try:
                made = LOGGERS.build(name, {}, self.out, first, settings)
                self._open[name] = made
                for k, row in rows(self.out, first, iteration):
                    made.scalars(k, row)
            except ImportError:
                raise
            except Exception as error:
                raise RuntimeError(
                    f"the logger {name} of train.log cannot begin: {type(error).__name__}: {error}"
                ) from error
        self._known = dict(known)

    def known(self, iteration: int) -> dict[str, int]:
        """First iteration that each logger lacks, when ``iteration`` is the next one of the run; those not in use included."""
        return self._known | dict.fromkeys(self._open, iteration)

    def scalars(self, iteration: int, row: Mapping[str, float], seconds: Mapping[str, float] | None) -> None:
        """A row of metrics.csv and one of timing.csv; values that are not finite are left out."""
        shown = _shown(row, seconds or {})
        for name in list(self._open):
            with self._guard(name, iteration):
                self._open[name].scalars(iteration, shown)

    def pictures(self, iteration: int, paths: Iterable[Path]) -> None:
        """Pictures as they are now; a file that is not there is left out."""
        for path in paths:
            for name in list(self._open) if path.exists() else ():
                with self._guard(name, iteration):
                    self._open[name].picture(iteration, path.stem, path)

    @contextlib.contextmanager
    def _guard(self, name: str, iteration: int) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            failed, self._known[name] = self._open.pop(name), iteration
            log.warning(
                "The logger %s failed in iteration %d and is switched off; the run goes on, and its files have everything. %s: %s",
                *(name, iteration, type(error).__name__, error),
            )
            with contextlib.suppress(Exception):  # has failed already
                failed.close()

    def __enter__(self) -> "Loggers":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        while self._open:
            name, one = self._open.popitem()
            try:
                one.close()
            except Exception as problem:
                log.warning(
                    "The logger %s could not be closed. %s: %s", name, type(problem).__name__, problem
                )


def rows(out: Path, first: int, last: int) -> Iterator[tuple[int, dict[str, float]]]:
    """Entries that a logger receives in iterations ``first`` to ``last - 1``, from the files of a run."""
    if first >= last:
        return
    seconds = dict(_numbers(out / "timing.csv"))
    for k, row in _numbers(out / "metrics.csv"):
        if first <= k < last:
            yield k, _shown(row, seconds.get(k, {}))


def _numbers(path: Path) -> Iterator[tuple[int, dict[str, float]]]:
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            iteration = int(row.pop("iteration"))
            yield iteration, {name: float(value) for name, value in row.items() if value}


def _shown(row: Mapping[str, float], seconds: Mapping[str, float]) -> dict[str, float]:
    both = {**row, **{f"seconds/{name}": value for name, value in seconds.items()}}
    return {name: float(value) for name, value in both.items() if math.isfinite(value)}
