"""Repeated launches: each works on its own inputs, as if it were launched alone."""

import subprocess
import sys
import weakref

import numpy as np
import pytest
import torch
import warp as wp
from helpers import busy_scene
from surface_scenes import block

import softmpm
from softmpm.kernels import compile as compiling
from softmpm.kernels.fast.packing import packing
from softmpm.kernels.fast.sorting import sorting
from softmpm.schemes.buffers import view
from softmpm.schemes.device import stream_of
from softmpm.schemes.launch import KernelLauncher, launcher
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
        Program(launches).run(None)
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
def test_kernels_are_compiled_together_before_they_are_launched(dim, formulation, monkeypatch):
    """All but the smallest, for the threads of a block with which they are launched, and no others."""
    batches, launched, at_once = [], set(), compiling._compile_at_once

    def listed(wanted):
        batches.append([one for one in wanted if not any(one in batch for batch in batches)])
        at_once(wanted)

    monkeypatch.setattr(compiling, "_launched", launched)
    monkeypatch.setattr(compiling, "_compile_at_once", listed)
    model = softmpm.build(block(dim), device="cpu", formulation=formulation)
    start = model.rest()
    start.x.add_(0.5 * model.scene.grid.spacing)  # off the walls
    start.x.requires_grad_()
    end = softmpm.simulate(model, start, None, model.params(), substeps=3)
    end.x.sum().backward()
    single = {batch[0][0].key.split("__")[-1] for batch in batches if len(batch) == 1}
    together = {one for batch in batches if len(batch) > 1 for one in batch}
    small = {"sort", "sort_adj", "collect", "constants", "run"}  # the last one runs programs on a CPU
    assert single <= small
    assert together and together <= launched | unused(model)


def unused(model) -> set:
    """Kernels of the lists that this call does not need: it begins with particles, and ends after one chunk."""
    dim, dtype, lists = model.spec.dim, model.spec.dtype, []
    if model.formulation == "moving":
        lists += [sorting(dim, dtype).centre_window, sorting(dim, dtype).move, sorting(dim, dtype).move_adj]
        lists += [packing(dim, dtype).positions, packing(dim, dtype).leave_adj]
    return {(kernel, "cpu", compiling.THREADS) for kernel in lists}


@pytest.mark.gpu
def test_kernels_are_compiled_for_the_threads_of_a_block():
    """Before they are launched; a kernel whose code is wrong raises as its launch would."""
    device, out = wp.get_device("cuda"), torch.zeros(3, device="cuda")
    kernels = [filling(value) for value in (1.5, 2.5)]
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


def filling(value: float, **settings) -> wp.Kernel:
    @compiling.kernel(**settings)
    def fill(out: wp.array(dtype=wp.float32)):
        out[wp.tid()] = wp.static(value)

    return fill


def test_kernels_are_one_if_their_code_and_options_are():
    """Whatever factory made them: a number of the closure, a compile option or a bound of the launch makes another one."""
    fill = filling(3.5)
    assert filling(3.5) is fill
    others = [filling(4.5), filling(3.5, options={"max_unroll": 3}), filling(3.5, launch_bounds=64)]
    assert len({fill, *others}) == 4 == len({one.module for one in (fill, *others)})


def test_after_a_failure_to_compile_no_thread_is_at_work(monkeypatch):
    """The others are compiled or not begun, and a later call compiles them."""
    kernels = [(filling(20.5 + k), "cpu", 64) for k in range(12)]
    compiled, done, working = compiling._compile, [], []

    def failing(one):
        working.append(one)
        try:
            if one == kernels[0]:
                raise RuntimeError("no compiler")
            compiled(one)
            done.append(one)
        finally:
            working.remove(one)

    monkeypatch.setattr(compiling, "_compile", failing)
    with pytest.raises(RuntimeError, match="no compiler"):
        compiling.compile_together([(kernel, 64) for kernel, *_ in kernels], wp.get_device("cpu"))
    assert not working and set(done) == {one for one in kernels if one in compiling._compiled}
    monkeypatch.undo()
    compiling.compile_together([(kernel, 64) for kernel, *_ in kernels], wp.get_device("cpu"))
    assert set(kernels) <= compiling._compiled


LATE = """
import os, threading, warp as wp
from softmpm.kernels.compile import kernel, launch

def made(value):
    @kernel()
    def late(out: wp.array(dtype=wp.float32)):
        out[wp.tid()] = wp.static(value)

    return late

def filled(value):
    out = wp.zeros(2, dtype=wp.float32, device="cpu")
    launch(made(value), 2, [out], wp.get_device("cpu"))
    return out.numpy().tolist() == 2 * [value]

def after_the_main_thread():
    threading.main_thread().join()
    print("filled" if filled(3.75) else "not filled")

wp.init()
assert filled(2.75)
"""
THREAD = "threading.Thread(target=after_the_main_thread).start()"
FORK = """
child = os.fork()
if child == 0:
    os._exit(0 if filled(4.75) else 1)
print("filled" if os.waitpid(child, 0)[1] == 0 else "not filled")
"""


@pytest.mark.parametrize("way", [THREAD, FORK], ids=["after the main thread", "after a fork"])
def test_kernels_are_compiled_where_there_are_no_threads_for_it(way, tmp_path):
    """Thread pools take no more work once the main thread has ended, and a child has none of the threads of its parent."""
    path = tmp_path / "late.py"
    path.write_text(LATE + way)
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0 and done.stdout.splitlines()[-1] == "filled", done.stderr
