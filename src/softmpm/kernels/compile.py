"""Threads take turns: Warp lets kernels be defined and loaded in one thread at a time only, and does not say so."""

import functools
import threading
from collections.abc import Callable, Sequence
from typing import TypeVar

import warp as wp

T = TypeVar("T")

_turn = threading.RLock()
_loaded: set[tuple] = set()


def once(define: Callable[..., T]) -> Callable[..., T]:
    """What it gives is made once for each set of arguments, and by one thread at a time."""
    cached = functools.lru_cache(maxsize=None)(define)

    @functools.wraps(define)
    def found(*args) -> T:
        with _turn:
            return cached(*args)

    return found


def launch(kernel, dim, inputs: Sequence, device: wp.Device, **settings):
    """``wp.launch``, never on a tape; the first of a kernel on a device, which loads it, while no other thread defines or loads."""
    key = kernel, device.alias, settings.get("block_dim")
    if key in _loaded:
        return wp.launch(kernel, dim, inputs, device=device, record_tape=False, **settings)
    with _turn:
        launched = wp.launch(kernel, dim, inputs, device=device, record_tape=False, **settings)
        _loaded.add(key)
        return launched
