"""Runs the chunks of one call by the model's scheme, accepts or repeats them, and locates failures."""

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from softmpm.alarms import Failures
from softmpm.errors import FROZEN, NEVER, UnstableError, at, decode, place
from softmpm.inputs import present
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.alarm_check import armed
from softmpm.schemes.capture import defer_status_check, is_capturing
from softmpm.schemes.failure_report import Report, failed_worlds, failure
from softmpm.schemes.inputs import Values, in_rows, stiffest
from softmpm.schemes.registry import SCHEMES
from softmpm.schemes.scheme import Run, Scheme
from softmpm.state import chosen


class Runner:
    """Runs the chunks of one call, or of one backward pass, and handles the failures of its worlds.

    Args:
        values: Inputs that the call sets; those with rows have one row for each control step.
        failures: Collects the failures of worlds, which are then frozen; None raises the first one.

    Attributes:
        frozen: First inactive substep of each world that failed.
        failed: Worlds that failed so far in a captured call that collects failures, on the device, shape (world,); in its backward pass
            all that did.
    """

    def __init__(self, model: Model, values: Values, failures: Failures | None = None):
        self.model, self.failures = model, failures
        # A captured graph keeps what it needs to name a failure; with it would live the history of these tensors. The others stay the
        # same objects, by which a scheme knows a material that it has sorted already.
        self.values: Values = {
            name: tensor.detach() if tensor.requires_grad else tensor for name, tensor in values.items()
        }
        self.frozen: dict[int, int] = {}
        self.failed: Tensor | None = None
        self._end: Any = None
        self.scheme: Scheme = SCHEMES[model.scheme].of(model)

    def run(self, chunk: Chunk, start: Any, keep: bool) -> Run:
        """Launch a chunk from a :class:`State` or from the final state of a run."""
        frozen = self.failed
        if self.frozen:
            rest = (chunk.first >= self.frozen.get(world, math.inf) for world in range(self.model.worlds))
            frozen = torch.tensor(list(rest), device=self.model.device)
        return self.scheme.run(chunk, start, in_rows(self.values, chunk.rows), keep, frozen)

    def check(self, start: Any) -> Report | None:
        """Launch the check of the call's initial state; :meth:`passed` evaluates the report. None if there is nothing to check."""
        alarms = self.model.alarms
        if not armed(self.model) and alarms.collapse is None and alarms.depth is None:
            return None
        words = self.scheme.check_start(start, self.values)
        if is_capturing(self.model):
            self._defer(words.clone(), None, Chunk(0, 1, 1), self.values, before=True)
            return None
        return Report(words)

    def passed(self, start: Any, report: Report | None) -> bool:
        """True if all worlds passed the check of the initial state, False if some were frozen instead."""
        words = [] if report is None else report.read()
        for world in failed_worlds(words):
            self._take(
                failure(
                    self.model,
                    words,
                    world,
                    self.scheme.particles(start),
                    values=stiffest(self.model, self.values),
                    before=True,
                ),
                0,
            )
        return not failed_worlds(words)

    def settled(self, run: Run, report: Report) -> bool:
        """Accept a run; False if the chunk must be repeated, with a larger window or without a world that failed.

        Raises:
            UnstableError: A world failed, and failures are not collected.
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
        """Worlds that failed and are not frozen yet: an initial state off the grid is reported by every chunk."""
        return [world for world in failed_worlds(words) if world not in self.frozen]

    def _take(self, error: UnstableError, first: int) -> None:
        """Raise the failure, or collect it and freeze its world from substep ``first`` on."""
        if self.failures is None:
            try:
                raise error
            finally:
                # The error would refer to itself through this frame, and keep the objects of the frame alive.
                del error
        self.failures.errors.append(error)
        self.frozen[error.world] = first

    def _located(self, run: Run, words: list[int]) -> UnstableError:
        """The first failure of a chunk, found by running it substep by substep with all alarms checked after each."""
        state: Any = run.start
        shown = self.scheme.particles
        at_end, start = shown(run.end), shown(run.start) if run.chunk.first == 0 else None
        found = functools.partial(failure, self.model, start=start, state=at_end)
        for s in range(run.chunk.length):
            one = Chunk(run.chunk.first + s, 1, run.chunk.substeps)
            single, reported = self._single(one, state)
            if self._failed(reported):
                world = min(self._failed(reported), key=lambda w: reported[w])
                values = in_rows(self.values, one.rows)
                time = (one.first % one.substeps + 1) * self.model.scene.dt
                end = shown(single.end)
                return found(reported, world, end, first=one.first, values=values, time=time)
            state = single.end
        # Sums in another order may have avoided the failure; the report remains true.
        world = min(self._failed(words), key=lambda w: words[w])
        return found(words, world, at_end, first=run.chunk.first, values=stiffest(self.model, self.values))

    def _single(self, chunk: Chunk, state: Any) -> tuple[Run, list[int]]:
        """A run of one substep, repeated until the scheme accepts it, and its status words."""
        while True:
            run = self.run(chunk, state, keep=False)
            words = run.words.tolist()
            if self.scheme.accept(run, words):
                return run, words[: self.model.worlds]

    def settle(self, chunk: Chunk, start: Any, keep: bool) -> Run:
        """Run a chunk, repeating it if necessary, and return the valid run."""
        while True:
            run = self.run(chunk, start, keep)
            if is_capturing(self.model):
                words = run.words[: self.model.worlds].clone()  # the backward pass overwrites them
                self._defer(words, run.outgrow, chunk, in_rows(self.values, chunk.rows))
                return run
            if self.settled(run, Report(run.words)):
                return run
            del run  # release its buffers before those with a larger window are allocated

    def _defer(
        self, words: Tensor, outgrow: Callable[[], None] | None, chunk: Chunk, values: Values, **about: Any
    ) -> None:
        """Check these words after each replay of the graph that is being captured; collect failures if the call does."""
        returned = self.failures is not None and self.failures.policy == "freeze"
        if self.failed is not None and not returned:  # such a world needs no window
            words = words.masked_fill(self.failed, NEVER)
        if self.failures is None:
            defer_status_check(words, outgrow)
            return
        failed = words < FROZEN
        self.failed = failed if self.failed is None else self.failed | failed
        poses = {
            one.name: values[one.name]
            for one in present(self.model.spec)
            if one.group == "wall" and one.name in values
        }
        about |= {"first": chunk.first, "values": stiffest(self.model, values)}
        defer_status_check(words, outgrow, functools.partial(self._collect, about, poses, chunk, place()))

    def _collect(
        self, about: dict[str, Any], poses: Values, chunk: Chunk, notes: str, words: list[int]
    ) -> None:
        """Collect the first failure of each world in the last replay.

        Args:
            about: Arguments of :func:`failure`.
            poses: Of the walls, and their rates, in the control steps of the chunk.
        """
        assert self.failures is not None
        new = [world for world in failed_worlds(words) if world not in self.failures.worlds]
        if not new:
            return
        end = self.scheme.particles(self._end)
        with at(notes):
            for world in new:
                s = decode(words[world])[0]
                row, done = chunk.row(s), 0 if about.get("before") else (chunk.first + s) % chunk.substeps + 1
                values, time = (
                    about["values"] | in_rows(poses, slice(row, row + 1)),
                    done * self.model.scene.dt,
                )
                self.failures.errors.append(
                    failure(self.model, words, world, end, **about | {"values": values}, time=time)
                )

    def captured(self, end: Any) -> Any:
        """The final state of a captured call that collects failures, as :class:`Failures` has it."""
        if self.failures is None:
            return end
        self._end = end.detach()
        if self.failures.policy == "freeze" or self.failed is None:
            return end
        return chosen(self.failed, self.scheme.rest(), end)
