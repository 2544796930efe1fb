"""Ctrl-C and SIGTERM: the process ends with a sentence on what was saved; while it trains, after the iteration it is in.

An exception raised by a signal is lost where Python cannot pass it on, in a finalizer or a callback. So a process that must end
does so in the handler itself; everything that a run writes survives that, as it survives a kill.
"""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Signals:
    """Handling of the signals that end this process, for the main thread of a program.

    Attributes:
        advice: What was saved and how to go on, said when a signal ends the process.
        quiet: Say nothing: another process does.
        wished: A signal came while it was only a wish.
    """

    def __init__(self):
        self.advice, self.quiet = "No iteration had begun, so nothing is lost.", False
        self.wished = False
        self._received: list[int] | None = None
        self._insist = True

    def install(self) -> None:
        """Take over both signals, until the process ends: one that comes while Python shuts down is answered too."""
        for number in SIGNALS:
            signal.signal(number, self._handle)

    @contextmanager
    def awaited(self, *, insist: bool = True) -> Iterator[Callable[[], bool]]:
        """Gives a function that says whether a signal came; meanwhile the first is only a wish, and the second ends the process.

        Args:
            insist: Whether the second ends it. Not under torchrun: it may pass one Ctrl-C on twice, and itself ends what lingers.
        """
        received = self._received = []
        self._insist = insist
        try:
            yield lambda: bool(received)
        finally:
            self._received = None

    def _handle(self, number: int, frame: object) -> None:
        if self._received is not None and not (self._received and self._insist):
            self._received.append(number)
            self.wished = True
            return
        if not self.quiet:
            os.write(2, f"softmpm_learn: interrupted. {self.advice}\n".encode())
        os._exit(128 + number)
