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
        RuntimeError: The driver refuses, for example because nothing is being captured.
    """
    driver, handle = _driver(), ctypes.c_void_p(stream.cuda_stream)
    status, capture = ctypes.c_int(), ctypes.c_uint64()
    parent, before, count, node = (ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_size_t(), ctypes.c_void_p())
    found = (status, capture, parent, before, count)
    _check(driver.cuStreamGetCaptureInfo_v2(handle, *map(ctypes.byref, found)))
    _check(driver.cuGraphAddChildGraphNode(ctypes.byref(node), parent, before, count, graph.graph))
    one = ctypes.c_size_t(1)
    _check(
        driver.cuStreamUpdateCaptureDependencies(
            handle, ctypes.byref(node), one, ctypes.c_uint(_SET_DEPENDENCIES)
        )
    )


@functools.lru_cache(maxsize=None)
def _driver() -> ctypes.CDLL:
    return ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")


def _check(code: int) -> None:
    if code != 0:
        raise RuntimeError(f"CUDA error {code}: a graph of substeps could not become part of another graph.")
