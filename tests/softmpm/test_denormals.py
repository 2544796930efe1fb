"""On an x86 processor kernels count denormal numbers as zero; nothing else does."""

import platform

import pytest
import torch
from surface_scenes import slab

import softmpm

TINY = 1e-40

pytestmark = pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"), reason="other processors keep denormal numbers"
)


def drifting(model: softmpm.Model) -> torch.Tensor:
    """Velocities after two substeps of a body that drifts, in its first world at a speed too small for normal numbers."""
    start = model.rest()
    start.v[0], start.v[1] = TINY, 1e-30
    return softmpm.simulate(model, start, None, model.params(), substeps=2).v


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_a_denormal_velocity_is_zero_in_kernels_and_not_outside(formulation, threads):
    """Also after a call that failed the thread computes with them as before."""
    made = slab(gravity=None, walls=[])
    model = softmpm.build(made, device="cpu", worlds=2, formulation=formulation, threads=threads)
    v = drifting(model)
    assert not v[0].any()
    assert (v[1] / 1e-30 - 1.0).abs().max() < 0.01
    assert torch.tensor(TINY) * 1.0 > 0
    state = model.rest()
    state.v[:] = torch.randn(state.v.shape, generator=torch.Generator().manual_seed(1)) * 1e5
    with pytest.raises(softmpm.UnstableError):
        softmpm.simulate(model, state, None, model.params(), substeps=20)
    assert torch.tensor(TINY) * 1.0 > 0
