"""How a run tells where it is: a bar with loss and time left on a terminal, a few lines anywhere else."""

import logging
import sys
import time
from types import TracebackType

from tqdm import tqdm

logger = logging.getLogger("softmpm_learn")


class Progress:
    """Call it after each iteration. Use as a context manager."""

    def __init__(self, total: int, *, first: int = 0, lines: int = 20):
        """Count to ``total``, ``first`` of them done before; without a terminal, write ``lines`` lines."""
        self.total, self.first, self.every = total, first, max(1, round(total / lines))
        self.best = float("inf")
        self._began = time.monotonic()
        self._bar = None
        if sys.stderr.isatty():
            self._bar = tqdm(total=total, initial=first, unit="it", dynamic_ncols=True, smoothing=0.1)

    def __call__(self, iteration: int, loss: float) -> None:
        """Iteration number ``iteration``, counted from 0, has ended with this loss."""
        self.best = min(self.best, loss)
        done = iteration + 1
        text = f"loss {loss:.5g}, best {self.best:.5g}"
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.update(done - self._bar.n)
        elif done % self.every == 0 or done == self.total or done == self.first + 1:
            logger.info("iteration %d of %d: %s, %s left", done, self.total, text, self._left(done))

    def _left(self, done: int) -> str:
        seconds = (time.monotonic() - self._began) / max(1, done - self.first) * (self.total - done)
        return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.0f} s"

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()
