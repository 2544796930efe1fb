"""Threads that work for runs side by side while others wait for the disk."""

from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor

THREADS = 4
"""Enough to hide the waiting. Checkpoints are mostly Python, one thread at a time: with 40 threads on two cores they took twice as long
as with one."""


def at_once(work: Callable[[int], object], numbers: Collection[int]) -> None:
    """Do the same for several runs.

    Raises the first error once all have ended.
    """
    if len(numbers) < 2:
        for k in numbers:
            work(k)
        return
    with ThreadPoolExecutor(min(THREADS, len(numbers))) as pool:
        list(pool.map(work, numbers))
