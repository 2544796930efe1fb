"""Programmatic dependent launch: kernels that a GPU begins before the previous kernel has ended (sm_90 and later).

A kernel that calls :func:`await_previous` may have a programmatic dependency in a captured graph (schemes/dependent_launch.py): it
begins when each block of the previous kernel has made its call. The call returns when the previous kernel has ended and everything that
it wrote is visible. Elsewhere it does nothing.

Before the call a kernel may read what the previous one does not write: all kernels before that one have ended, since it has waited for
them. What one of these wrote in the same graph is loaded by :func:`recent`, past the nearest cache, which might hold an older copy. A
kernel must not write before the call, and nowhere may it load what changes as read-only memory (``ld.global.nc``): that is left to
kernels without the call, which begin when the previous one has ended.
tests/softmpm/kernels/test_dependent.py checks this in PTX, with a list of what is read early.
"""

import warp as wp

AWAIT = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.wait;" ::: "memory");
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
"""
RECENT = """
    {type} value;
#if defined(__CUDA_ARCH__)
    const int* from = reinterpret_cast<const int*>(&wp::index(values, {index}));
    for (unsigned n = 0; n < sizeof(value) / sizeof(int); ++n)
        reinterpret_cast<int*>(&value)[n] = __ldcg(from + n);
#else
    value = wp::index(values, {index});
#endif
    return value;
"""


@wp.func_native(AWAIT)
def await_previous():
    """Wait until the previous kernel has ended, then let the next one begin. All threads call it, those that are idle too: a block that
    ends without it may end before the previous kernel, and the next one would begin too soon."""


@wp.func
def await_nothing():
    """In place of :func:`await_previous`, for a variant of a kernel that begins when the previous one has ended."""


def awaits_previous(kernel: wp.Kernel) -> bool:
    """True for a kernel that calls :func:`await_previous`, by this name or as the ``wait`` of its factory."""
    code, closure = kernel.func.__code__, kernel.func.__closure__
    if "wait" in code.co_freevars:
        return closure[code.co_freevars.index("wait")].cell_contents is await_previous
    return await_previous.__name__ in code.co_names


def recent(c_type: str, index: str) -> str:
    """Code of a native function of an array ``values`` and indices, ``index``, that loads a number or vector of this type from the
    cache that all multiprocessors share."""
    return RECENT.format(type=c_type, index=index)
