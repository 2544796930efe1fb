"""Buffers, captured graphs and derived material that a model's calls leave for later calls. No part of the model's value."""

import threading
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")


class _Local(threading.local):
    def __init__(self):
        self.found = {}


class Workspace:
    """Objects by key, separately in each thread, since calls in other threads run on other streams."""

    def __init__(self):
        self.release()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The object of this thread, made when first asked for."""
        found: dict[Hashable, Any] = self._local.found
        if key not in found:
            found[key] = make()
        return found[key]

    def release(self) -> None:
        """Free everything that waits for later calls, in all threads."""
        self._local = _Local()
