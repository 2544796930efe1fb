"""Contact of the surface points of bodies with separating walls, in one pass. Derivation: docs/math/contact.md.

    D_s = Σ |w_si| L_i / m_i                                                                         (K1)
    x_s = X_s + shift + Σ w_si u_i,  v_s = Σ w_si v*_i                                               (K2)
    wall by wall: the anchor goes along by (K6), J by (K3), (K4), then v_s += D_s J
    f_s += A_s J / T, the mean force of a wall on a point in a control step of T                     (K7)
    v'_i = v*_i + Σ w_si A_s J / m_i,  u'_i = u_i + Δt v'_i                                          (K5)

Nodes gather what the points give them in a fixed order; on a GPU the threads of a node share this work. Only the height over a wall
sees the shift; anchors move with the frame. The adjoint is in surface_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.rest import lagrangian_module, rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face
from softmpm.kernels.structs import Spec, input_types, types

LANES = {2: 8, 3: 32}
"""Threads of a node on a GPU; the CPU has one."""
BATCH = 4
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
        stencil: wp.array2d(dtype=wp.int32)
        weights: wp.array2d(dtype=t.real)
        nodes: wp.array(dtype=wp.int32)
        first: wp.array(dtype=wp.int32)
        members: wp.array(dtype=wp.int32)
        shares: wp.array(dtype=t.real)

    return wp.struct(Surface, module=f"softmpm.types.d{dim}.{dtype}")


@kernel_factory
def surface(spec: Spec) -> SimpleNamespace:
    t, r, block = (
        types(spec.dim, spec.dtype),
        rest(spec.dim, spec.dtype),
        surface_contact(spec.dim, spec.dtype),
    )
    real, vec, Constants, dim = t.real, t.vec, t.Constants, spec.dim
    exact_vec, GridInputs, Surface = (
        types(dim, "float64").vec,
        input_types(spec).GridInputs,
        surface_type(dim, spec.dtype),
    )
    walls = spec.surface_walls
    number = wp.types.vector(len(walls), wp.int32)(*walls)  # of each separating wall among all walls
    count, friction_of = len(walls), wall_face(spec).friction_of
    touch, across, in_wall, f = block.touch, block.across, int(Kind.IN_WALL), frame(dim, spec.dtype)
    Frame, recentring, exact_of, memory = f.Frame, f.recentring, f.exact, chunk(dim, spec.dtype)
    Chunk, state_of = memory.Chunk, memory.state_of
    face, depth = wall_face(spec).face, wall_face(spec).depth
    running, was_running, report = (
        getattr(status.report(dim, spec.dtype), name) for name in ("running", "was_running", "report")
    )
    vecs, reals = wp.types.matrix((count, dim), real), wp.types.vector(count, real)
    module = lagrangian_module(spec.module + ".lagrangian")

    @wp.struct
    class Faces:
        n: vecs
        y: reals
        depth: reals
        anchor: vecs
        friction: reals

    @wp.func
    def faces_of(
        constants: Constants,
        inputs: GridInputs,
        anchor: wp.array3d(dtype=vec),
        world: int,
        p: int,
        x: exact_vec,
    ) -> Faces:
        """The walls as a point meets them. All are read before the first acts, so that they wait for memory together."""
        out = Faces()
        for q in range(count):
            k = number[q]
            wall = face(constants, inputs, world, k, x, anchor[world, q, p])
            out.n[q] = wall.n
            out.y[q] = wall.y
            out.depth[q] = wall.depth
            out.anchor[q] = wall.anchor
            out.friction[q] = friction_of(inputs, world, k)
        return out

    @wp.func
    def at_point(body: Surface, nodal: wp.array2d(dtype=vec), world: int, p: int) -> vec:
        """Σ w a of a nodal field."""
        total = vec()
        for n in range(r.count):
            total += body.weights[p, n] * nodal[world, body.stencil[p, n]]
        return total

    @wp.func_native(TOGETHER.format(lanes=LANES[dim], dim=dim))
    def together(value: vec) -> vec:
        """Sum over the threads of a node, for all of them."""

    @wp.func
    def from_points(body: Surface, values: wp.array2d(dtype=vec), world: int, n: int, lane: int) -> vec:
        """Σ w a of a field of the surface points, at node ``n`` of those they act on, in a fixed order."""
        last = body.first[n + 1]
        total = vec()
        for m in range(body.first[n] + lane, last, BATCH * body.lanes):
            for k in range(BATCH):  # several that wait for memory together
                entry = wp.min(m + k * body.lanes, last - 1)
                share = body.shares[entry] * values[world, body.members[entry]]
                if m + k * body.lanes < last:
                    total += share
        return together(total)

    @wp.func
    def present(body: Surface, p: int, u: vec) -> exact_vec:
        """x of (K2) without the shift."""
        return body.points[p] + exact_of(u)

    @wp.kernel(module=module, enable_backward=False)
    def delassus(body: Surface, mass: wp.array2d(dtype=real), D: wp.array2d(dtype=real)):
        """(K1)"""
        world, p = wp.tid()
        total = real(0.0)
        for n in range(r.count):
            i = body.stencil[p, n]
            if body.weights[p, n] != real(0.0):
                total += wp.abs(body.weights[p, n]) * body.loads[i] / mass[world, i]
        D[world, p] = total

    @wp.func
    def press_at(
        world: int,
        p: int,
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        moving: Frame,
        at: Chunk,
        s: int,
        anew: int,  # 1 if a control step begins
    ):
        """(K2) to (K4), (K6), (K7): impulse A J of each point."""
        now = state_of(at, s)
        then = state_of(at, s + 1)
        u = at.u[now]
        anchor = at.anchor[now]
        middle = u[world, moving.middle]  # all of it loaded while the status is awaited
        x = present(body, p, at_point(body, u, world, p))
        v = at_point(body, at.free, world, p)
        dv = at.D[world, p]
        stiffness = body.stiffness[p]
        per_force = at.rate[0] * body.newtons[p]
        wall = faces_of(constants, inputs, anchor, world, p, x + at.shift[now, world])
        after = vecs()
        pushed = vecs()
        for q in range(count):
            after[q] = anchor[world, q, p]
            if anew == 0:
                pushed[q] = at.force[world, q, p]
        deepest = body.deepest[p]
        area = body.areas[p]
        total = vec()
        last = wp.max(s - 1, 0)
        deep = int(-1)
        if was_running(at.words, world, last, in_wall):
            d = recentring(moving, middle)
            for q in range(count):
                if wall.depth[q] > deepest:
                    deep = q
                found = touch(
                    wall.n[q],
                    wall.y[q],
                    vec(x),
                    v,
                    wall.anchor[q],
                    dv,
                    wall.friction[q],
                    stiffness,
                    constants.dt,
                    body.width,
                    constants.spacing,
                )
                after[q] = found.anchor - across(wall.n[q], d)
                total += found.J
                v += dv * found.J
                pushed[q] = pushed[q] + per_force * found.J
            for q in range(count):
                at.force[world, q, p] = pushed[q]
        for q in range(count):
            at.anchor[then, world, q, p] = after[q]
        at.impulse[world, p] = area * total
        if deep >= 0:
            report(at.words, world, last, in_wall, deep * body.points.shape[0] + p)

    @wp.func
    def settle_at(
        world: int,
        n: int,
        lane: int,
        constants: Constants,
        body: Surface,
        moving: Frame,
        at: Chunk,
        s: int,
    ):
        """(K5), at the nodes that surface points act on."""
        now = state_of(at, s)
        then = state_of(at, s + 1)
        i = body.nodes[n]
        here = at.u[now, world, i]
        new = at.free[world, i]  # loaded while the status is awaited
        middle = at.u[now, world, moving.middle]
        push = from_points(body, at.impulse, world, n, lane)
        if running(at.words, world):
            if body.first[n + 1] > body.first[n]:
                new += push / at.mass[world, i]
            here = (here - recentring(moving, middle)) + constants.dt * new
        else:
            new = at.v[now, world, i]
        if lane == 0:
            at.u[then, world, i] = here
            at.v[then, world, i] = new

    @wp.kernel(module=module, enable_backward=False)
    def press(
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        moving: Frame,
        at: Chunk,
        s: int,
        anew: int,
    ):
        world, p = wp.tid()
        press_at(world, p, constants, inputs, body, moving, at, s, anew)

    @wp.kernel(module=module, enable_backward=False)
    def settle(constants: Constants, body: Surface, moving: Frame, at: Chunk, s: int):
        world, n, lane = wp.tid()
        settle_at(world, n, lane, constants, body, moving, at, s)

    @wp.kernel(module=module, enable_backward=False)
    def check_depth(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        later: wp.float64,  # than the inputs [s]
        substep: int,
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check a state that no contact is computed of: the final one of a chunk, or the initial one of a call."""
        world, p = wp.tid()
        x = present(body, p, at_point(body, u, world, p)) + shift[world]
        for q in range(count):
            if depth(inputs, world, number[q], later, x) > body.deepest[p]:
                report(words, world, substep, in_wall, q * body.points.shape[0] + p)

    return SimpleNamespace(
        delassus=delassus,
        press=press,
        settle=settle,
        press_at=press_at,
        settle_at=settle_at,
        check_depth=check_depth,
        faces_of=faces_of,
        vecs=vecs,
        at_point=at_point,
        from_points=from_points,
        present=present,
        number=number,
    )
