"""Failures found on the device, and how they are reported: one 64-bit word per world, see softmpm/watch.py."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.elasticity import elasticity
from softmpm.kernels.turn import once
from softmpm.kernels.types import Spec, solid_types, types
from softmpm.watch import KIND_SHIFT, NEVER, SUBSTEP_SHIFT, Kind


@once
def report(dim: int, dtype: str) -> SimpleNamespace:
    """How a kernel asks whether its world still runs, and how it says that it failed."""

    @wp.func
    def running(watch: wp.array(dtype=wp.int64), world: int) -> bool:
        return watch[world] == wp.int64(NEVER)

    @wp.func
    def write(watch: wp.array(dtype=wp.int64), world: int, substep: int, kind: int, particle: int):
        word = (
            (wp.int64(substep) << wp.int64(SUBSTEP_SHIFT))
            | (wp.int64(kind) << wp.int64(KIND_SHIFT))
            | wp.int64(particle)
        )
        wp.atomic_min(watch, world, word)

    return SimpleNamespace(running=running, report=write)


@once
def check(spec: Spec) -> SimpleNamespace:
    """What must hold of a new state: finite, on the grid, and not inverted where the law forbids it."""
    t = types(spec.dim, spec.dtype)
    real, vec, mat, ivec, Solid = t.real, t.vec, t.mat, t.ivec, solid_types(spec).Solid
    write, volume_change = report(spec.dim, spec.dtype).report, elasticity(spec.dim, spec.dtype).volume_change
    dim, mixed = spec.dim, len(spec.laws) > 1
    hookean = spec.laws.index("neo_hookean") if "neo_hookean" in spec.laws else -1
    not_finite, left_grid, inverted = int(Kind.NOT_FINITE), int(Kind.LEFT_GRID), int(Kind.INVERTED)
    left_window = int(Kind.LEFT_WINDOW)

    @wp.func
    def allowed(body: Solid, world: int, p: int, H: mat) -> bool:
        """H is finite, and det F > 0 where the law needs it; a comparison with NaN is false."""
        if wp.static(not mixed and hookean == 0):
            return volume_change(H) > real(-1.0)
        total = real(0.0)
        for i in range(dim):
            for j in range(dim):
                total += H[i, j]
        if wp.static(mixed):
            if body.law[world, p] == hookean:
                return volume_change(H) > real(-1.0)
        return wp.isfinite(total)

    @wp.func
    def sound(
        body: Solid, corner: ivec, shape: ivec, world: int, p: int, fx: vec, base: ivec, H: mat
    ) -> bool:
        """The new state may be kept: ``fx`` as it came, ``base`` as it would be, on ``shape`` nodes from ``corner``.

        Without a branch: behind one, a GPU would start late to read what the stress needs.
        """
        ok = int(allowed(body, world, p, H)) & int(wp.dot(fx, fx) < real(1.0e12))
        for axis in range(dim):  # unsigned: below zero is far above as well
            ok &= int(wp.uint32(base[axis] - corner[axis]) <= wp.uint32(shape[axis] - 3))
        return ok != 0

    @wp.func
    def complain(
        watch: wp.array(dtype=wp.int64),
        shape: ivec,
        world: int,
        p: int,
        substep: int,
        fx: vec,
        base: ivec,
        H: mat,
    ):
        """Say which rule a state that is not sound breaks; NaN before place before inversion."""
        kind = left_window
        for axis in range(dim):
            if wp.uint32(base[axis]) > wp.uint32(shape[axis] - 3):
                kind = left_grid
        if not wp.isfinite(wp.ddot(H, H) + wp.dot(fx, fx)):
            kind = not_finite
        elif wp.static(hookean >= 0) and volume_change(H) <= real(-1.0):
            kind = inverted
        write(watch, world, substep, kind, p)

    return SimpleNamespace(sound=sound, complain=complain)
