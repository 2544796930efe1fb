"""The kernels of bricks, compiled here for a GPU that need not be here: they must fit into the shared memory of a block."""

import pytest
import torch
import warp as wp

from softmpm.kernels.lagrangian.bricks import LARGEST_LATTICE, bricks_for
from softmpm.kernels.lagrangian.lattice import lattice_cells_adj
from softmpm.kernels.structs import RequestedGrads, Spec

ARCH = 90


def test_the_largest_kernel_fits_into_shared_memory():
    """The adjoint with viscosity on the largest lattice: three nodal fields and two sums. The compiler refuses what does not fit."""
    wp.init()
    if ARCH not in wp.get_cuda_supported_archs():
        pytest.skip(f"this Warp has no compiler for sm_{ARCH} (NVRTC)")
    spec = Spec(
        dim=3,
        dtype="float32",
        laws=("neo_hookean",),
        muscle_slots=0,
        contacts=(),
        friction=False,
        gravity=True,
        damping=False,
        viscosity=True,
    )
    bricks = bricks_for(3, 10**6, torch.device("cuda"), torch.float32, LARGEST_LATTICE)
    kernel = lattice_cells_adj(spec, RequestedGrads(), bricks).forces_adj
    assert wp.compile_aot_module(kernel.module, arch=ARCH, use_ptx=False)
