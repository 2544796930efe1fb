"""The machine code of the fast scheme's kernels for sm_90."""

import dataclasses
import re

import cubin
import pytest
import sm90

from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.g2p2g_adj import fused_adj
from softmpm.kernels.fast.native import BLOCK, FEW, MANY, WARP, SizeClass
from softmpm.kernels.structs import RequestedGrads, Spec
from softmpm.schemes.fast.launch_size import size_class_of

CASES = [(2, "neo_hookean"), (2, "fixed_corotated"), (3, "neo_hookean"), (3, "fixed_corotated")]


def scene_spec(dim: int, law: str, bare: bool) -> Spec:
    """A bare scene, or one with everything but damping."""
    return Spec(
        dim=dim,
        dtype="float32",
        laws=(law,),
        muscle_slots=0 if bare else 2,
        actuators=() if bare else ("muscle",),
        fibres=not bare,
        contacts=() if bare else ("separate",),
        friction=not bare,
        gravity=True,
        damping=False,
    )


def kernel(dim: int, law: str, which: str, bare: bool, size_class: SizeClass):
    """A kernel over particles."""
    spec = scene_spec(dim, law, bare)
    if which == "adjoint":
        wanted = RequestedGrads(() if bare else ("material", "activation"))
        return fused_adj(spec, wanted).g2p2g_adj[size_class is SizeClass.FEW]
    return fused(spec).g2p2g[size_class]


def compiled(kernel, threads: int = BLOCK) -> tuple[str, cubin.Kernel]:
    """PTX of this kernel for blocks of so many threads, and what its binary says about it.

    Line numbers bring the PTX into the binary and change no instruction.
    """
    binary = sm90.compiled(kernel, ptx=False, block_dim=threads, lineinfo=True)
    name = re.compile(rf"{kernel.key}_\w*_cuda_kernel_forward")
    (code,) = (code for entry, code in cubin.entries(cubin.ptx(binary)).items() if name.fullmatch(entry))
    (facts,) = (facts for entry, facts in cubin.kernels(binary).items() if name.fullmatch(entry))
    return code, facts


@pytest.mark.parametrize(
    "which, size_class",
    [
        *(("forward", size_class) for size_class in SizeClass),
        ("adjoint", SizeClass.FEW),
        ("adjoint", SizeClass.SOME),
    ],
)
@pytest.mark.parametrize("bare", [False, True], ids=["full", "bare"])
@pytest.mark.parametrize("dim, law", CASES)
def test_machine_code(dim, law, bare, which, size_class):
    """Nodes are read and added 16 bytes at a time, never number by number; no register is spilled, nothing is in local memory.

    Numbers that are added to singly are a particle's own: the gradients of both moduli and of the stress of two actuators.
    """
    code, facts = compiled(
        kernel(dim, law, which, bare, size_class), WARP if size_class is SizeClass.FEW else BLOCK
    )
    print(f"\n{dim}D {law} {'bare' if bare else 'full'} {which} {size_class.name}: {facts}")
    assert len(re.findall(r"\bred\.global\.add\.v4\.f32", code)) > 0
    own = 4 if which == "adjoint" and not bare else 0
    assert len(re.findall(r"\b(?:red|atom)\.global\.add\.f32", code)) == own
    load = "ld.global.nc.v4.f32" if (which, size_class) == ("forward", SizeClass.MANY) else "ld.global.v4.f32"
    assert code.count(load) >= 3  # a row of nodes, at least
    assert 0 < facts.registers <= 255
    declared = cubin.arrays(code)
    assert facts.frame == facts.stack == declared, f"{facts.frame - declared} bytes of registers are spilled"
    assert declared == 0
    assert not re.findall(r"^\s*[a-z]+\.\S*f64\b.*", code, re.MULTILINE), (
        "double precision where float32 is meant"
    )


@pytest.mark.parametrize("law, blocks", [("neo_hookean", 6), ("fixed_corotated", 5)])
def test_many_particles_leave_room_for_other_warps(law, blocks):
    """A multiprocessor has 65,536 registers: as many blocks fit as at commit b296f55, whose machine code this is."""
    _, facts = compiled(kernel(3, law, "forward", bare=True, size_class=SizeClass.MANY))
    assert facts.registers * BLOCK * blocks <= 65_536


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_are_not_in_memory(dim):
    """Whatever their number, the kernels of the grid load nothing for them and have nothing in local memory."""
    loads = []
    for kinds in (("separate",), ("separate", "slip", "stick", "slip", "separate", "separate")):
        spec = dataclasses.replace(scene_spec(dim, "neo_hookean", bare=False), contacts=kinds)
        wanted = RequestedGrads()
        both = [compiled(k) for k in (fused(spec).grid_velocity, fused_adj(spec, wanted).grid_velocity_adj)]
        assert all(facts.frame == facts.stack == 0 for _, facts in both)
        loads.append([len(re.findall(r"\bld\.global", code)) for code, _ in both])
    assert loads[0] == loads[1] and min(loads[0]) > 0


@pytest.mark.parametrize(
    "particles, size_class",
    [(FEW, SizeClass.FEW), (FEW + 1, SizeClass.SOME), (MANY, SizeClass.SOME), (MANY + 1, SizeClass.MANY)],
)
def test_the_variant_goes_by_the_particles_of_all_worlds(particles, size_class):
    """At the bounds themselves and beyond them."""
    assert size_class_of(particles) is size_class


def test_spilled_registers_would_be_seen():
    """The reader finds them where there must be some: the same kernel with room for four times as many blocks at a time."""
    spilling = kernel(3, "neo_hookean", "adjoint", bare=False, size_class=SizeClass.SOME)
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
