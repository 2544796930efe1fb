"""Comparison of the fields of a state with what its nodes show."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.lagrangian.rest import LAGRANGIAN
from softmpm.kernels.structs import types


@kernel_factory
def shown(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, mat = t.real, t.vec, t.mat

    @wp.func
    def accumulate_max(found: wp.array(dtype=real), k: int, difference: real):
        """Update the largest difference of field ``k``; a NaN counts as infinite."""
        size = wp.abs(difference)
        if size > real(0.0):
            wp.atomic_max(found, k, size)
        elif wp.isnan(size):
            wp.atomic_max(found, k, real(wp.inf))

    @kernel(LAGRANGIAN)
    def apart(
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
        shown_x: wp.array2d(dtype=vec),
        shown_v: wp.array2d(dtype=vec),
        shown_C: wp.array2d(dtype=mat),
        shown_F: wp.array2d(dtype=mat),
        # In and out:
        found: wp.array(dtype=real),
    ):
        """Largest difference of each of the four fields, over all worlds."""
        world, p = wp.tid()
        for i in range(dim):
            accumulate_max(found, 0, x[world, p][i] - shown_x[world, p][i])
            accumulate_max(found, 1, v[world, p][i] - shown_v[world, p][i])
            for j in range(dim):
                accumulate_max(found, 2, C[world, p][i, j] - shown_C[world, p][i, j])
                accumulate_max(found, 3, F[world, p][i, j] - shown_F[world, p][i, j])

    return SimpleNamespace(apart=apart)
