"""Runs the chunks of one call by the model's scheme, accepts or repeats them, and locates failures."""

import functools
from typing import Any

from torch import Tensor

from softmpm.alarms import Failures
from softmpm.errors import UnstableError
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.alarm_check import armed
from softmpm.schemes.buffers import Solid
from softmpm.schemes.capture import defer_status_check, is_capturing
from softmpm.schemes.failure_report import Report, failed_worlds, failure
from softmpm.schemes.registry import SCHEMES
from softmpm.schemes.scheme import Run, Scheme
from softmpm.state import State


class Runner:
    """One for each call and backward pass.

    Args:
        pull: Activation times strength [Pa], shape (control_step, world, muscle), or None without muscles.
        failures: Takes the failures of worlds, which then stop; None raises them.

    Attributes:
        frozen: First inactive substep of each world that failed.
    """

    def __init__(self, model: Model, pull: Tensor | None, solid: Solid, failures: Failures | None = None):
        self.model, self.pull, self.solid, self.failures = model, pull, solid, failures
        self.frozen: dict[int, int] = {}
        self.scheme: Scheme = SCHEMES[model.scheme].of(model)

    def run(self, chunk: Chunk, start: Any, keep: bool) -> Run:
        """Run a chunk from a :class:`State` or what the scheme gave as an end."""
        pull = None if self.pull is None else self.pull[chunk.rows]
        frozen = [world for world, substep in self.frozen.items() if chunk.first >= substep]
        return self.scheme.run(chunk, start, pull, self.solid, keep, frozen)

    def check(self, start: State) -> Report | None:
        """Launch the check of the start of the call; see :meth:`passed`."""
        if not armed(self.model) and self.model.alarms.collapse is None:
            return None
        words = self.scheme.check_start(start, self.pull, self.solid)
        if is_capturing(self.model):
            defer_status_check(words.clone())
            return None
        return Report(words)

    def passed(self, start: State, report: Report | None) -> bool:
        """True if all worlds may start, False if some were frozen instead."""
        words = [] if report is None else report.read()
        for world in failed_worlds(words):
            self._take(
                failure(
                    self.model, words, world, start, solid=self.solid, pull=self._strongest(), before=True
                ),
                0,
            )
        return not failed_worlds(words)

    def _strongest(self) -> Tensor | None:
        return None if self.pull is None else self.pull.amax(0)

    def settled(self, run: Run, report: Report) -> bool:
        """Accept a run; False if the chunk must be repeated, with a larger window or without a world that failed.

        Raises:
            UnstableError: A world failed, and the failures are not taken.
        """
        words = report.read()
        if not self.scheme.accept(run, words):
            return False
        words = words[: self.model.worlds]
        if self._failed(words):
            self._take(self._located(run, words), run.chunk.first)
            return False
        return True

    def _failed(self, words: list[int]) -> list[int]:
        """Worlds that failed and were not frozen before: a start off the grid is reported each time."""
        return [world for world in failed_worlds(words) if world not in self.frozen]

    def _take(self, error: UnstableError, first: int) -> None:
        if self.failures is None:
            try:
                raise error
            finally:
                # It would refer to itself through this frame, and keep the objects of the frame alive.
                del error
        self.failures.errors.append(error)
        self.frozen[error.world] = first

    def _located(self, run: Run, words: list[int]) -> UnstableError:
        """The first failure of a chunk, found by running it substep by substep with all alarms checked after each."""
        state: Any = run.start
        at_end, start = self.scheme.to_user(run.end), run.start if run.chunk.first == 0 else None
        found = functools.partial(failure, self.model, solid=self.solid, start=start, state=at_end)
        for s in range(run.chunk.length):
            one = Chunk(run.chunk.first + s, 1, run.chunk.substeps)
            single, reported = self._single(one, state)
            if self._failed(reported):
                world = min(self._failed(reported), key=lambda w: reported[w])
                pull = None if self.pull is None else self.pull[one.rows][0]
                return found(reported, world, self.scheme.to_user(single.end), first=one.first, pull=pull)
            state = single.end
        # Sums in another order may have avoided the failure; the report remains true.
        world = min(self._failed(words), key=lambda w: words[w])
        return found(words, world, at_end, first=run.chunk.first, pull=self._strongest())

    def _single(self, chunk: Chunk, state: Any) -> tuple[Run, list[int]]:
        """A run of one substep, and what it reported."""
        while True:
            run = self.run(chunk, state, keep=False)
            words = run.words.tolist()
            if self.scheme.accept(run, words):
                return run, words[: self.model.worlds]

    def settle(self, chunk: Chunk, start: Any, keep: bool) -> Run:
        """Run a chunk, and wait until it can be used."""
        while True:
            run = self.run(chunk, start, keep)
            if is_capturing(self.model):
                words = run.words[: self.model.worlds].clone()  # the backward pass overwrites them
                defer_status_check(words, run.outgrow)
                return run
            if self.settled(run, Report(run.words)):
                return run
            del run  # release its buffers before those with a larger window are allocated
