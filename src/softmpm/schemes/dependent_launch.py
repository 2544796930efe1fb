"""Programmatic dependencies in captured graphs: a kernel that waits for the previous one by itself begins while that one ends.

The functions of the driver are called, since Warp records every dependency as one on the end of a kernel. The kernels' side:
kernels/dependent.py.
"""

import ctypes
from collections.abc import Collection

import warp as wp

from softmpm.schemes.driver import driver, succeed

LEAST_ARCH = 90
_PTX_VERSION = 5
"""CU_FUNC_ATTRIBUTE_PTX_VERSION: the architecture that a function was compiled for."""
_KERNEL = 0
"""CU_GRAPH_NODE_TYPE_KERNEL"""
_PLAIN = 0
"""CUgraphEdgeData of a dependency on the end of a node."""
_PROGRAMMATIC = 1 | 1 << 16
"""CUgraphEdgeData with from_port = CU_GRAPH_KERNEL_NODE_PORT_PROGRAMMATIC and type = CU_GRAPH_DEPENDENCY_TYPE_PROGRAMMATIC."""
_WHAT = "a captured graph cannot be given programmatic dependencies"
_Handle = ctypes.c_void_p


class _KernelParams(ctypes.Structure):
    """CUDA_KERNEL_NODE_PARAMS_v2"""

    _fields_ = [
        ("function", _Handle),
        ("grid", ctypes.c_uint * 3),
        ("block", ctypes.c_uint * 3),
        ("shared", ctypes.c_uint),
        ("arguments", _Handle),
        ("extra", _Handle),
        ("kernel", _Handle),
        ("context", _Handle),
    ]


def begin_early(graph: wp.Graph, waiting: Collection[int]) -> int:
    """Let kernels of a graph that was captured and not launched yet begin before the kernel before each of them has ended.

    Args:
        waiting: Functions (CUfunction) of the kernels whose code calls ``await_previous``.

    Returns:
        Number of dependencies that were changed: 0 where the call was compiled to nothing, or the driver has no such dependencies.

    Raises:
        RuntimeError: The driver reports an error.
    """
    if not waiting or not hasattr(driver(), "cuGraphGetEdges_v2"):  # as in drivers before CUDA 12.3
        return 0
    waiting = {function for function in waiting if _arch_of(function) >= LEAST_ARCH}
    one, count = driver(), ctypes.c_size_t()
    succeed(one.cuGraphGetEdges_v2(graph.graph, None, None, None, ctypes.byref(count)), _WHAT)
    before, after = (_Handle * count.value)(), (_Handle * count.value)()
    kinds = (ctypes.c_uint64 * count.value)()
    succeed(one.cuGraphGetEdges_v2(graph.graph, before, after, kinds, ctypes.byref(count)), _WHAT)
    found = [
        (a, b)
        for a, b, kind in zip(before, after, kinds, strict=True)
        if kind == _PLAIN and _function_of(b) in waiting and _function_of(a) is not None
    ]
    if found:
        ends = [(_Handle * len(found))(*nodes) for nodes in zip(*found, strict=True)]
        plain = (ctypes.c_uint64 * len(found))()
        early = (ctypes.c_uint64 * len(found))(*[_PROGRAMMATIC] * len(found))
        succeed(one.cuGraphRemoveDependencies_v2(graph.graph, *ends, plain, len(found)), _WHAT)
        succeed(one.cuGraphAddDependencies_v2(graph.graph, *ends, early, len(found)), _WHAT)
    return len(found)


def _arch_of(function: int) -> int:
    """Architecture that a function was compiled for, such as 90."""
    version = ctypes.c_int()
    succeed(driver().cuFuncGetAttribute(ctypes.byref(version), _PTX_VERSION, function), _WHAT)
    return version.value


def _function_of(node: int) -> int | None:
    """Function of a kernel node, None for a node of another kind."""
    kind, params = ctypes.c_int(), _KernelParams()
    succeed(driver().cuGraphNodeGetType(node, ctypes.byref(kind)), _WHAT)
    if kind.value != _KERNEL:
        return None
    succeed(driver().cuGraphKernelNodeGetParams_v2(node, ctypes.byref(params)), _WHAT)
    return params.function
