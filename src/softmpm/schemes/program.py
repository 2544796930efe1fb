"""Lists of launches on the CPU, run without Python in between by several threads.

A launch is divided into parts of a fixed size, which do not depend on the number of threads; nor do results.
"""

import concurrent.futures
import ctypes
import functools
import math
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import warp as wp

from softmpm.kernels.compile import launch
from softmpm.kernels.parts import COUNT_BYTES, SECTIONS, may_be_divided, runner

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

    _fields_ = [
        (name, ctypes.c_int64) for name in ("kernel", "arguments", "bounds", "bytes", "parts", "joint")
    ]


class _RunArguments(ctypes.Structure):
    """Arguments of the kernel that runs a program, see kernels/parts.py."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("program", "counts", "stop", "give_way")),
        ("helper", ctypes.c_bool),
        ("section", ctypes.c_int32),
        ("first", ctypes.c_int32),
        ("last", ctypes.c_int32),
    ]


class Divided(NamedTuple):
    """A recorded launch, and how threads share it."""

    launch: Any
    """``wp.Launch``"""
    part: int | None = None
    """Threads of Warp in one part; None if it must not be divided."""
    beside: bool = False
    """True if it may begin before the launch before it is done."""


class Program:
    """Recorded launches in their order."""

    def __init__(self, launches: Sequence[Divided]):
        self._launches = [one.launch for one in launches]  # with what they refer to
        self._arguments = [_arguments(made) for made in self._launches]
        self._bounds = [_parts(one.launch.bounds, one.part) for one in launches]
        divided = {
            made.kernel for made, bounds in zip(self._launches, self._bounds, strict=True) if len(bounds) > 1
        }
        assert all(map(may_be_divided, divided)), "the modules of divided kernels need in_parts()"
        joint = [*(one.beside for one in launches[1:]), False]
        self._rows = (_Row * len(launches))(*map(_row, self._launches, self._arguments, self._bounds, joint))
        self._counts = (ctypes.c_char * (COUNT_BYTES * (len(launches) + 1)))()
        self._stop = ctypes.c_int32()
        aligned = -(-ctypes.addressof(self._counts) // COUNT_BYTES) * COUNT_BYTES
        addresses = [ctypes.addressof(self._rows), aligned, ctypes.addressof(self._stop)]
        self._of_helper = [
            _RunArguments(*addresses, _giving_way(), True, k, 0, len(launches)) for k in range(SECTIONS)
        ]
        self._of_caller = _RunArguments(*addresses, _giving_way(), False, 0, 0, 0)
        parts = [len(bounds) for bounds in self._bounds]
        self._helpers = min(max(parts) // PARTS_PER_THREAD, 1 + sum(parts) // PARTS_PER_START) - 1

    def run(self, threads: int | None) -> None:
        """Run all launches with at most so many threads, None for those of PyTorch. Returns when they are done, and after an interrupt
        when no thread is at work any more."""
        threads = torch.get_num_threads() if threads is None else threads
        ctypes.memset(self._counts, 0, ctypes.sizeof(self._counts))
        self._stop.value = 0
        helpers = []
        try:
            threads = min(1 + self._helpers, threads)
            for k in range(1, threads):
                helpers.append(_pool().submit(_take_part, self._of_helper[k * SECTIONS // threads]))
            for first in range(0, len(self._launches), INTERRUPTIBLE):
                some = self._of_caller
                some.first, some.last = first, min(first + INTERRUPTIBLE, len(self._launches))
                _take_part(some)
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
    return launch(runner(), 1, (0, 0, 0, 0, True, 0, 0, 0), device=wp.get_device("cpu"), record_cmd=True)


def _arguments(made: Any) -> ctypes.Structure:
    """Arguments of a recorded launch as its kernel reads them."""
    values = made.params[1:]
    return _structure(*map(type, values))(*values)


@functools.lru_cache(maxsize=None)
def _structure(*kinds: type) -> type[ctypes.Structure]:
    fields = [(f"field{k}", kind) for k, kind in enumerate(kinds)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


def _parts(bounds: Any, size: int | None) -> Any:
    """Bounds of the parts of a launch, of ``size`` threads each or a multiple of it, see kernels/parts.h."""
    size = bounds.size if size is None else size * math.ceil(bounds.size / (size * MOST_PARTS))
    return _divided(type(bounds), tuple(bounds.shape), size)


@functools.lru_cache(maxsize=1024)
def _divided(kind: Any, shape: tuple[int, ...], size: int) -> Any:
    total = math.prod(shape)
    found = (kind * math.ceil(total / size))(*(kind(shape) for _ in range(0, total, size)))
    for k, bounds in enumerate(found):
        bounds.size, bounds.coord_mult = min(size, total - k * size), 1 + k * size
    return found


def _row(made: Any, arguments: ctypes.Structure, bounds: Any, joint: bool) -> tuple[int, ...]:
    addresses = _address(made.hooks.forward), ctypes.addressof(arguments), ctypes.addressof(bounds)
    return *addresses, ctypes.sizeof(bounds[0]), len(bounds), joint


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
