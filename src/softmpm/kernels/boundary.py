"""Between what users hold (x, F) and what the kernels hold (base node and fraction, F − I). Exact to the last digit.

base = ⌊x/dx − ½⌋,  fx = x/dx − base,  H = F − I        both ways in float64, whatever the precision of the scene.
"""

import functools
from types import SimpleNamespace

import warp as wp

from softmpm.kernels import failure
from softmpm.kernels.types import types
from softmpm.watch import Kind


@functools.lru_cache(maxsize=None)
def boundary(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, mat, ivec, Scale, Motion = t.real, t.vec, t.mat, t.ivec, t.Scale, t.Motion
    report = failure.report(dim, dtype).report
    bad_start, rounds = int(Kind.START), dtype == "float32"
    module = f"softmpm.boundary.d{dim}.{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def enter(
        # Parameters:
        scale: Scale,
        # In:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
        low_x: wp.array2d(dtype=vec),
        low_F: wp.array2d(dtype=mat),
        # Out:
        watch: wp.array(dtype=wp.int64),
        start: Motion,
    ):
        world, p = wp.tid()
        base = ivec()
        fx = vec()
        fx_low = vec()
        H = F[world, p]
        size = wp.ddot(H, H) + wp.dot(v[world, p], v[world, p]) + wp.ddot(C[world, p], C[world, p])
        sound = wp.isfinite(size)
        for axis in range(dim):
            exact = wp.float64(x[world, p][axis])
            if wp.static(rounds):
                exact += wp.float64(low_x[world, p][axis])
            cell = exact / scale.exact_spacing
            first = wp.floor(cell - wp.float64(0.5))
            inside = first >= wp.float64(0.0) and first <= wp.float64(scale.shape[axis] - 3)
            if inside:
                base[axis] = int(first)
            else:
                sound = False
            fx[axis] = real(cell - wp.float64(base[axis]))
            fx_low[axis] = real(cell - wp.float64(base[axis]) - wp.float64(fx[axis]))
            for other in range(dim):
                change = wp.float64(F[world, p][axis, other]) - wp.float64(wp.where(axis == other, 1.0, 0.0))
                if wp.static(rounds):
                    change += wp.float64(low_F[world, p][axis, other])
                H[axis, other] = real(change)
        start.base[world, p] = base
        start.fx[world, p] = fx
        start.v[world, p] = v[world, p]
        start.C[world, p] = C[world, p]
        start.H[world, p] = H
        if wp.static(rounds):
            start.fx_low[world, p] = fx_low
        if not sound:
            report(watch, world, 0, bad_start, p)

    @wp.kernel(module=module, enable_backward=False)
    def leave(
        # Parameters:
        scale: Scale,
        # In:
        end: Motion,
        # Out:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
        low_x: wp.array2d(dtype=vec),
        low_F: wp.array2d(dtype=mat),
    ):
        world, p = wp.tid()
        high_x = vec()
        rest_x = vec()
        high_F = mat()
        rest_F = mat()
        for axis in range(dim):
            cell = wp.float64(end.base[world, p][axis]) + wp.float64(end.fx[world, p][axis])
            if wp.static(rounds):
                cell += wp.float64(end.fx_low[world, p][axis])
            exact = cell * scale.exact_spacing
            high_x[axis] = real(exact)
            rest_x[axis] = real(exact - wp.float64(real(exact)))
            for other in range(dim):
                full = wp.float64(end.H[world, p][axis, other]) + wp.float64(
                    wp.where(axis == other, 1.0, 0.0)
                )
                high_F[axis, other] = real(full)
                rest_F[axis, other] = real(full - wp.float64(real(full)))
        x[world, p] = high_x
        v[world, p] = end.v[world, p]
        C[world, p] = end.C[world, p]
        F[world, p] = high_F
        if wp.static(rounds):
            low_x[world, p] = rest_x
            low_F[world, p] = rest_F

    return SimpleNamespace(enter=enter, leave=leave)
