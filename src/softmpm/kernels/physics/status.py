"""Detection of failures on the device, reported as one 64-bit status word per world, see softmpm/errors.py."""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import FROZEN, KIND_SHIFT, NEVER, SUBSTEP_SHIFT, Kind
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.structs import Spec, types


@kernel_factory
def report(dim: int, dtype: str) -> SimpleNamespace:
    """Functions that read and write the status word of a world."""
    kind_bits = SUBSTEP_SHIFT - KIND_SHIFT

    @wp.func
    def running(words: wp.array(dtype=wp.int64), world: int) -> bool:
        return words[world] == wp.int64(NEVER)

    @wp.func
    def was_running(words: wp.array(dtype=wp.int64), world: int, substep: int, kind: int) -> bool:
        """As ``running`` before a launch that itself reports failures of this substep and kind."""
        own = (wp.int64(substep) << wp.int64(kind_bits)) | wp.int64(kind)
        return running(words, world) or words[world] >> wp.int64(KIND_SHIFT) == own

    @wp.func
    def write(words: wp.array(dtype=wp.int64), world: int, substep: int, kind: int, particle: int):
        word = (
            (wp.int64(substep) << wp.int64(SUBSTEP_SHIFT))
            | (wp.int64(kind) << wp.int64(KIND_SHIFT))
            | wp.int64(particle)
        )
        wp.atomic_min(words, world, word)

    @wp.func
    def ran(words: wp.array(dtype=wp.int64), world: int, substep: int) -> bool:
        """True if the world has not failed before ``substep``."""
        word = words[world]
        return word >= wp.int64(substep) << wp.int64(SUBSTEP_SHIFT) and word != wp.int64(FROZEN)

    return SimpleNamespace(running=running, was_running=was_running, ran=ran, report=write)


@kernel_factory
def check(spec: Spec) -> SimpleNamespace:
    """Validity of a new state: finite, on the grid, not collapsed."""
    t = types(spec.dim, spec.dtype)
    real, vec, mat, ivec, Constants = t.real, t.vec, t.mat, t.ivec, t.Constants
    write, volume_change = report(spec.dim, spec.dtype).report, kinematics(spec.dim, spec.dtype).volume_change
    dim = spec.dim
    not_finite, left_grid, collapsed = int(Kind.NOT_FINITE), int(Kind.LEFT_GRID), int(Kind.COLLAPSED)
    left_window = int(Kind.LEFT_WINDOW)
    largest = 1.0e12  # of det F, and of a squared distance in cells

    @wp.func
    def valid(constants: Constants, corner: ivec, shape: ivec, fx: vec, base: ivec, H: mat) -> bool:
        """True if the updated particle is finite, inside the window of ``shape`` nodes from ``corner``, and not collapsed.

        A comparison with NaN is false. No branch: it would delay the loads that the stress needs.
        """
        j = volume_change(H)
        ok = int(j > constants.collapse) & int(j < real(largest)) & int(wp.dot(fx, fx) < real(largest))
        for axis in range(dim):  # unsigned: below zero is far above as well
            ok &= int(wp.uint32(base[axis] - corner[axis]) <= wp.uint32(shape[axis] - 3))
        return ok != 0

    @wp.func
    def report_invalid(
        words: wp.array(dtype=wp.int64),
        constants: Constants,
        world: int,
        p: int,
        substep: int,
        fx: vec,
        base: ivec,
        H: mat,
    ):
        """Write the status word of an invalid particle. Precedence: non-finite, collapsed, off the grid, outside the window."""
        kind = left_window
        for axis in range(dim):
            if wp.uint32(base[axis]) > wp.uint32(constants.shape[axis] - 3):
                kind = left_grid
        j = volume_change(H)
        if not wp.isfinite(wp.ddot(H, H) + wp.dot(fx, fx)) or not j < real(largest):
            kind = not_finite
        elif not j > constants.collapse:
            kind = collapsed
        write(words, world, substep, kind, p)

    return SimpleNamespace(valid=valid, report_invalid=report_invalid)
