"""Captured CUDA graphs as child nodes of a graph that is being captured, so that their kernels need not be launched again.

CUDA does not allow a graph launch on a capturing stream. Warp's function for child nodes interrupts the capture, whose identifier then
changes, and PyTorch's allocator no longer recognises it. Therefore the functions of the driver are called.
"""

import ctypes
import functools
import sys

import warp as wp

_SET_DEPENDENCIES = 1
"""CU_STREAM_SET_CAPTURE_DEPENDENCIES: the new node replaces the dependencies of the capturing stream."""


def add_child(graph: wp.Graph, stream: wp.Stream) -> None:
    """Add a copy of ``graph`` as a child node to the graph that is being captured on a stream. Its modules must outlive that graph.

    Raises:
        RuntimeError: The driver reports an error, for example because no capture is active, or because the last captured launch has a
            programmatic dependency.
    """
    driver, handle = _driver(), ctypes.c_void_p(stream.cuda_stream)
    status, capture, count = ctypes.c_int(), ctypes.c_uint64(), ctypes.c_size_t()
    parent, before, node = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
    found = map(ctypes.byref, (status, capture, parent, before, count))
    _check(driver.cuStreamGetCaptureInfo_v2(handle, *found))
    _check(driver.cuGraphAddChildGraphNode(ctypes.byref(node), parent, before, count, graph.graph))
    _check(driver.cuStreamUpdateCaptureDependencies(handle, ctypes.byref(node), 1, _SET_DEPENDENCIES))


@functools.lru_cache(maxsize=None)
def _driver() -> ctypes.CDLL:
    driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    handle, size = ctypes.c_void_p, ctypes.c_size_t
    driver.cuStreamGetCaptureInfo_v2.argtypes = [handle] * 6
    driver.cuGraphAddChildGraphNode.argtypes = [handle, handle, handle, size, handle]
    driver.cuStreamUpdateCaptureDependencies.argtypes = [handle, handle, size, ctypes.c_uint]
    return driver


def _check(code: int) -> None:
    if code != 0:
        raise RuntimeError(
            f"a graph of substeps cannot become part of the graph that is being captured: the CUDA driver reported error {code}."
        )
