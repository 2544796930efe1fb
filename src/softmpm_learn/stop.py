"""Ctrl-C and SIGTERM as a wish: the run ends after the iteration it is in, with everything saved. For applications."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def stop_on_signals(*, insist: bool = True) -> Iterator[Callable[[], bool]]:
    """Gives a function that says whether to stop. A second Ctrl-C ends at once; resuming loses one iteration at most.

    Signal handlers belong to the process: use this in a program's main thread, not in a library.

    Args:
        insist: Whether the second ends at once. Not under torchrun: it may pass one Ctrl-C on twice, and itself ends what lingers.
    """
    received = []

    def handle(number, frame):
        if received and insist:
            raise KeyboardInterrupt
        received.append(number)

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
