"""Captured CUDA graphs as child nodes of a graph that is being captured, so that their kernels need not be launched again.

CUDA does not allow a graph launch on a capturing stream. Warp's function for child nodes interrupts the capture, whose identifier then
changes, and PyTorch's allocator no longer recognises it. Therefore the functions of the driver are called.
"""

import ctypes

import warp as wp

from softmpm.schemes.driver import driver, succeed

_SET_DEPENDENCIES = 1
"""CU_STREAM_SET_CAPTURE_DEPENDENCIES: the new node replaces the dependencies of the capturing stream."""
_WHAT = "a graph of substeps cannot become part of the graph that is being captured"


def add_child(graph: wp.Graph, stream: wp.Stream) -> None:
    """Add a copy of ``graph`` as a child node to the graph that is being captured on a stream. Its modules must outlive that graph.

    Raises:
        RuntimeError: The driver reports an error, for example because no capture is active, or because the last captured launch has a
            programmatic dependency.
    """
    one, handle = driver(), ctypes.c_void_p(stream.cuda_stream)
    status, capture, count = ctypes.c_int(), ctypes.c_uint64(), ctypes.c_size_t()
    parent, before, node = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
    found = map(ctypes.byref, (status, capture, parent, before, count))
    succeed(one.cuStreamGetCaptureInfo_v2(handle, *found), _WHAT)
    succeed(one.cuGraphAddChildGraphNode(ctypes.byref(node), parent, before, count, graph.graph), _WHAT)
    succeed(one.cuStreamUpdateCaptureDependencies(handle, ctypes.byref(node), 1, _SET_DEPENDENCIES), _WHAT)
