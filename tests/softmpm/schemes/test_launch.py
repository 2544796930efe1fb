"""Repeated launches: each works on its own inputs, as if it were launched alone."""

import weakref

import numpy as np
import pytest
import torch
import warp as wp
from helpers import busy_scene

import softmpm
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
