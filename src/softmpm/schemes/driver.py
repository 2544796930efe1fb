"""The CUDA driver, for functions on graphs that neither Warp nor PyTorch offers."""

import ctypes
import functools
import sys

_HANDLE, _SIZE = ctypes.c_void_p, ctypes.c_size_t
_ARGUMENTS = {
    "cuStreamGetCaptureInfo_v2": [_HANDLE] * 6,
    "cuStreamUpdateCaptureDependencies": [_HANDLE, _HANDLE, _SIZE, ctypes.c_uint],
    "cuGraphAddChildGraphNode": [_HANDLE, _HANDLE, _HANDLE, _SIZE, _HANDLE],
    "cuGraphGetEdges_v2": [_HANDLE] * 5,
    "cuGraphRemoveDependencies_v2": [_HANDLE] * 4 + [_SIZE],
    "cuGraphAddDependencies_v2": [_HANDLE] * 4 + [_SIZE],
    "cuGraphNodeGetType": [_HANDLE] * 2,
    "cuGraphKernelNodeGetParams_v2": [_HANDLE] * 2,
    "cuFuncGetAttribute": [_HANDLE, ctypes.c_int, _HANDLE],
}


@functools.cache
def driver() -> ctypes.CDLL:
    """The driver's library; a function that an older one lacks is no attribute of it."""
    library = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    for name, types in _ARGUMENTS.items():
        if hasattr(library, name):
            getattr(library, name).argtypes = types
    return library


def succeed(code: int, failure: str) -> None:
    """Raise RuntimeError with this sentence if a function of the driver gave an error code."""
    if code != 0:
        raise RuntimeError(f"{failure}: the CUDA driver reported error {code}.")
