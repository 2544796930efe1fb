"""Particles in the volumes of others that are far from them at rest. Derivation: docs/math/alarms.md.

    |F_q⁻¹ (x_p − x_q)|_∞ ≤ ½ o V_q^(1/dim)   for |X_p − X_q|_∞ > 3 dx                                  (W5)

for all particles q and each p at the surface. A table of cells gives the particles nearby, and says whether any in a cell is far from p
at rest. The first p of a world is reported, whatever the order of the threads.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.lagrangian.cell_table import cell_table
from softmpm.kernels.lagrangian.rest import LAGRANGIAN
from softmpm.kernels.physics import status
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import types


@kernel_factory
def overlap_type(dim: int, dtype: str):
    t = types(dim, dtype)

    class Volumes:
        """See :class:`softmpm.overlap_grid.OverlapGrid`."""

        window: wp.array(dtype=wp.int32)
        corners: wp.array(dtype=wp.int32)
        strides: t.ivec
        fraction: wp.array(dtype=t.vec)
        positions: wp.array(dtype=t.vec)
        half: wp.array(dtype=t.real)
        outer: wp.array(dtype=wp.int32)
        order: wp.array(dtype=wp.int32)
        ticks: wp.array(dtype=t.ivec)
        near: wp.int32
        far: t.real  # [m]
        reach: t.real
        side: t.real

    return wp.struct(Volumes, module=f"softmpm.types.d{dim}.{dtype}")


@kernel_factory
def overlap(dim: int, dtype: str) -> SimpleNamespace:
    t, s = types(dim, dtype), spline(dim, dtype)
    real, vec, mat, ivec, Volumes = t.real, t.vec, t.mat, t.ivec, overlap_type(dim, dtype)
    count, weights, weight, offset, position = s.count, s.weights, s.weight, s.offset, s.position
    identity, kind = kinematics(dim, dtype).identity, int(Kind.OVERLAP)
    cells, ran, report = 2**dim, status.report(dim, dtype).ran, status.report(dim, dtype).report
    table_of = cell_table(dim)
    Table, reset, find = table_of.Table, table_of.clear, table_of.find
    enter, farthest = table_of.enter, table_of.farthest

    @wp.func
    def node_of(bodies: Volumes, p: int, o: ivec) -> int:
        return bodies.window[bodies.corners[p] + wp.dot(bodies.strides, o)]

    @wp.func
    def deformation(bodies: Volumes, u: wp.array2d(dtype=vec), rate: real, world: int, p: int) -> mat:
        """F of (Q1)"""
        fx = bodies.fraction[p]
        w = weights(fx)
        F = identity()
        for n in range(count):
            o = offset(n)
            F += (rate * weight(w, o)) * wp.outer(u[world, node_of(bodies, p, o)], position(o) - fx)
        return F

    @wp.func
    def cell_of(bodies: Volumes, x: vec) -> ivec:
        cell = ivec()
        for axis in range(dim):
            cell[axis] = int(wp.floor(x[axis] / bodies.side))
        return cell

    @wp.func
    def corner(n: int) -> ivec:
        """Cell n of the 2^dim that a box of the width of a cell meets."""
        o = ivec()
        for axis in range(dim):
            o[axis] = (n >> axis) & 1
        return o

    @kernel(LAGRANGIAN)
    def clear(table: Table):
        world, bucket = wp.tid()
        reset(table, world, bucket)

    @kernel(LAGRANGIAN)
    def sort(
        # Parameters:
        bodies: Volumes,
        # In:
        u: wp.array2d(dtype=vec),
        # In and out:
        table: Table,
        # Out:
        x: wp.array2d(dtype=vec),  # present positions without the shift
    ):
        """Enter each particle into the table, but one that is not finite, which another alarm reports."""
        world, p = wp.tid()
        w = weights(bodies.fraction[p])
        here = bodies.positions[p]
        for n in range(count):
            o = offset(n)
            here += weight(w, o) * u[world, node_of(bodies, p, o)]
        x[world, p] = here
        if wp.isfinite(wp.dot(here, here)):
            enter(table, world, cell_of(bodies, here), p, bodies.ticks[p])

    @wp.func
    def inside(
        bodies: Volumes, u: wp.array2d(dtype=vec), rate: real, world: int, p: int, q: int, d: vec
    ) -> bool:
        """(W5), with d from q to p."""
        apart = wp.abs(bodies.positions[p] - bodies.positions[q])
        if wp.max(apart) <= bodies.far:
            return False
        F = deformation(bodies, u, rate, world, q)
        return wp.determinant(F) != real(0.0) and wp.max(wp.abs(wp.inverse(F) * d)) <= bodies.half[q]

    @kernel(LAGRANGIAN)
    def compare(
        # Parameters:
        bodies: Volumes,
        rate: real,  # 4 / dx
        substep: int,
        # In:
        u: wp.array2d(dtype=vec),
        x: wp.array2d(dtype=vec),
        table: Table,
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        world, k = wp.tid()
        p = bodies.outer[k]
        here = x[world, p]
        if not ran(words, world, substep) or not wp.isfinite(wp.dot(here, here)):
            return
        cell = cell_of(bodies, here - vec(bodies.reach))
        # A variable, so that the loop is not unrolled: with those over the nodes inside it took 20 s to compile.
        all_cells = int(cells)
        for n in range(all_cells):
            bucket = find(table, world, cell + corner(n))
            q = int(-1)
            if bucket >= 0:
                if farthest(table, world, bucket, bodies.ticks[p]) > bodies.near:
                    q = table.head[world, bucket]
            while q >= 0:
                if inside(bodies, u, rate, world, p, q, here - x[world, q]):
                    report(words, world, substep, kind, bodies.order[p])
                    return
                q = table.following[world, q]

    return SimpleNamespace(clear=clear, sort=sort, compare=compare)
