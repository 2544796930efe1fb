"""Lists of launches on the CPU, run without Python in between by as many threads as PyTorch uses.

A launch is divided into parts of a fixed size, which do not depend on the number of threads; nor do results.
"""

import concurrent.futures
import ctypes
import functools
import math
import os
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp

from softmpm.kernels.compile import launch
from softmpm.kernels.parts import COUNT_BYTES, may_be_divided, runner

MOST_PARTS = 256
"""Parts of a launch at most: threads take them one by one from a counter that they share."""
PARTS_PER_THREAD = 2
"""Parts of the longest launch for each thread at least."""
PARTS_PER_START = 64
"""Parts of all launches for each further thread at least, so that its start pays; an estimate."""
INTERRUPTIBLE = 64
"""Launches after which Python may handle an interrupt."""


class _Row(ctypes.Structure):
    """A launch of a program, see kernels/parts.h."""

    _fields_ = [(name, ctypes.c_int64) for name in ("kernel", "arguments", "bounds", "bytes", "parts")]


class _RunArguments(ctypes.Structure):
    """Arguments of the kernel that runs a program, see kernels/parts.py."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("program", "counts", "stop", "give_way")),
        ("helper", ctypes.c_bool),
        ("first", ctypes.c_int32),
        ("last", ctypes.c_int32),
    ]


class Program:
    """Recorded launches in their order.

    Args:
        launches: ``wp.Launch`` each, with the threads of Warp in one part of it; None if it must not be divided.
    """

    def __init__(self, launches: Sequence[tuple[Any, int | None]]):
        self._launches = [made for made, _ in launches]  # with what they refer to
        self._arguments = [_arguments(made) for made in self._launches]
        self._bounds = [_parts(made.bounds, size) for made, size in launches]
        divided = {
            made.kernel for made, bounds in zip(self._launches, self._bounds, strict=True) if len(bounds) > 1
        }
        assert all(map(may_be_divided, divided)), "the modules of divided kernels need in_parts()"
        self._rows = (_Row * len(launches))(*map(_row, self._launches, self._arguments, self._bounds))
        self._counts = (ctypes.c_char * (COUNT_BYTES * len(launches)))()
        self._stop = ctypes.c_int32()
        addresses = [ctypes.addressof(one) for one in (self._rows, self._counts, self._stop)]
        self._whole = _RunArguments(*addresses, _giving_way(), True, 0, len(launches))
        self._some = _RunArguments(*addresses, _giving_way(), False, 0, 0)
        parts = [len(bounds) for bounds in self._bounds]
        self._helpers = min(max(parts) // PARTS_PER_THREAD, 1 + sum(parts) // PARTS_PER_START) - 1

    def run(self) -> None:
        """Run all launches; returns when they are done, and after an interrupt when no thread is at work any more."""
        ctypes.memset(self._counts, 0, ctypes.sizeof(self._counts))
        self._stop.value = 0
        helpers = []
        try:
            for _ in range(min(self._helpers, torch.get_num_threads() - 1)):
                helpers.append(_pool().submit(_take_part, self._whole))
            for first in range(0, len(self._launches), INTERRUPTIBLE):
                self._some.first, self._some.last = first, min(first + INTERRUPTIBLE, len(self._launches))
                _take_part(self._some)
        finally:
            self._stop.value = 1
            for helper in helpers:
                if not helper.cancel():
                    helper.result()


def _take_part(arguments: _RunArguments) -> None:
    made = _runner()
    made.hooks.forward(ctypes.byref(made.bounds), ctypes.byref(arguments))


@functools.lru_cache(maxsize=None)
def _runner() -> Any:
    """Recorded launch of the kernel that runs a program; its arguments are not used."""
    return launch(runner(), 1, (0, 0, 0, 0, True, 0, 0), device=wp.get_device("cpu"), record_cmd=True)


def _arguments(made: Any) -> ctypes.Structure:
    """Arguments of a recorded launch as its kernel reads them."""
    values = made.params[1:]
    return _structure(*map(type, values))(*values)


@functools.lru_cache(maxsize=None)
def _structure(*kinds: type) -> type[ctypes.Structure]:
    fields = [(f"field{k}", kind) for k, kind in enumerate(kinds)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


def _parts(bounds: Any, size: int | None) -> Any:
    """Bounds of the parts of a launch, see kernels/parts.h."""
    size = bounds.size if size is None else max(size, math.ceil(bounds.size / MOST_PARTS))
    return _divided(type(bounds), tuple(bounds.shape), size)


@functools.lru_cache(maxsize=1024)
def _divided(kind: Any, shape: tuple[int, ...], size: int) -> Any:
    total = math.prod(shape)
    found = (kind * math.ceil(total / size))(*(kind(shape) for _ in range(0, total, size)))
    for k, bounds in enumerate(found):
        bounds.size, bounds.coord_mult = min(size, total - k * size), 1 + k * size
    return found


def _row(made: Any, arguments: ctypes.Structure, bounds: Any) -> tuple[int, ...]:
    addresses = _address(made.hooks.forward), ctypes.addressof(arguments), ctypes.addressof(bounds)
    return *addresses, ctypes.sizeof(bounds[0]), len(bounds)


def _address(function: Any) -> int:
    """Address of a native function, which Warp keeps as long as the launch is referenced."""
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None
    return address


@functools.lru_cache(maxsize=None)
def _giving_way() -> int:
    """Address of the function that lets other threads of the machine run."""
    if os.name == "nt":
        return _address(ctypes.WinDLL("kernel32").SwitchToThread)
    return _address(ctypes.CDLL(None).sched_yield)


@functools.lru_cache(maxsize=None)
def _pool() -> concurrent.futures.ThreadPoolExecutor:
    """Threads of all programs, started when they are first needed."""
    return concurrent.futures.ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="softmpm")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child process has none of the threads
