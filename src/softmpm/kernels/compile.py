"""Thread-safe kernel definition and loading: Warp's module registry is not thread-safe (undocumented), so one lock serialises both.

Modules are compiled one after another. In a trial with a thread for each (Warp 1.19) the modules of a chunk and of its adjoint took
1.5 and 0.8 s instead of 1.3 and 0.9 s for an H100, and 3.1 and 2.1 s instead of 2.1 and 2.4 s for a CPU of two cores.

Modules of :func:`in_order` have Warp's deterministic mode: on a GPU ``wp.atomic_add`` writes a record (node, thread, term) instead of
adding, and after the kernel Warp sorts the records and adds up those of each node in the order of the threads, as the CPU does.
"""

import functools
import threading
from collections.abc import Callable, Sequence
from typing import TypeVar

import warp as wp

T = TypeVar("T")

_lock = threading.RLock()
_loaded: set[tuple] = set()
_in_order: set[str] = set()


def kernel_factory(define: Callable[..., T]) -> Callable[..., T]:
    """Thread-safe ``functools.cache`` for functions that define kernels."""
    cached = functools.lru_cache(maxsize=None)(define)

    @functools.wraps(define)
    def found(*args) -> T:
        with _lock:
            return cached(*args)

    return found


def in_order(module: str, records: int) -> str:
    """Name of a module of its own, beside ``module``, for kernels whose sums of floating-point numbers are taken in a fixed order.

    Args:
        records: Terms that one thread adds to an array, at most; Warp counts them only where it unrolls the loop.
    """
    name = f"{module}.in_order"
    options = {"deterministic": wp.DeterministicMode.GPU_TO_GPU, "deterministic_max_records": records}
    wp.set_module_options(options, module=wp.get_module(name))
    _in_order.add(name)
    return name


def runs_in_order(kernel: wp.Kernel) -> bool:
    """True for a kernel of a module of :func:`in_order`."""
    return kernel.module.name in _in_order


def launch(kernel, dim, inputs: Sequence, device: wp.Device, **settings):
    """``wp.launch``, never recorded on a tape. The first launch of a kernel on a device, which loads its module, holds the lock."""
    if device.is_cuda and runs_in_order(kernel):
        return _launch_in_order(kernel, dim, inputs, **settings)
    key = kernel, device.alias, settings.get("block_dim")
    if key in _loaded:
        return wp.launch(kernel, dim, inputs, device=device, record_tape=False, **settings)
    with _lock:
        launched = wp.launch(kernel, dim, inputs, device=device, record_tape=False, **settings)
        _loaded.add(key)
        return launched


def clusters_are_launchable(kernel: wp.Kernel, device: wp.Device, block_dim: int) -> bool:
    """True if the device has clusters of as many blocks as the kernel asks for."""
    if not device.is_cuda or device.arch < 90:
        return False
    with _lock:
        return wp.get_cuda_max_cluster_dim(kernel, device, block_dim=block_dim) > 1


def _launch_in_order(kernel, dim, inputs: Sequence, stream: wp.Stream, **settings):
    """Launch a kernel of a module of :func:`in_order`.

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
