"""The kernels of bricks, compiled for sm_90: they must fit into the shared memory of a block."""

import sm90
import torch

from softmpm.kernels.lagrangian.bricks import LARGEST_LATTICE, bricks_for
from softmpm.kernels.lagrangian.lattice import lattice_cells_adj
from softmpm.kernels.structs import RequestedGrads, Spec


def test_the_largest_kernel_fits_into_shared_memory():
    """The adjoint with viscosity on the largest lattice: three nodal fields and two sums. The compiler refuses what does not fit."""
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
    assert sm90.compiled(kernel, ptx=False)
