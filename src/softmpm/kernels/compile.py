"""Thread-safe kernel definition and loading: Warp's registry of kernels is not thread-safe (undocumented), so one lock serialises both.
While it is held, a few threads may load modules at the same time, as Warp's own ``force_load`` does.

Each kernel has a module of its own (:func:`kernel`), which Warp compiles once for each number of threads in a block; kernels of two
scenes with the same code share one. A module takes 0.1 s to compile in addition to its code.

Kernels of :func:`kernel_in_order` have Warp's deterministic mode: on a GPU ``wp.atomic_add`` writes a record (node, thread, term)
instead of adding, and after the kernel Warp sorts the records and adds up those of each node in the order of the threads, as the CPU
does.
"""

import functools
import os
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

import warp as wp

T = TypeVar("T")
Compiled = tuple[wp.Kernel, str, int]
"""A kernel, the alias of a device, and the threads of a block."""

THREADS = 256
"""Threads of a block, where a launch does not say otherwise."""
AT_ONCE = 4
"""Modules that are compiled at the same time, at most; 8 and 16 took no less time on 16 cores (H200, Warp 1.19)."""

_lock = threading.RLock()
_launched: set[Compiled] = set()
_compiled: set[Compiled] = set()
_in_order: set[wp.Kernel] = set()


def kernel_factory(define: Callable[..., T]) -> Callable[..., T]:
    """Thread-safe ``functools.cache`` for functions that define kernels."""
    cached = functools.lru_cache(maxsize=None)(define)

    @functools.wraps(define)
    def found(*args) -> T:
        with _lock:
            return cached(*args)

    return found


def kernel(options: Mapping[str, Any] | None = None, **settings) -> Callable[[Callable], wp.Kernel]:
    """Decorator of a kernel without a generated adjoint, in a module of its own.

    Kernels with the same code and options are one kernel. Warp compares the numbers of their closures in single precision, or as 32-bit
    integers. It computes a hash of the code for each number of threads in a block, the first one for that in the options, which is
    1 where there is no GPU, as on a CPU in any case.

    Args:
        options: Compile options, as in ``wp.set_module_options``.
        settings: Further arguments of ``wp.kernel``.
    """
    threads = {} if wp.is_cuda_available() else {"block_dim": 1}
    options = {**threads, **(options or {})}
    return wp.kernel(module="unique", module_options=options, enable_backward=False, **settings)


def kernel_in_order(records: int) -> Callable[[Callable], wp.Kernel]:
    """As :func:`kernel`, for one whose sums of floating-point numbers are taken in a fixed order.

    Args:
        records: Terms that one thread adds to an array, at most; Warp counts them only where it unrolls the loop.
    """
    options = {"deterministic": wp.DeterministicMode.GPU_TO_GPU, "deterministic_max_records": records}

    def define(function: Callable) -> wp.Kernel:
        made = kernel(options)(function)
        _in_order.add(made)
        return made

    return define


def runs_in_order(kernel: wp.Kernel) -> bool:
    """True for a kernel of :func:`kernel_in_order`."""
    return kernel in _in_order


def launch(kernel, dim, inputs: Sequence, device: wp.Device, **settings):
    """``wp.launch``, never recorded on a tape. The first launch of a kernel on a device, which loads its module, holds the lock."""
    if device.is_cuda and runs_in_order(kernel):
        return _launch_in_order(kernel, dim, inputs, **settings)
    key = kernel, device.alias, settings.get("block_dim", THREADS)
    if key in _launched:
        return wp.launch(kernel, dim, inputs, device=device, record_tape=False, **settings)
    with _lock:
        _compile_at_once([key])
        launched = wp.launch(kernel, dim, inputs, device=device, record_tape=False, **settings)
        _launched.add(key)
        return launched


def compile_together(kernels: Iterable[tuple[wp.Kernel, int]], device: wp.Device) -> None:
    """Compile kernels that will be launched in blocks of so many threads, several at a time."""
    with _lock:
        _compile_at_once([(kernel, device.alias, threads) for kernel, threads in kernels])


def _compile_at_once(wanted: Sequence[Compiled]) -> None:
    """Compile what has not been compiled, in the threads for it. After a failure none of them is at work."""
    tasks = [_compiling(one) for one in wanted if one not in _compiled]
    try:
        for task in tasks:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        wait(tasks)


def _compiling(one: Compiled) -> Future:
    try:
        return _compilers().submit(_compile, one)
    except RuntimeError:  # the main thread has ended, and pools take no more work
        task = Future()
        _compile(one)
        task.set_result(None)
        return task


def _compile(one: Compiled) -> None:
    kernel, device, threads = one
    wp.force_load(device, [kernel.module], block_dim=threads, max_workers=0)
    _compiled.add(one)


@functools.cache
def _compilers() -> ThreadPoolExecutor:
    """Threads that compile. They remain, since each prepares Warp's headers first: 1.5 s on a CPU, less for a GPU."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return ThreadPoolExecutor(min(cores, AT_ONCE), "softmpm-compiler")


if hasattr(os, "register_at_fork"):  # a child has none of these threads
    os.register_at_fork(after_in_child=_compilers.cache_clear)


def clusters_are_launchable(kernel: wp.Kernel, device: wp.Device, block_dim: int) -> bool:
    """True if the device has clusters of as many blocks as the kernel asks for."""
    if not device.is_cuda or device.arch < 90:
        return False
    with _lock:
        return wp.get_cuda_max_cluster_dim(kernel, device, block_dim=block_dim) > 1


def _launch_in_order(kernel, dim, inputs: Sequence, stream: wp.Stream, **settings):
    """Launch a kernel of :func:`kernel_in_order`.

    Warp allocates and sorts the records on its current stream of the device, which all threads share: it is made that of the launch,
    and the lock keeps other threads away from it. Warp also reads the number of records back, which no capture allows.

    Raises:
        RuntimeError: A CUDA graph is being captured.
        ValueError: An array has 2³¹ bytes or more: Warp counts them in 32 bits, and leaves out what lies beyond.
    """
    if stream.is_capturing:
        raise RuntimeError(
            "with deterministic=True the plain scheme, softmpm.step and double precision wait for the device and cannot be captured "
            "in a CUDA graph; call them outside of it, or use softmpm.simulate with dtype=torch.float32 and scheme='fast'."
        )
    largest = max(one.capacity for one in inputs if isinstance(one, wp.array))
    if largest >= 2**31:
        raise ValueError(
            "with deterministic=True the plain scheme, softmpm.step and double precision reach less than 2,147,483,648 bytes of nodes, "
            f"but those of all worlds take {largest:,}: take fewer worlds or fewer nodes."
        )
    with _lock, wp.ScopedStream(stream, sync_enter=False):
        return wp.launch(
            kernel, dim, inputs, device=stream.device, stream=stream, record_tape=False, **settings
        )
