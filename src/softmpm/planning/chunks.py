"""Partition of a call into chunks of substeps; a chunk is launched, and differentiated, as a whole."""

import functools
import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Chunk:
    """Consecutive substeps of a call. Two chunks with the same ``shape`` differ only in their inputs."""

    first: int
    """Its first substep in the call."""
    length: int
    substeps: int
    """Substeps per control step."""

    @functools.cached_property
    def shape(self) -> tuple[int, tuple[int, ...]]:
        """Length of the chunk, and the substeps in it at which a control step begins."""
        begins = range(-self.first % self.substeps, self.length, self.substeps)
        return self.length, tuple(s for s in begins if s > 0)

    @property
    def begins(self) -> bool:
        """True if a control step begins with the chunk."""
        return self.first % self.substeps == 0

    def anew(self, s: int) -> int:
        """1 if a control step begins with substep ``s`` of the chunk, but not with the first one."""
        return int(s in self.shape[1])

    @functools.cached_property
    def rows(self) -> slice:
        """Control steps that the chunk touches."""
        first = self.first // self.substeps
        return slice(first, first + self.row_count)

    @property
    def row_count(self) -> int:
        """Number of these control steps."""
        return self.row(self.length - 1) + 1

    def row(self, s: int) -> int:
        """Index, within :attr:`rows`, of the control step that contains substep ``s`` of the chunk."""
        return (self.first % self.substeps + s) // self.substeps


@dataclass(frozen=True)
class Horizon:
    """Length of a call: control steps, each with the same number of substeps."""

    control_steps: int
    substeps: int

    @property
    def total(self) -> int:
        """Number of substeps."""
        return self.control_steps * self.substeps

    def _division(self, longest: int) -> tuple[int, int, int]:
        """Length of a chunk, number of substeps that are divided into such, and how often: the whole call, or each control step."""
        if self.substeps <= longest:
            return self.substeps * (longest // self.substeps), self.total, 1
        length = math.ceil(self.substeps / math.ceil(self.substeps / longest))
        return length, self.substeps, self.control_steps

    def counted(self, longest: int) -> tuple[int, list[int]]:
        """Number of the :meth:`chunks`, and the length of each of their shapes, without building them."""
        length, whole, times = self._division(longest)
        full, rest = divmod(whole, length)
        return times * (full + bool(rest)), [length] * bool(full) + [rest] * bool(rest)

    @functools.lru_cache(maxsize=256)  # noqa: B019 - caches numbers, not simulated states
    def chunks(self, longest: int) -> tuple[Chunk, ...]:
        """Chunks of at most ``longest`` substeps: several whole control steps, or equal parts of one.

        The chunks have few distinct shapes, so that few chunk graphs are captured.
        """
        length, whole, times = self._division(longest)
        return tuple(
            Chunk(part * whole + first, min(length, whole - first), self.substeps)
            for part in range(times)
            for first in range(0, whole, length)
        )
