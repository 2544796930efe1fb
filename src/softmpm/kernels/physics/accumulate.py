"""Addition to a number that one thread alone adds to.

On a GPU the memory adds and the thread goes on; with ``a[i] = a[i] + x`` all later loads, which might be of the same number, would
wait for this one. ``wp.atomic_add`` would be taken for a sum of several threads by Warp's deterministic mode.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types

SNIPPET = """
    auto* sum = wp::address(sums, {index});
#if defined(__CUDA_ARCH__)
    atomicAdd(sum, value);
#else
    *sum += value;
#endif
"""


@kernel_factory
def accumulate(dtype: str) -> SimpleNamespace:
    real = types(2, dtype).real

    @wp.func_native(SNIPPET.format(index="world, p"))
    def to_particle(sums: wp.array2d(dtype=real), world: int, p: int, value: real):
        """sums[world, p] += value"""

    @wp.func_native(SNIPPET.format(index="world, p, slot"))
    def to_slot(sums: wp.array3d(dtype=real), world: int, p: int, slot: int, value: real):
        """sums[world, p, slot] += value"""

    return SimpleNamespace(to_particle=to_particle, to_slot=to_slot)
