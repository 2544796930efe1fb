"""Repeated launches: each works on its own inputs, as if it were launched alone."""

import weakref

import numpy as np
import pytest
import torch
import warp as wp
from helpers import busy_scene
from surface_scenes import block

import softmpm
from softmpm.kernels import compile as compiling
from softmpm.schemes import fast, lagrangian
from softmpm.schemes.buffers import view
from softmpm.schemes.device import stream_of
from softmpm.schemes.launch import KernelLauncher, KernelList, LaunchReplay, launcher
from softmpm.schemes.program import Program


@wp.struct
class Offsets:
    each: wp.array(dtype=wp.float32)
    shift: wp.vec2


@wp.kernel
def combine(offsets: Offsets, whole: int, real: float, flag: bool, out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    found = offsets.each[i] + offsets.shift[1] + float(whole) * real
    out[i] = wp.where(flag, found, -found)


CASES = [(1, 0.5, True, (3.0, 4.0)), (7, -0.25, False, (-1.0, 2.5)), (2, 8.0, True, (0.0, -6.0))]


@pytest.mark.parametrize("collected", [False, True])
def test_launches_of_one_kernel_keep_their_own_inputs(device, collected):
    model = softmpm.build(busy_scene(2), device=device)
    launches = [] if collected else None
    launch = KernelLauncher(model, stream_of(model.device), launches if device == "cpu" else None)
    outputs, given = [], []
    for whole, real, flag, shift in CASES:
        each, out = torch.rand(5, device=device), torch.zeros(5, device=device)
        offsets = Offsets()
        offsets.each, offsets.shift = view(each, wp.float32), wp.vec2(*shift)
        launch(combine, 5, offsets, whole, real, flag, view(out, wp.float32))
        outputs.append(out)
        given.append(each)
    if launches:
        Program(launches).run()
    for (whole, real, flag, shift), each, out in zip(CASES, given, outputs, strict=True):
        want = (1.0 if flag else -1.0) * (each.cpu().numpy() + np.float32(shift[1] + whole * real))
        np.testing.assert_allclose(out.cpu().numpy(), want, rtol=1e-6)


def test_a_repeated_launch_refuses_inputs_of_another_type():
    model = softmpm.build(busy_scene(2), device="cpu")
    launch, out = KernelLauncher(model, None, []), view(torch.zeros(5), wp.float32)
    offsets = Offsets()
    offsets.each = out
    launch(combine, 5, offsets, 1, 0.5, True, out)
    with pytest.raises(AssertionError, match="a repeated launch got"):
        launch(combine, 5, out, 1, 0.5, True, out)


def test_the_launcher_keeps_no_arrays_alive():
    """One launcher of a model; what it remembers of a launch does not refer to the first inputs."""
    model = softmpm.build(busy_scene(2), device="cpu")
    assert launcher(model) is launcher(model)

    def call() -> weakref.ref:
        offsets, out = Offsets(), view(torch.zeros(5), wp.float32)
        offsets.each, offsets.shift = view(torch.ones(5), wp.float32), wp.vec2(0.0, 2.0)
        launcher(model)(combine, 5, offsets, 2, 0.5, True, out)
        assert out.numpy().tolist() == 5 * [4.0]
        return weakref.ref(out)

    assert call()() is None and call()() is None


@pytest.mark.parametrize("formulation", ["moving", "reference"])
@pytest.mark.parametrize("dim", [2, 3])
def test_kernels_are_known_before_the_first_is_launched(dim, formulation, monkeypatch):
    """Those of a chunk by its list, the others of a call and its gradient by that of the scheme, but for the smallest."""
    launched, in_chunks, run = set(), set(), LaunchReplay.run

    def listed(self, stream, launches):
        found = KernelList()
        launches(found)
        in_chunks.update(found.found)
        run(self, stream, launches)

    monkeypatch.setattr(compiling, "_launched", launched)
    monkeypatch.setattr(LaunchReplay, "run", listed)
    alarms = softmpm.Alarms(depth=None)
    model = softmpm.build(block(dim), device="cpu", formulation=formulation, alarms=alarms)
    start = model.rest()
    start.x.requires_grad_()
    end = softmpm.simulate(model, start, None, model.params(), substeps=3)
    end.x.sum().backward()
    used = {(kernel, threads) for kernel, _, threads in launched}
    assert in_chunks and {kernel for kernel, _ in in_chunks} <= {kernel for kernel, _ in used}
    of_scheme = {"moving": fast, "reference": lagrangian}[formulation].kernels.first_kernels(model)
    known = {kernel for kernel, _ in [*in_chunks, *of_scheme]}
    missing = {kernel.key.split("__")[-1] for kernel, _ in used if kernel not in known}
    assert missing <= {"sort", "sort_adj", "run"}  # the last one runs programs on a CPU


@pytest.mark.gpu
def test_kernels_are_compiled_together_before_their_launch():
    """For the number of threads that is asked for; a kernel whose code is wrong raises as its launch would."""
    device, out = wp.get_device("cuda"), torch.zeros(3, device="cuda")

    def made(value: float):
        @compiling.kernel()
        def fill(out: wp.array(dtype=wp.float32)):
            out[wp.tid()] = wp.static(value)

        return fill

    kernels = [made(value) for value in (1.5, 2.5)]
    compiling.compile_together([(kernel, 64) for kernel in kernels], device)
    assert all(list(kernel.module.execs) == [(device.context, 64)] for kernel in kernels)
    for kernel, value in zip(kernels, (1.5, 2.5), strict=True):
        compiling.launch(
            kernel, 3, [view(out, wp.float32)], device, block_dim=64, stream=stream_of(out.device)
        )
        assert out.tolist() == 3 * [value] and len(kernel.module.execs) == 1

    @compiling.kernel()
    def wrong(out: wp.array(dtype=wp.float32)):
        out[wp.tid()] = unknown  # noqa: F821

    with pytest.raises(Exception, match="unknown"):
        compiling.compile_together([(wrong, 64)], device)


def test_the_cpu_compiles_what_it_launches():
    """Nothing before, since each thread would prepare the headers of Warp anew."""

    @compiling.kernel()
    def idle(out: wp.array(dtype=wp.float32)):
        out[wp.tid()] = 7.0

    compiling.compile_together([(idle, 64)], wp.get_device("cpu"))
    assert not idle.module.execs
