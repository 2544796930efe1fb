"""Nodes or surface points of one thread: one on a GPU, a portion of them on the CPU.

On the CPU a thread would load all arguments of its kernel once more for each node, which took longer than the work on the node.
"""

import warp as wp

PORTION = 64

ON_A_GPU = """
#if defined(__CUDA_ARCH__)
    return {gpu};
#else
    return {cpu};
#endif
"""


@wp.func_native(ON_A_GPU.format(gpu="k", cpu=f"{PORTION} * k"))
def first_of(k: int) -> int:
    """Number of the first node of thread ``k``."""


@wp.func_native(
    ON_A_GPU.format(gpu="k + 1", cpu=f"{PORTION} * (k + 1) < count ? {PORTION} * (k + 1) : count")
)
def end_of(k: int, count: int) -> int:
    """Number after that of its last node, of ``count`` nodes in all."""
