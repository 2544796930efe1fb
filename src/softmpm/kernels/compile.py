"""Thread-safe kernel definition and loading: Warp's module registry is not thread-safe (undocumented), so one lock serialises both."""

import functools
import threading
from collections.abc import Callable, Sequence
from typing import TypeVar

import warp as wp

T = TypeVar("T")

_lock = threading.RLock()
_loaded: set[tuple] = set()


def kernel_factory(define: Callable[..., T]) -> Callable[..., T]:
    """Thread-safe ``functools.cache`` for functions that define kernels."""
    cached = functools.lru_cache(maxsize=None)(define)

    @functools.wraps(define)
    def found(*args) -> T:
        with _lock:
            return cached(*args)

    return found


def launch(kernel, dim, inputs: Sequence, device: wp.Device, **settings):
    """``wp.launch``, never recorded on a tape. The first launch of a kernel on a device, which loads its module, holds the lock."""
    key = kernel, device.alias, settings.get("block_dim")
    if key in _loaded:
        return wp.launch(kernel, dim, inputs, device=device, record_tape=False, **settings)
    with _lock:
        launched = wp.launch(kernel, dim, inputs, device=device, record_tape=False, **settings)
        _loaded.add(key)
        return launched
