"""Alarms of a state in the user's order. Blocks: kernels/physics/alarms.py."""

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.physics import status
from softmpm.kernels.physics.alarms import alarm
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def state_alarms(spec: Spec):
    """Kernel that checks a state in the user's order, before any substep or after ``substep``."""
    t, one = types(spec.dim, spec.dtype), alarm(spec)
    real, vec, mat, ivec, Constants = t.real, t.vec, t.mat, t.ivec, t.Constants
    ParticleInputs = input_types(spec).ParticleInputs
    blocks = kinematics(spec.dim, spec.dtype)
    volume_change, identity = blocks.volume_change, blocks.identity
    step_is_stable, near = one.step_is_stable, one.near
    ran, report = status.report(spec.dim, spec.dtype).ran, status.report(spec.dim, spec.dtype).report
    start, torn, step = int(Kind.START), int(Kind.TORN), int(Kind.STEP)

    @wp.func
    def on_grid(constants: Constants, x: vec) -> bool:
        for axis in range(spec.dim):
            cell = x[axis] / constants.spacing
            if not (cell >= real(0.5) and cell < real(constants.shape[axis]) - real(1.5)):
                return False
        return True

    @kernel()
    def check(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        neighbours: wp.array2d(dtype=wp.int32),
        substep: int,  # -1 before the first
        # In:
        x: wp.array2d(dtype=vec),
        F: wp.array2d(dtype=mat),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        world, p = wp.tid()
        if not ran(words, world, wp.max(substep, 0)):
            return
        H = F[world, p] - identity()
        if not step_is_stable(constants, inputs, world, p, H):
            report(words, world, wp.max(substep, 0), step, p)
        for k in range(neighbours.shape[1]):
            q = neighbours[p, k]
            if q >= 0 and not on_grid(constants, x[world, q]):
                q = -1  # that one is reported where it enters the kernels
            if (
                q >= 0
                and on_grid(constants, x[world, p])
                and not near(constants, ivec(), (x[world, q] - x[world, p]) / constants.spacing)
            ):
                report(words, world, wp.max(substep, 0), wp.where(substep < 0, start, torn), p)
        if substep < 0 and not volume_change(H) > constants.collapse:
            report(words, world, 0, start, p)

    return check
