"""Alarms of the packed particles of the fast scheme. Blocks: kernels/physics/alarms.py."""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import NATIVE, native
from softmpm.kernels.physics import status
from softmpm.kernels.physics.alarms import alarm
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def packed_alarms(spec: Spec) -> SimpleNamespace:
    """Kernels that check the packed particles at the end of a chunk, and that permute the rest neighbours for it."""
    t, one = types(spec.dim, spec.dtype), alarm(spec)
    Constants, Packed, ParticleInputs = t.Constants, t.Packed, input_types(spec).ParticleInputs
    s, n = stencil(spec.dim, spec.dtype), native(spec.dim, spec.dtype)
    unpack_base, world_of, load_vec, load_mat = s.unpack_base, s.world_of, n.early.vector, n.early.matrix
    step_is_stable, near, row_fx, row_H = one.step_is_stable, one.near, t.row_fx, t.row_h
    ran, report = status.report(spec.dim, spec.dtype).ran, status.report(spec.dim, spec.dtype).report
    torn, step = int(Kind.TORN), int(Kind.STEP)

    @kernel(NATIVE)
    def check(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        neighbours: wp.array3d(dtype=wp.int32),  # by place
        substep: int,
        count: int,  # particles of one world
        total: int,  # particles of all worlds
        order: wp.array(dtype=wp.int32),
        # In:
        now: Packed,
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        i = wp.tid()
        world = world_of(i, count, total)
        p = i - world * count
        if not ran(words, world, substep):
            return
        if not step_is_stable(constants, inputs, world, p, load_mat(now.rows, i, row_H)):
            report(words, world, substep, step, order[i])
        base = unpack_base(now.base[i])
        fx = load_vec(now.rows, i, row_fx)
        for k in range(neighbours.shape[2]):
            q = neighbours[world, p, k]
            if q >= 0:
                j = world * count + q
                if not near(constants, unpack_base(now.base[j]) - base, load_vec(now.rows, j, row_fx) - fx):
                    report(words, world, substep, torn, order[i])

    @kernel(NATIVE)
    def permute_neighbours(
        # In:
        order: wp.array2d(dtype=wp.int32),
        places: wp.array2d(dtype=wp.int32),  # inverse of the order
        neighbours: wp.array2d(dtype=wp.int32),  # by particle
        # Out:
        by_place: wp.array3d(dtype=wp.int32),
    ):
        """Permute the rest neighbours into the order of the packed particles, as places in memory."""
        world, place = wp.tid()
        p = order[world, place]
        for k in range(neighbours.shape[1]):
            q = neighbours[p, k]
            if q >= 0:
                q = places[world, q]
            by_place[world, place, k] = q

    return SimpleNamespace(check=check, permute_neighbours=permute_neighbours)
