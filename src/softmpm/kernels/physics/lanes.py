"""Threads that share the nodes of one surface point.

A point has 9 or 27 nodes, and one thread would wait for the memory of one after the other. On a GPU ``lanes`` neighbours in a warp
have a point: each takes some of its nodes, and all add up what they found, in a fixed order. A CPU has one lane.
"""

import torch
import warp as wp

from softmpm.kernels.compile import kernel_factory

MOST = {2: 16, 3: 32}
"""Lanes of a point on a GPU: the power of two from the number of its nodes on."""
THREADS = 2**17
"""Lanes of all points, at most, while a point has more than ``LEAST``: half as many threads as an H200 runs at a time."""
LEAST = 4
GROUP = "unsigned(((1ull << lanes) - 1) << (threadIdx.x & 31 & ~(lanes - 1)))"
SUM = f"""
    auto total = value;
#if defined(__CUDA_ARCH__)
    for (int other = lanes / 2; other > 0; other /= 2)
        for (unsigned k = 0; k < {{count}}; ++k)
            total.c[k] += __shfl_xor_sync({GROUP}, total.c[k], other);
#endif
    return total;
"""
MEETING = f"""
#if defined(__CUDA_ARCH__)
    __syncwarp({GROUP});
#endif
"""


def lanes_for(dim: int, points: int, device: torch.device) -> int:
    """Lanes of each of so many points."""
    if device.type == "cpu":
        return 1
    lanes = MOST[dim]
    while lanes > LEAST and lanes * points > THREADS:
        lanes //= 2
    return lanes


@kernel_factory
def lane_sum(count: int, real: type) -> wp.Function:
    """Function that adds up ``count`` numbers over the lanes of a point, for all of them; they call it together."""
    vector = wp.types.vector(count, real)

    @wp.func_native(SUM.format(count=count))
    def summed(value: vector, lanes: int) -> vector: ...

    return summed


@wp.func_native(MEETING)
def meet_lanes(lanes: int):
    """Wait until all lanes of a point have read what one of them writes next."""
