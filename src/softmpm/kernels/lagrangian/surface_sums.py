"""Interpolation between the nodes and the surface points of bodies.

    x_s = X_s + shift + Σ w_si u_i,  v_s = Σ w_si v*_i                                               (K2)

and sums of a field of the points at a node, in a fixed order; on a GPU the threads of a node share this work. What is the same in every
substep is read into a struct, which a thread of a GPU may keep; the CPU reads it where it is, entry by entry (rows.h).
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.portions import ON_A_GPU
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.structs import types

LANES = 8
"""Threads of a node on a GPU; the CPU has one."""
BATCH = 2
"""Entries that a thread reads at once."""
TOGETHER = """
    auto total = value;
#if defined(__CUDA_ARCH__)
    for (int other = {lanes} / 2; other > 0; other /= 2)
        for (unsigned axis = 0; axis < {dim}; ++axis)
            total.c[axis] += __shfl_xor_sync(0xffffffffu, total.c[axis], other);
#endif
    return total;
"""

SUM_ON_CPU = ON_A_GPU.format(gpu="{}", cpu="softmpm::sum_of_entries(members, shares, first, last, values)")


@kernel_factory
def surface_type(dim: int, dtype: str):
    t, exact_vec = types(dim, dtype), types(dim, "float64").vec

    class Surface:
        """See :class:`softmpm.surface_grid.SurfaceGrid`."""

        points: wp.array(dtype=exact_vec)
        areas: wp.array(dtype=t.real)
        newtons: wp.array(dtype=t.real)  # areas in the units of force
        width: t.real  # over which contact sets in
        lanes: int  # threads of a node
        deepest: wp.array(dtype=t.real)
        stiffness: wp.array(dtype=t.real)  # in units of the heaviest particle's mass
        loads: wp.array(dtype=t.real)
        # (node, point), so that neighbouring threads of a GPU read neighbouring numbers; on a CPU those of a point are neighbours:
        stencil: wp.array2d(dtype=wp.int32)
        weights: wp.array2d(dtype=t.real)
        nodes: wp.array(dtype=wp.int32)
        first: wp.array(dtype=wp.int32)
        members: wp.array(dtype=wp.int32)
        shares: wp.array(dtype=t.real)

    return wp.struct(Surface, module=f"softmpm.types.d{dim}.{dtype}")


@kernel_factory
def surface_sums(dim: int, dtype: str) -> SimpleNamespace:
    t, count = types(dim, dtype), rest(dim, dtype).count
    real, vec, exact_vec, Surface = t.real, t.vec, types(dim, "float64").vec, surface_type(dim, dtype)
    exact_of = frame(dim, dtype).exact
    numbers, shares = wp.types.vector(count, wp.int32), wp.types.vector(count, real)
    few, few_shares = wp.types.vector(BATCH, wp.int32), wp.types.vector(BATCH, real)

    @wp.struct
    class Point:
        """Data of a point that are the same in every substep of a chunk."""

        rest: exact_vec  # its place at rest [m]
        stencil: numbers
        weights: shares
        area: real
        newtons: real
        stiffness: real
        deepest: real

    @wp.func
    def point_of(body: Surface, p: int) -> Point:
        out = Point()
        for n in range(count):
            out.stencil[n] = body.stencil[n, p]
            out.weights[n] = body.weights[n, p]
        out.rest = body.points[p]
        out.area = body.areas[p]
        out.newtons = body.newtons[p]
        out.stiffness = body.stiffness[p]
        out.deepest = body.deepest[p]
        return out

    @wp.func_native(ON_A_GPU.format(gpu="false", cpu="true"))
    def on_cpu() -> bool: ...

    @wp.func_native(SUM_ON_CPU)
    def sum_on_cpu(
        members: wp.array(dtype=wp.int32),
        shares: wp.array(dtype=real),
        first: int,
        last: int,
        values: wp.array(dtype=vec),
    ) -> vec: ...

    @wp.func_native(SUM_ON_CPU)
    def sum_on_cpu(
        members: wp.array2d(dtype=wp.int32),
        shares: wp.array2d(dtype=real),
        first: int,
        last: int,
        values: wp.array(dtype=vec),
    ) -> vec: ...

    @wp.func
    def at_point(body: Surface, p: int, point: Point, nodal: wp.array(dtype=vec)) -> vec:
        """Σ w a of a nodal field of a world."""
        if on_cpu():
            return sum_on_cpu(body.stencil, body.weights, count * p, count * (p + 1), nodal)
        total = vec()
        for n in range(count):
            total += point.weights[n] * nodal[point.stencil[n]]
        return total

    @wp.func_native(TOGETHER.format(lanes=LANES, dim=dim))
    def together(value: vec) -> vec:
        """Sum over the threads of a node, for all of them."""

    @wp.struct
    class Entries:
        """Points that act on a node, and their weights; 0 for those that do not count."""

        members: few
        shares: few_shares

    @wp.struct
    class Touched:
        """A node that points act on, as one of its threads sees it."""

        i: int
        first: int  # of its own entries
        last: int
        entries: Entries  # the first of them

    @wp.func
    def entries_of(body: Surface, first: int, last: int) -> Entries:
        out = Entries()
        for k in range(BATCH):
            entry = first + k * body.lanes
            some = wp.max(wp.min(entry, last - 1), 0)
            out.members[k] = body.members[some]
            out.shares[k] = wp.where(entry < last, body.shares[some], real(0.0))
        return out

    @wp.func
    def touched_of(body: Surface, n: int, lane: int) -> Touched:
        out = Touched()
        out.i = body.nodes[n]
        out.first = body.first[n] + lane
        out.last = body.first[n + 1]
        out.entries = entries_of(body, out.first, out.last)
        return out

    @wp.func
    def partly(entries: Entries, values: wp.array(dtype=vec)) -> vec:
        """Sum over a few points, whose values wait for memory together."""
        total = vec()
        for k in range(BATCH):
            value = values[entries.members[k]]
            total += wp.where(entries.shares[k] != real(0.0), entries.shares[k] * value, vec())
        return total

    @wp.func
    def from_points(body: Surface, node: Touched, values: wp.array(dtype=vec)) -> vec:
        """Σ w a of a field of the surface points of a world, at a node that they act on, in a fixed order."""
        if on_cpu():
            return sum_on_cpu(body.members, body.shares, node.first, node.last, values)
        total = partly(node.entries, values)
        for m in range(node.first + BATCH * body.lanes, node.last, BATCH * body.lanes):
            total += partly(entries_of(body, m, node.last), values)
        return together(total)

    @wp.func
    def both_from_points(body: Surface, node: Touched, a: wp.array(dtype=vec), b: wp.array(dtype=vec)):
        """``from_points`` of two fields; entries are read once."""
        if on_cpu():
            return from_points(body, node, a), from_points(body, node, b)
        total_a = partly(node.entries, a)
        total_b = partly(node.entries, b)
        for m in range(node.first + BATCH * body.lanes, node.last, BATCH * body.lanes):
            entries = entries_of(body, m, node.last)
            total_a += partly(entries, a)
            total_b += partly(entries, b)
        return together(total_a), together(total_b)

    @wp.func
    def present(point: Point, u: vec) -> exact_vec:
        """x of (K2) without the shift."""
        return point.rest + exact_of(u)

    return SimpleNamespace(
        Point=Point,
        point_of=point_of,
        at_point=at_point,
        present=present,
        Touched=Touched,
        touched_of=touched_of,
        from_points=from_points,
        both_from_points=both_from_points,
    )
