"""The machine code of the fast scheme's kernels, compiled here for a GPU that need not be here: sm_90, as for an H100."""

import re

import cubin
import pytest
import warp as wp

from softmpm.kernels.fused import fused
from softmpm.kernels.fused_adj import fused_adj
from softmpm.kernels.native import BLOCK, WARP
from softmpm.kernels.types import Spec, Wanted

ARCH = 90
CASES = [(2, "neo_hookean"), (2, "fixed_corotated"), (3, "neo_hookean"), (3, "fixed_corotated")]


@pytest.fixture(scope="module", autouse=True)
def compiler():
    wp.init()
    if ARCH not in wp.get_cuda_supported_archs():
        pytest.skip(f"this Warp has no compiler for sm_{ARCH} (NVRTC)")


def kernel(dim: int, law: str, which: str, bare: bool, few: bool):
    """What goes over the particles, in a bare scene or in one with everything but damping."""
    spec = Spec(
        dim=dim,
        dtype="float32",
        laws=(law,),
        muscle_slots=0 if bare else 2,
        contacts=() if bare else ("separate",),
        friction=not bare,
        gravity=True,
        damping=False,
    )
    if which == "adjoint":
        return fused_adj(spec, Wanted(material=not bare, activation=not bare)).advance_adj[few]
    return fused(spec).advance[few]


def compiled(kernel) -> tuple[str, cubin.Kernel]:
    """PTX of this kernel, and what its binary says about it; from Warp's cache if nothing has changed."""
    threads = WARP if kernel.module.name.endswith(".few") else BLOCK
    wp.set_module_options({"block_dim": threads}, module=kernel.module)
    (ptx,) = wp.compile_aot_module(kernel.module, arch=ARCH, use_ptx=True)
    (binary,) = wp.compile_aot_module(kernel.module, arch=ARCH, use_ptx=False)
    name = re.compile(rf"{kernel.key}_\w*_cuda_kernel_forward")
    (code,) = (code for entry, code in cubin.entries(ptx).items() if name.fullmatch(entry))
    (facts,) = (facts for entry, facts in cubin.kernels(binary).items() if name.fullmatch(entry))
    return code, facts


@pytest.mark.parametrize("few", [False, True], ids=["many", "few"])
@pytest.mark.parametrize("bare", [False, True], ids=["full", "bare"])
@pytest.mark.parametrize("which", ["forward", "adjoint"])
@pytest.mark.parametrize("dim, law", CASES)
def test_machine_code(dim, law, which, bare, few):
    """Nodes are read and added 16 bytes at a time, never number by number; no register is spilled, nothing is in local memory."""
    code, facts = compiled(kernel(dim, law, which, bare, few))
    print(f"\n{dim}D {law} {which}: {facts}")
    assert len(re.findall(r"\bred\.global\.add\.v4\.f32", code)) > 0
    assert not re.findall(r"\b(?:red|atom)\.global\.add\.f32", code)
    assert len(re.findall(r"\bld\.global\.nc\.v4\.f32", code)) >= 3  # a row of nodes, at least
    assert 0 < facts.registers <= 255
    declared = cubin.arrays(code)
    assert facts.frame == facts.stack == declared, f"{facts.frame - declared} bytes of registers are spilled"
    assert declared == 0
    assert not re.findall(r"^\s+[a-z]+\.\S*f64\b.*", code, re.MULTILINE), (
        "double precision where float32 is meant"
    )


def test_spilled_registers_would_be_seen():
    """The reader finds them where there must be some: the same kernel with room for four times as many blocks at a time."""
    spilling = kernel(3, "neo_hookean", "adjoint", bare=False, few=False)
    options = dict(spilling.options)
    try:
        spilling.options["launch_bounds"] = (BLOCK, 16)
        spilling.module.mark_modified()
        code, facts = compiled(spilling)
    finally:
        spilling.options.clear()
        spilling.options.update(options)
        spilling.module.mark_modified()
    assert facts.frame > cubin.arrays(code) and facts.registers <= 32
