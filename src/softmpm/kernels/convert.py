"""Conversion between a user's state (x, F) and that of the kernels (base node and fraction, F − I). Exact to the last digit.

base = ⌊x/dx − ½⌋,  fx = x/dx − base,  H = F − I        both ways in float64, whatever the precision of the scene.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.physics import status
from softmpm.kernels.structs import types


@kernel_factory
def conversion(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, mat, ivec, Constants, Motion = t.real, t.vec, t.mat, t.ivec, t.Constants, t.Motion
    report = status.report(dim, dtype).report
    bad_start, rounds = int(Kind.START), dtype == "float32"

    @wp.struct
    class Entered:
        base: ivec
        fx: vec
        low: vec
        H: mat
        valid: bool

    @wp.struct
    class Left:
        x: vec
        low_x: vec
        F: mat
        low_f: mat

    @wp.func
    def entered(constants: Constants, x: vec, v: vec, C: mat, F: mat, low_x: vec, low_F: mat) -> Entered:
        """One particle in the kernels' representation; not valid if it is not finite or off the grid."""
        at = Entered()
        at.valid = wp.isfinite(wp.ddot(F, F) + wp.dot(v, v) + wp.ddot(C, C))
        for axis in range(dim):
            exact = wp.float64(x[axis])
            if wp.static(rounds):
                exact += wp.float64(low_x[axis])
            cell = exact / constants.exact_spacing
            first = wp.floor(cell - wp.float64(0.5))
            inside = first >= wp.float64(0.0) and first <= wp.float64(constants.shape[axis] - 3)
            if inside:
                at.base[axis] = int(first)
            else:
                at.valid = False
            at.fx[axis] = real(cell - wp.float64(at.base[axis]))
            at.low[axis] = real(cell - wp.float64(at.base[axis]) - wp.float64(at.fx[axis]))
            for other in range(dim):
                change = wp.float64(F[axis, other]) - wp.float64(wp.where(axis == other, 1.0, 0.0))
                if wp.static(rounds):
                    change += wp.float64(low_F[axis, other])
                at.H[axis, other] = real(change)
        return at

    @wp.func
    def left(constants: Constants, base: ivec, fx: vec, low: vec, H: mat) -> Left:
        """One particle in the user's representation, with the low-order parts that rounding removes."""
        out = Left()
        for axis in range(dim):
            cell = wp.float64(base[axis]) + wp.float64(fx[axis])
            if wp.static(rounds):
                cell += wp.float64(low[axis])
            exact = cell * constants.exact_spacing
            out.x[axis] = real(exact)
            out.low_x[axis] = real(exact - wp.float64(real(exact)))
            for other in range(dim):
                full = wp.float64(H[axis, other]) + wp.float64(wp.where(axis == other, 1.0, 0.0))
                out.F[axis, other] = real(full)
                out.low_f[axis, other] = real(full - wp.float64(real(full)))
        return out

    @kernel()
    def enter(
        # Parameters:
        constants: Constants,
        # In:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
        low_x: wp.array2d(dtype=vec),
        low_F: wp.array2d(dtype=mat),
        # Out:
        words: wp.array(dtype=wp.int64),
        start: Motion,
    ):
        world, p = wp.tid()
        at = entered(
            constants, x[world, p], v[world, p], C[world, p], F[world, p], low_x[world, p], low_F[world, p]
        )
        start.base[world, p] = at.base
        start.fx[world, p] = at.fx
        start.v[world, p] = v[world, p]
        start.C[world, p] = C[world, p]
        start.H[world, p] = at.H
        if wp.static(rounds):
            start.fx_low[world, p] = at.low
        if not at.valid:
            report(words, world, 0, bad_start, p)

    @kernel()
    def leave(
        # Parameters:
        constants: Constants,
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
        low = vec()
        if wp.static(rounds):
            low = end.fx_low[world, p]
        out = left(constants, end.base[world, p], end.fx[world, p], low, end.H[world, p])
        x[world, p] = out.x
        v[world, p] = end.v[world, p]
        C[world, p] = end.C[world, p]
        F[world, p] = out.F
        if wp.static(rounds):
            low_x[world, p] = out.low_x
            low_F[world, p] = out.low_f

    return SimpleNamespace(Entered=Entered, entered=entered, left=left, enter=enter, leave=leave)
