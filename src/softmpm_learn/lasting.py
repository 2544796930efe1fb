"""Lasting: a motion that goes on after the episode in which it was learned, and does not tip over.

Of the evaluated motions of a run the best is one that lasts, if there is any: a fast start and a fall come farther than a steady walk.
"""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from softmpm_learn.objective import Progress, Tilt
from softmpm_learn.term import Path

SHARE = 0.7
"""A lasting motion keeps at least this share of its speed."""
LEVEL = 30.0
"""Its tilt stays below this [degrees]."""
STARTS = 0.0, 0.05
"""Speeds along the first axis with which an evaluation starts, of which the worse result counts [m/s]: what lasts by luck in one
simulation may not in another that differs by rounding. They are simulated at once, and the others below in groups of as many, so the
number of each is a multiple of theirs."""
FURTHER = -0.05, 0.025
"""Further such starts of a motion that would be the best: the best of many motions is often one that was lucky."""
AGAIN = -0.0375, -0.0125, 0.0125, 0.0375
"""Those of the evaluation that tells whether the best repeats itself."""


@dataclass(frozen=True, kw_only=True)
class Lasting:
    """Judges a motion that is longer than an episode of T seconds: from T on it has at least :data:`SHARE` of its mean speed between
    T/2 and T, and all the time it tilts by less than :data:`LEVEL`."""

    progress: Progress
    """Whose way counts; its window does not."""
    tilt: Tilt
    """Its window does not count."""
    seconds: float
    """Length of an episode, T [s]."""

    @cached_property
    def _level(self) -> Tilt:
        return dataclasses.replace(self.tilt, begin=0.0, end=math.inf)

    @cached_property
    def _before(self) -> Progress:
        return dataclasses.replace(self.progress, begin=self.seconds / 2, end=self.seconds)

    @cached_property
    def _after(self) -> Progress:
        return dataclasses.replace(self.progress, begin=self.seconds, end=math.inf)

    def __call__(self, path: Path) -> Tensor:
        """True where a motion lasts, shape (world,)."""
        before, after = self._before.speed(path), self._after.speed(path)
        level = self._level.angle(path).amax(dim=0) < math.radians(LEVEL)
        return (before > 0) & (after >= SHARE * before) & level
