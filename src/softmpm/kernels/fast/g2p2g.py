"""The fast scheme: G2P and the next P2G in one kernel, particles sorted by cell, sums taken by warps. Derivation: docs/math/scatter.md.

A substep is two launches. With M the momentum and mass of the nodes, and V their velocity:

    p2g_first  particles: (T1) → the first M
    grid      V ← (G1), (G2) of M,  next M ← 0
    g2p2g     particles: V → (T2), (T3) → new state → (T1) → next M

A node without mass retains its previous V. The only particles that read it have zero weight there, or too little to give it mass; V is
initialised to zero, so that they read a finite number.

Where particles do not add to the nodes themselves, a launch between p2g_first or g2p2g and grid adds up their contributions: in a
deterministic model ``push`` of fixed_point.py, on a CPU ``collect`` of slabs.py.

All functions of a single particle or node are shared with the plain scheme: kernels/physics. Adjoint: g2p2g_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_nothing, await_previous
from softmpm.kernels.fast.fixed_point import fixed
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import BLOCK, NATIVE, SizeClass, native
from softmpm.kernels.fast.slabs import slabs
from softmpm.kernels.physics import status
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.particle import particle
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def fused(spec: Spec) -> SimpleNamespace:
    t, one = types(spec.dim, spec.dtype), particle(spec)
    real, vec, mat, node_vec = t.real, t.vec, t.mat, t.aligned
    Constants, Packed, Window, Particle = t.Constants, t.Packed, t.Window, one.Particle
    ParticleInputs, GridInputs = input_types(spec).ParticleInputs, input_types(spec).GridInputs
    s, n, dim = stencil(spec.dim, spec.dtype), native(spec.dim, spec.dtype), spec.dim
    first_node, pack_base, unpack_base = s.first_node, s.pack_base, s.unpack_base
    aligned, head, coordinates = s.aligned, s.head, s.coordinates
    particle_of, world_of = s.particle_of, s.world_of
    load_vec, load_mat, store_vec, store_mat = n.early.vector, n.early.matrix, n.store_vec, n.store_mat
    scatter, load_node, store_node = n.scatter, n.load_node, n.store_node
    rotation, moved = one.rotation, one.moved
    linear_momentum, affine_momentum = one.linear_momentum, one.affine_momentum
    node_velocity, position = grid(spec).node_velocity, grid(spec).position
    running, report_invalid = status.report(spec.dim, spec.dtype).running, status.check(spec).report_invalid
    row_fx, row_low, row_v, row_H, row_C = t.row_fx, t.row_low, t.row_v, t.row_h, t.row_c
    exact, give, not_finite = spec.deterministic, fixed(dim).give, int(Kind.NOT_FINITE)
    take = fixed(dim).take if exact else load_node
    Sums, Shares = (fixed(dim).Sums, fixed(dim).Shares) if exact else 2 * (wp.array(dtype=node_vec),)
    by_slabs, give_to_slabs = spec.slabs, slabs(dim, spec.dtype).give
    if by_slabs:
        Shares = slabs(dim, spec.dtype).Shares
    report = status.report(spec.dim, spec.dtype).report

    @wp.func
    def centre(fx: vec) -> vec:
        """Distance from the middle node of the stencil, given that from the base node, in cells."""
        g = fx
        for axis in range(dim):
            g[axis] = fx[axis] - real(1.0)
        return g

    @wp.func
    def place_of(constants: Constants, window: Window, world: int, i: int) -> types(dim, "float64").vec:
        """Position of node ``i`` of all allocated nodes [m]."""
        return position(constants, coordinates(i - world * window.count, window.shape) + window.origin[world])

    @kernel(NATIVE, grid_stride=False)
    def clear(node: wp.array(dtype=node_vec)):
        """Clear the first M, and V before the first substep."""
        store_node(node, wp.tid(), node_vec())

    @kernel(NATIVE, grid_stride=False)
    def remember(words: wp.array(dtype=wp.int64), before: wp.array(dtype=wp.int64)):
        """Copy the words: which particle a thread takes first must not decide what another one sees of its world."""
        world = wp.tid()
        before[world] = words[world]

    @kernel(NATIVE, grid_stride=False)
    def grid_velocity(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        # In:
        node: Sums,
        # Out:
        velocity: wp.array(dtype=node_vec),
        cleared: wp.array(dtype=node_vec),
    ):
        i = wp.tid()
        world = world_of(i, window.count, velocity.shape[0])
        place = place_of(constants, window, world, i)
        await_previous()
        here = take(node, i)
        if here[dim] > real(0.0):
            v = node_velocity(constants, inputs, world, place, head(here), here[dim])
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
        plane: int,
        first: int,
        g: vec,
        b: vec,
        A: mat,
        m: real,
        node: Shares,
    ):
        """Add (T1) of one particle to its nodes, the first of which is ``first``, at ``plane`` along the first axis of the window. All
        lanes of a warp must call this together."""
        if wp.static(exact):
            if not give(node, place, count, total, b, A):
                report(words, place / count, substep, not_finite, order[place])
        if wp.static(by_slabs):
            give_to_slabs(node, place, plane, b, A)
        if wp.static(not (exact or by_slabs)):
            scatter(node, window.shape, first, g, b, A, m)

    @kernel(NATIVE, grid_stride=False)
    def p2g_first(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
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
        """First P2G of a chunk."""
        place = particle_of(wp.tid(), per_warp, total)
        i = wp.min(place, total - 1)
        world = world_of(i, count, total)
        p = i - world * count
        await_previous()
        H = load_mat(start.rows, i, row_H)
        g = centre(load_vec(start.rows, i, row_fx))
        v = load_vec(start.rows, i, row_v)
        C = load_mat(start.rows, i, row_C)
        m = inputs.mass[world, p]
        A = affine_momentum(constants, inputs, world, p, C, H, rotation(inputs, world, p, H))
        b = linear_momentum(constants, inputs, world, p, v) - A * g
        base = unpack_base(start.base[i])
        origin = window.origin[world]
        first = world * window.count + first_node(base, origin, window.shape)
        if place == total:
            first = -1
        plane = base[0] - origin[0]
        scatter_momentum(words, window, place, count, total, order, 0, plane, first, g, b, A, m, node)

    def of_particles(size_class: SizeClass) -> wp.Kernel:
        """Variant of the kernel for a size class. That for few particles has registers to wait for all loads at once. That for many
        begins when the previous kernel has ended, so that it may load the nodes as read-only memory."""
        many = size_class is SizeClass.MANY
        bounds = {"launch_bounds": (BLOCK, 3)} if size_class is SizeClass.FEW else {}
        wait, gather = (await_nothing, s.gather_constant) if many else (await_previous, s.gather)
        load = n.plain if many else n.early
        base_of, vector, matrix = load.base, load.vector, load.matrix

        @wp.func
        def copy_unchanged(i: int, now: Packed, then: Packed):
            """Copy a particle of a failed world unchanged."""
            then.base[i] = now.base[i]
            store_vec(then.rows, i, row_fx, vector(now.rows, i, row_fx))
            store_vec(then.rows, i, row_low, vector(now.rows, i, row_low))
            store_vec(then.rows, i, row_v, vector(now.rows, i, row_v))
            store_mat(then.rows, i, row_H, matrix(now.rows, i, row_H))
            store_mat(then.rows, i, row_C, matrix(now.rows, i, row_C))

        @kernel(NATIVE, grid_stride=False, **bounds)
        def g2p2g(
            # Parameters:
            constants: Constants,
            inputs: ParticleInputs,
            window: Window,
            substep: int,
            last: bool,  # no P2G afterwards
            per_warp: int,
            count: int,
            total: int,
            order: wp.array(dtype=wp.int32),
            # In:
            before: wp.array(dtype=wp.int64),  # the words before this launch, of a model with slabs
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
            origin = window.origin[world]
            held = world * window.count  # nodes of the worlds before
            old = Particle()
            old.base = unpack_base(base_of(now.base, i))
            old.fx = vector(now.rows, i, row_fx)
            if wp.static(not many):
                old.low = vector(now.rows, i, row_low)
                old.H = matrix(now.rows, i, row_H)
            wait()  # for velocity and words
            if wp.static(by_slabs):
                alive = running(before, world)
            else:
                alive = running(words, world)
            g = centre(old.fx)
            # (T2) by (A3)
            sums = gather(velocity, held + first_node(old.base, origin, window.shape), window.shape, g)
            B = sums.outer - wp.outer(sums.value, g)
            if wp.static(many):
                old.low = vector(now.rows, i, row_low)
                old.H = matrix(now.rows, i, row_H)
            new = moved(constants, inputs, world, p, origin, window.shape, old, sums.value, B)  # (T3)
            base = old.base
            if new.valid:
                base = new.base
            m = inputs.mass[world, p]
            g = centre(new.fx)
            A = affine_momentum(constants, inputs, world, p, new.C, new.H, rotation(inputs, world, p, new.H))
            b = linear_momentum(constants, inputs, world, p, new.v) - A * g
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
                plane = base[0] - origin[0]
                scatter_momentum(
                    words, window, place, count, total, order, substep + 1, plane, first, g, b, A, m, node
                )  # (T1)

        return g2p2g

    return SimpleNamespace(
        clear=clear,
        remember=remember,
        grid_velocity=grid_velocity,
        p2g_first=p2g_first,
        g2p2g={size_class: of_particles(size_class) for size_class in SizeClass},
        centre=centre,
        place_of=place_of,
    )
