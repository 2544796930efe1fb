"""Partition of a call into chunks of substeps; a chunk is launched, and differentiated, as a whole."""

import functools
import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Chunk:
    """Consecutive substeps of a call. Two chunks with the same ``shape`` differ only in what they are given."""

    first: int
    """Its first substep in the call."""
    length: int
    substeps: int
    """Substeps of a control step."""

    @functools.cached_property
    def shape(self) -> tuple[int, tuple[int, ...]]:
        """Its length, and where in it control steps begin."""
        begins = range(-self.first % self.substeps, self.length, self.substeps)
        return self.length, tuple(s for s in begins if s > 0)

    @functools.cached_property
    def rows(self) -> slice:
        """Control steps that it touches."""
        first = self.first // self.substeps
        return slice(first, first + self.row(self.length - 1) + 1)

    def row(self, s: int) -> int:
        """Number, among these, of the control step that substep ``s`` belongs to."""
        return (self.first % self.substeps + s) // self.substeps


@dataclass(frozen=True)
class Horizon:
    """Control steps of equally many substeps."""

    control_steps: int
    substeps: int

    @property
    def total(self) -> int:
        return self.control_steps * self.substeps

    @functools.lru_cache(maxsize=256)  # noqa: B019 - keeps numbers, not what is simulated
    def chunks(self, longest: int) -> tuple[Chunk, ...]:
        """Whole control steps as far as they fit, or equal parts of one: few shapes, so that few chunk graphs are captured."""
        if self.substeps <= longest:
            length = self.substeps * (longest // self.substeps)
            starts = range(0, self.total, length)
            return tuple(Chunk(first, min(length, self.total - first), self.substeps) for first in starts)
        length = math.ceil(self.substeps / math.ceil(self.substeps / longest))
        return tuple(
            Chunk(step * self.substeps + first, min(length, self.substeps - first), self.substeps)
            for step in range(self.control_steps)
            for first in range(0, self.substeps, length)
        )
