"""Contact of the surface points of bodies with separating walls, in one pass. Derivation: docs/math/contact.md.

    D_s = Σ |w_si| L_i / m_i                                                                         (K1)
    x_s = X_s + shift + Σ w_si u_i,  v_s = Σ w_si v*_i                                               (K2)
    wall by wall: the anchor goes along by (K6), J by (K3), (K4), then v_s += D_s J
    f_s += A_s J / T, the mean force of a wall on a point in a control step of T                     (K7)
    v'_i = v*_i + Σ w_si A_s J / m_i,  u'_i = u_i + Δt v'_i                                          (K5)

Only the height over a wall sees the shift; anchors move with the frame. The adjoint is in surface_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.portions import end_of, first_of
from softmpm.kernels.lagrangian.rest import LAGRANGIAN, rest
from softmpm.kernels.lagrangian.rows import rows
from softmpm.kernels.lagrangian.surface_sums import surface_sums, surface_type
from softmpm.kernels.physics import status
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face, wall_faces
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def surface(spec: Spec) -> SimpleNamespace:
    t, r, walls = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), wall_faces(spec)
    real, vec, Constants, dim = t.real, t.vec, t.Constants, spec.dim
    exact_vec = types(dim, "float64").vec
    GridInputs = input_types(spec).GridInputs
    Surface = surface_type(dim, spec.dtype)
    faces_of, meet, count, number, vecs = walls.faces_of, walls.meet, walls.count, walls.number, walls.vecs
    across, depth = surface_contact(dim, spec.dtype).across, wall_face(spec).depth
    in_wall, f = int(Kind.IN_WALL), frame(dim, spec.dtype)
    Frame, recentring, memory = f.Frame, f.recentring, chunk(dim, spec.dtype)
    Chunk, state_of, u_of, moved = memory.Chunk, memory.state_of, memory.u_of, memory.moved
    running, was_running, report = (
        getattr(status.report(dim, spec.dtype), name) for name in ("running", "was_running", "report")
    )
    sums = surface_sums(dim, spec.dtype)
    Point, point_of, at_point, present = sums.Point, sums.point_of, sums.at_point, sums.present
    Touched, touched_of, from_points = sums.Touched, sums.touched_of, sums.from_points
    row = rows(dim, spec.dtype)

    @kernel(LAGRANGIAN)
    def delassus(body: Surface, mass: wp.array2d(dtype=real), D: wp.array2d(dtype=real)):
        """(K1)"""
        world, p = wp.tid()
        total = real(0.0)
        for n in range(r.count):
            i = body.stencil[n, p]
            if body.weights[n, p] != real(0.0):
                total += wp.abs(body.weights[n, p]) * body.loads[i] / mass[world, i]
        D[world, p] = total

    @wp.func
    def press_at(
        world: int,
        p: int,
        point: Point,
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
        u = row(at.u, u_of(at, s), world)
        anchor = at.anchor[now]
        middle = u[moving.middle]  # all of it loaded while the status is awaited
        x = present(point, at_point(body, p, point, u))
        v = at_point(body, p, point, row(at.free, world))
        dv = row(at.D, world)[p]
        per_force = at.rate[0] * point.newtons
        after = vecs()
        pushed = vecs()
        for q in range(count):
            after[q] = row(anchor, world, q)[p]
            if anew == 0:
                pushed[q] = row(at.force, world, q)[p]
        wall = faces_of(constants, inputs, world, x + at.shift[now, world], after)
        total = vec()
        last = wp.max(s - 1, 0)
        deep = int(-1)
        if was_running(at.words, world, last, in_wall):
            d = recentring(moving, middle)
            for q in range(count):
                if wall.depth[q] > point.deepest:
                    deep = q
                found = meet(constants, wall, q, point.stiffness, body.width, vec(x), v, dv)
                after[q] = found.anchor - across(wall.n[q], d)
                total += found.J
                v += dv * found.J
                pushed[q] = pushed[q] + per_force * found.J
            for q in range(count):
                row(at.force, world, q)[p] = pushed[q]
        for q in range(count):
            row(at.anchor, then, world, q)[p] = after[q]
        row(at.impulse, world)[p] = point.area * total
        if deep >= 0:
            report(at.words, world, last, in_wall, deep * body.points.shape[0] + p)

    @wp.func
    def settle_at(
        world: int,
        lane: int,
        node: Touched,
        constants: Constants,
        body: Surface,
        moving: Frame,
        at: Chunk,
        s: int,
    ):
        """(K5), at the nodes that surface points act on."""
        now = state_of(at, s)
        then = state_of(at, s + 1)
        i = node.i
        u = row(at.u, u_of(at, s), world)
        lows = row(at.low, world, 0)
        here = u[i]
        low = lows[i]
        new = row(at.free, world)[i]  # all of it loaded while the status is awaited
        m = row(at.mass, world)[i]
        old = row(at.v, now, world)[i]
        middle = u[moving.middle]
        push = from_points(body, node, row(at.impulse, world))
        if running(at.words, world):
            if node.last > node.first - lane:
                new += (real(1.0) / m) * push
            here, low = moved(here, recentring(moving, middle), constants.dt, new, low)
        else:
            new = old
        if lane == 0:
            row(at.u, u_of(at, s + 1), world)[i] = here
            lows[i] = low
            row(at.v, then, world)[i] = new

    @kernel(LAGRANGIAN)
    def press(
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        moving: Frame,
        at: Chunk,
        s: int,
        anew: int,
    ):
        world, k = wp.tid()
        for p in range(first_of(k), end_of(k, body.points.shape[0])):
            point = point_of(body, p)
            await_previous()  # the velocity without contact
            press_at(world, p, point, constants, inputs, body, moving, at, s, anew)

    @kernel(LAGRANGIAN)
    def settle(constants: Constants, body: Surface, moving: Frame, at: Chunk, s: int):
        world, k, lane = wp.tid()
        for n in range(first_of(k), end_of(k, body.nodes.shape[0])):
            entry = touched_of(body, n, lane)
            await_previous()  # the impulses
            settle_at(world, lane, entry, constants, body, moving, at, s)

    @kernel(LAGRANGIAN)
    def check_depth(
        # Parameters:
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
        point = point_of(body, p)
        x = present(point, at_point(body, p, point, row(u, world))) + shift[world]
        for q in range(count):
            if depth(inputs, world, number[q], later, x) > point.deepest:
                report(words, world, substep, in_wall, q * body.points.shape[0] + p)

    return SimpleNamespace(
        delassus=delassus,
        press=press,
        settle=settle,
        press_at=press_at,
        settle_at=settle_at,
        check_depth=check_depth,
    )
