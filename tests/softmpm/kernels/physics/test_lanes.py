"""Threads that share the nodes of a surface point."""

import pytest
import torch
import warp as wp

from softmpm.kernels.physics.lanes import LEAST, MOST, THREADS, lane_sum, lanes_for

GPU, CPU = torch.device("cuda"), torch.device("cpu")


@pytest.mark.parametrize("dim", [2, 3])
def test_few_points_have_a_lane_for_each_node_and_many_fewer(dim):
    """On a GPU each node of a stencil has a lane while all lanes fit; on a CPU a point has one."""
    assert lanes_for(dim, 100, GPU) == MOST[dim] >= 3**dim
    assert lanes_for(dim, 10**7, GPU) == LEAST
    assert lanes_for(dim, 100, CPU) == 1
    for points in (THREADS // 16, THREADS // 8, THREADS // 4):
        assert points * lanes_for(dim, points, GPU) <= THREADS


@pytest.mark.parametrize("lanes", [4, 8, 16, 32])
def test_the_lanes_of_a_point_add_up_their_own_numbers_only(lanes, device):
    """Integers are summed exactly; groups of lanes in one warp do not mix, and the last warp may be incomplete."""
    wp.init()
    lanes, points, pair = 1 if device == "cpu" else lanes, 7, wp.types.vector(2, wp.float32)
    summed = lane_sum(2, wp.float32)

    @wp.kernel(module=f"softmpm.tests.lanes{lanes}", enable_backward=False)
    def add(lanes: int, given: wp.array2d(dtype=pair), found: wp.array2d(dtype=pair)):
        p, lane = wp.tid()
        found[p, lane] = summed(given[p, lane], lanes)

    numbers = torch.arange(points * lanes * 2, dtype=torch.float32, device=device).view(points, lanes, 2)
    found = torch.zeros_like(numbers)
    given, out = (wp.from_torch(tensor, dtype=pair) for tensor in (numbers, found))
    wp.launch(add, (points, lanes), [lanes, given, out], device=given.device, block_dim=64)
    wp.synchronize_device(given.device)
    assert torch.equal(found, numbers.sum(1, keepdim=True).expand_as(found))
