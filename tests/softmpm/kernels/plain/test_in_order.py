"""Kernels whose sums a GPU takes in a fixed order: compiled for sm_90, and launched as Warp's deterministic mode needs it."""

import re
from types import SimpleNamespace
from typing import Any

import cubin
import pytest
import sm90
import torch
import warp as wp
from helpers import busy_inputs, busy_scene, run

import softmpm
from softmpm.kernels import compile as compiling
from softmpm.kernels.plain.transfer import transfer, transfer_adj
from softmpm.kernels.rasterize import raster
from softmpm.kernels.structs import RequestedGrads
from softmpm.schemes.plain.substep import Substep

RECORD = r"\batom\.global\.add\.u32"  # the place of the next record


def kernels(dim: int, dtype: torch.dtype, ordered: bool) -> tuple:
    """Kernels that add to nodes."""
    spec = softmpm.build(busy_scene(dim), device="cpu", dtype=dtype, scheme="plain", deterministic=True).spec
    wanted, observer = RequestedGrads(("material", "activation")), raster(dim, spec.dtype)
    splat = observer.splat_in_order if ordered else observer.splat
    return transfer(spec, ordered).p2g, transfer_adj(spec, wanted, ordered).g2p_adj, splat


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_terms_are_recorded(dim, dtype):
    """Each records its terms, 3^dim of a particle; without ``ordered`` it records none."""
    for ordered in (True, False):
        for kernel in kernels(dim, dtype, ordered):
            ptx = sm90.compiled(kernel, ptx=True)
            name = re.compile(rf"{kernel.key}_[0-9a-f]+_cuda_kernel_forward")
            (code,) = (
                code for entry, code in cubin.entries(ptx.read_text()).items() if name.fullmatch(entry)
            )
            assert bool(re.findall(RECORD, code)) == ordered
            assert kernel.module.options["deterministic_max_records"] == (3**dim if ordered else 0)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_cpu_adds_as_before(dim, monkeypatch):
    """The kernels in order, forced upon the CPU: the same bits as without."""
    model = softmpm.build(busy_scene(dim), device="cpu", scheme="plain", worlds=2)
    inputs, found = busy_inputs(model), []
    for ordered in (False, True):
        made = Substep.__init__

        def init(step, model, made=made, ordered=ordered):
            made(step, model)
            step.ordered, step.transfer = ordered, transfer(model.spec, ordered)

        with monkeypatch.context() as patched:
            patched.setattr(Substep, "__init__", init)
            end = run(softmpm.simulate, model, inputs, 5)
            found.append((*end[:4], *torch.autograd.grad(end.x.square().sum(), list(inputs.values()))))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def test_a_capture_is_refused():
    """It would be invalidated by Warp, which reads the number of records back."""
    stream: Any = SimpleNamespace(is_capturing=True)
    with pytest.raises(RuntimeError, match=r"cannot be captured in a CUDA graph; call them outside of it"):
        compiling._launch_in_order(None, 1, (), stream)


def test_nodes_beyond_the_reach_of_32_bits_are_refused():
    """Warp would leave out terms without a word."""
    wp.init()
    stream: Any = SimpleNamespace(is_capturing=False)
    nodes = wp.array(ptr=16, shape=(2**7, 2**22), dtype=wp.vec3f, device="cpu")  # no memory: nothing reads it
    with pytest.raises(ValueError, match=r"all worlds take 6,442,450,944: take fewer worlds or fewer nodes"):
        compiling._launch_in_order(None, 1, (1.0, nodes), stream)
