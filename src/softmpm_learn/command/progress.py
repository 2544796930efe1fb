"""Progress report of a run: a bar with loss and remaining time on a terminal, a few log lines elsewhere."""

import logging
import math
import statistics
import sys
import time
from types import TracebackType

from tqdm import tqdm

from softmpm_learn.training.timing import duration

logger = logging.getLogger("softmpm_learn")

BAR = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
"""Form of the bar, in 80 columns with the losses of several runs, whose numbers a terminal would cut off."""


class ProgressBar:
    """Call it after each iteration; the first call tells where a resumed run began. Use as a context manager."""

    def __init__(self, total: int, *, lines: int = 20):
        """Count to ``total`` iterations; without a terminal, write about ``lines`` lines."""
        self.total, self.every = total, max(1, round(total / lines))
        self.lowest = float("inf")
        self._first: int | None = None
        self._began = math.nan
        look: dict = dict(dynamic_ncols=True, smoothing=0.1, bar_format=BAR)
        self._bar = tqdm(total=total, **look) if sys.stderr.isatty() else None

    def __call__(self, iteration: int, *losses: float) -> None:
        """Iteration number ``iteration``, counted from 0, has ended with these losses, one for each run side by side."""
        if self._first is None:
            self._first, self._began = iteration, time.monotonic()  # the first one also compiles
            if self._bar is not None:
                self._bar.initial = self._bar.n = self._bar.last_print_n = iteration + 1
                self._bar.unpause()
        self.lowest = min(self.lowest, *losses)
        done = iteration + 1
        if self._bar is not None:
            self._bar.set_postfix_str(self._text(losses, 5 if len(losses) == 1 else 3), refresh=False)
            self._bar.update(done - self._bar.n)
            self._bar.refresh()
        elif done % self.every == 0 or done == self.total or iteration == self._first:
            left = self._left(iteration - self._first, self.total - done)
            logger.info("after %d of %d iterations: %s%s", done, self.total, self._text(losses, 5), left)

    def _text(self, losses: tuple[float, ...], digits: int) -> str:
        """Words for the losses: their median, of several their range, and the lowest so far."""
        low, middle, high, lowest = (
            f"{value:.{digits}g}"
            for value in (min(losses), statistics.median(losses), max(losses), self.lowest)
        )
        return f"loss {middle}{f' ({low} to {high})' if len(losses) > 1 else ''}, lowest {lowest}"

    def _left(self, timed: int, missing: int) -> str:
        """Words for the time that missing iterations take, from those that were timed: all but the first, which compiles."""
        return f", {duration((time.monotonic() - self._began) / timed * missing)} left" if timed else ""

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()
