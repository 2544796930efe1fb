"""A CUDA graph as one node of the graph that is being captured: it takes no launch of its kernels once more.

A graph cannot be launched on a stream that is being captured, and Warp's own function ends the capture for a moment, after which
PyTorch no longer takes it for its own. Hence the functions of the driver.
"""

import ctypes
import functools
import sys

import warp as wp

_SET_DEPENDENCIES = 1
"""CU_STREAM_SET_CAPTURE_DEPENDENCIES: what comes next follows the new node alone."""


def add_child(graph: wp.Graph, stream: wp.Stream) -> None:
    """Add a copy of ``graph`` to the graph that is being captured on a stream; the kernels that it calls must outlive that one.

    Raises:
        RuntimeError: The driver refuses: nothing is being captured, or the launch before waits for another one as only programmatic
            dependent launches do.
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
            f"a graph of substeps cannot become part of the graph that is being captured: the CUDA driver answers with error {code}."
        )
