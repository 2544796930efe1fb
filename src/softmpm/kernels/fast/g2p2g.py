"""The fast scheme: G2P and the next P2G in one kernel, particles sorted by cell, sums taken by warps. Derivation: docs/math/scatter.md.

A substep is two launches. With M the nodes' momentum and mass, V their velocity:

    p2g_first  particles: (T1) → the first M
    grid      V ← (G1), (G2) of M,  next M ← 0
    g2p2g     particles: V → (T2), (T3) → new state → (T1) → next M

A node without mass keeps the V it has. Only particles read it whose weight there is zero, or too small to give it mass; V starts from
zero, so that they read a number.

A deterministic model adds up in a launch more, ``push`` of fixed_point.py, between p2g_first or g2p2g and grid.

All that is particle- or node-wise is shared with the plain scheme: kernels/physics. Adjoint: g2p2g_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.fast.fixed_point import fixed
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import BLOCK, native, native_module
from softmpm.kernels.physics import status
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.particle import particle
from softmpm.kernels.structs import Spec, solid_types, types


@kernel_factory
def fused(spec: Spec) -> SimpleNamespace:
    t, one = types(spec.dim, spec.dtype), particle(spec)
    real, vec, mat, node_vec = t.real, t.vec, t.mat, t.aligned
    Constants, Packed, Window, Particle = t.Constants, t.Packed, t.Window, one.Particle
    Solid, Walls = solid_types(spec).Solid, solid_types(spec).Walls
    s, n, dim = stencil(spec.dim, spec.dtype), native(spec.dim, spec.dtype), spec.dim
    gather, first_node, pack_base, unpack_base = s.gather, s.first_node, s.pack_base, s.unpack_base
    aligned, head, coordinates = s.aligned, s.head, s.coordinates
    particle_of, world_of = s.particle_of, s.world_of
    load_vec, load_mat, store_vec, store_mat = n.load_vec, n.load_mat, n.store_vec, n.store_mat
    scatter, load_node, store_node = n.scatter, n.load_node, n.store_node
    rotation, affine_momentum, moved = one.rotation, one.affine_momentum, one.moved
    node_velocity = grid(spec).node_velocity
    running, report_invalid = status.report(spec.dim, spec.dtype).running, status.check(spec).report_invalid
    row_fx, row_low, row_v, row_H, row_C = t.row_fx, t.row_low, t.row_v, t.row_h, t.row_c
    exact, give, not_finite = spec.deterministic, fixed(dim).give, int(Kind.NOT_FINITE)
    take = fixed(dim).take if exact else load_node
    Sums, Shares = (fixed(dim).Sums, fixed(dim).Shares) if exact else 2 * (wp.array(dtype=node_vec),)
    report = status.report(spec.dim, spec.dtype).report
    module = native_module(spec.module + ".fused")

    @wp.func
    def centre(fx: vec) -> vec:
        """From the distance to the base node to that from the middle node, in cells."""
        g = fx
        for axis in range(dim):
            g[axis] = fx[axis] - real(1.0)
        return g

    @wp.func
    def place_of(window: Window, i: int, total: int) -> t.ivec:
        """Coordinates on the grid of node ``i`` of all ``total`` in memory."""
        world = world_of(i, window.count, total)
        return coordinates(i - world * window.count, window.shape) + window.origin[world]

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def clear(node: wp.array(dtype=node_vec)):
        """The first M, and V before it."""
        store_node(node, wp.tid(), node_vec())

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def grid_velocity(
        # Parameters:
        constants: Constants,
        walls: Walls,
        window: Window,
        # In:
        node: Sums,
        # Out:
        velocity: wp.array(dtype=node_vec),
        cleared: wp.array(dtype=node_vec),
    ):
        i = wp.tid()
        place = place_of(window, i, velocity.shape[0])  # while the node is on its way
        here = take(node, i)
        if here[dim] > real(0.0):
            v = node_velocity(constants, walls, place, head(here), here[dim])
            store_node(velocity, i, aligned(v, real(0.0)))
        if i < cleared.shape[0]:
            store_node(cleared, i, node_vec())

    @wp.func
    def scatter_momentum(
        words: wp.array(dtype=wp.int64),
        window: Window,
        place: int,
        count: int,
        total: int,
        order: wp.array(dtype=wp.int32),
        substep: int,
        first: int,
        g: vec,
        b: vec,
        A: mat,
        m: real,
        node: Shares,
    ):
        """(T1) of one particle, added to the nodes from ``first`` on. The whole warp comes here together."""
        if wp.static(exact):
            if not give(node, place, count, total, b, A):
                report(words, place / count, substep, not_finite, order[place])
        else:
            scatter(node, window.shape, first, g, b, A, m)

    @wp.func
    def copy_unchanged(i: int, now: Packed, then: Packed):
        """A particle of a world that failed."""
        then.base[i] = now.base[i]
        store_vec(then.rows, i, row_fx, load_vec(now.rows, i, row_fx))
        store_vec(then.rows, i, row_low, load_vec(now.rows, i, row_low))
        store_vec(then.rows, i, row_v, load_vec(now.rows, i, row_v))
        store_mat(then.rows, i, row_H, load_mat(now.rows, i, row_H))
        store_mat(then.rows, i, row_C, load_mat(now.rows, i, row_C))

    def p2g_first(
        # Parameters:
        constants: Constants,
        body: Solid,
        window: Window,
        per_warp: int,  # particles of a warp
        count: int,  # particles of one world
        total: int,  # particles of all worlds
        order: wp.array(dtype=wp.int32),
        # In:
        start: Packed,
        # Out:
        words: wp.array(dtype=wp.int64),
        # Out, added into:
        node: Shares,
    ):
        """The first P2G of a chunk."""
        place = particle_of(wp.tid(), per_warp, total)
        i = wp.min(place, total - 1)
        world = world_of(i, count, total)
        p = i - world * count
        H = load_mat(start.rows, i, row_H)
        g = centre(load_vec(start.rows, i, row_fx))
        v = load_vec(start.rows, i, row_v)
        C = load_mat(start.rows, i, row_C)
        m = body.mass[world, p]
        A = affine_momentum(constants, body, world, p, C, H, rotation(body, world, p, H))
        first = world * window.count + first_node(
            unpack_base(start.base[i]), window.origin[world], window.shape
        )
        if place == total:
            first = -1
        scatter_momentum(words, window, place, count, total, order, 0, first, g, m * v - A * g, A, m, node)

    def g2p2g(
        # Parameters:
        constants: Constants,
        body: Solid,
        window: Window,
        substep: int,
        last: bool,  # no P2G afterwards
        per_warp: int,
        count: int,
        total: int,
        order: wp.array(dtype=wp.int32),
        # In:
        velocity: wp.array(dtype=node_vec),
        now: Packed,
        # Out:
        words: wp.array(dtype=wp.int64),
        then: Packed,
        # Out, added into:
        node: Shares,
    ):
        # Idle lanes recompute the last particle and skip the stores, which avoids a divergent branch.
        place = particle_of(wp.tid(), per_warp, total)
        i = wp.min(place, total - 1)
        world = world_of(i, count, total)
        p = i - world * count
        alive = running(words, world)
        origin = window.origin[world]
        held = world * window.count  # nodes of the worlds before
        old = Particle()
        old.base = unpack_base(now.base[i])
        old.fx = load_vec(now.rows, i, row_fx)
        g = centre(old.fx)
        # (T2) by (A3)
        sums = gather(velocity, held + first_node(old.base, origin, window.shape), window.shape, g)
        B = sums.outer - wp.outer(sums.value, g)
        old.low = load_vec(now.rows, i, row_low)
        old.H = load_mat(now.rows, i, row_H)
        new = moved(constants, origin, window.shape, old, sums.value, B)  # (T3)
        base = old.base
        if new.valid:
            base = new.base
        m = body.mass[world, p]
        g = centre(new.fx)
        A = affine_momentum(constants, body, world, p, new.C, new.H, rotation(body, world, p, new.H))
        b = m * new.v - A * g
        first = held + first_node(base, origin, window.shape)
        if place == total:
            first = -1
        # Nothing is stored before everything is loaded: the compiler cannot know that they are apart.
        if place < total:
            if alive:
                then.base[i] = pack_base(base)
                store_vec(then.rows, i, row_fx, new.fx)
                store_vec(then.rows, i, row_low, new.low)
                store_vec(then.rows, i, row_v, new.v)
                store_mat(then.rows, i, row_H, new.H)
                store_mat(then.rows, i, row_C, new.C)
                if not new.valid:
                    report_invalid(words, constants, world, order[i], substep, new.fx, new.base, new.H)
            else:
                copy_unchanged(i, now, then)
        if not last:
            scatter_momentum(
                words, window, place, count, total, order, substep + 1, first, g, b, A, m, node
            )  # (T1)

    def by_number(kernel, bounds_of_few=None) -> dict[bool, wp.Kernel]:
        """It goes over particles: many, or few, where a warp may have the registers to wait for all that it reads at once."""
        few = native_module(spec.module + ".fused.few")
        options = dict(enable_backward=False, grid_stride=False)
        return {
            False: wp.kernel(**options, module=module)(kernel),
            True: wp.kernel(**options, module=few, launch_bounds=bounds_of_few)(kernel),
        }

    return SimpleNamespace(
        clear=clear,
        grid_velocity=grid_velocity,
        p2g_first=by_number(p2g_first),
        g2p2g=by_number(g2p2g, (BLOCK, 3)),
        centre=centre,
        place_of=place_of,
    )
