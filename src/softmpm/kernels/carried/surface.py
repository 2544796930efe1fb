"""Contact of surface points with separating walls on the moving grid. Derivation: docs/math/contact.md.

    W_si of (K8), L_i = Σ |W_si| A_s,  D_s = Σ |W_si| L_i / m_i,  v_s = Σ W_si v*_i                  (K9)
    wall by wall: the anchor goes along by (K6), J by (K3), (K4), then v_s += D_s J
    f_s += A_s J / T, the mean force of a wall on a point in a control step of T                     (K7)
    v'_i = v*_i + (1/m_i) Σ W_si A_s J                                                               (K10)

``add_loads`` is L, ``press`` the rest; on a CPU (K10) is left to ``push_all``. A point further than a cell from all walls reads no
nodes there. Otherwise its lanes (physics/lanes.py) share its nodes, and the first lane writes what is the point's own. Nodes are
those of a window, the whole grid in the plain scheme; their arrays may have strides, since the fast scheme has several quantities
in one. v* and v' are two arrays: points read the one while others add to the other. The adjoint is in surface_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.carried.point import options_of, outline_type, surface_point
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.physics import status
from softmpm.kernels.physics.lanes import lane_sum, meet_lanes
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.physics.wall_face import wall_face, wall_faces
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def surface(spec: Spec, packed: bool) -> SimpleNamespace:
    """Kernels on particles that are ``packed`` as in the fast scheme, or not."""
    dim, t, s = spec.dim, types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype)
    real, vec, node_vec, Constants, Window = t.real, t.vec, t.node, t.Constants, t.Window
    GridInputs, Outline = input_types(spec).GridInputs, outline_type(dim, spec.dtype)
    point, walls, depth = surface_point(dim, spec.dtype, packed), wall_faces(spec), wall_face(spec).depth
    Particles, point_of, share = point.Particles, point.point_of, point.share
    load_state = point.load_state
    Point, offset, node_index, size = point.Point, s.offset, s.node_index, s.count
    vD, summed = wp.types.vector(dim + 1, real), lane_sum(dim + 1, real)
    faces_of, meet, count, number, vecs = walls.faces_of, walls.meet, walls.count, walls.number, walls.vecs
    running, report = status.report(dim, spec.dtype).running, status.report(dim, spec.dtype).report
    in_wall, apart = int(Kind.IN_WALL), packed and spec.slabs

    @wp.func
    def add_share(window: Window, at: Point, n: int, area: real, world: int, load: wp.array2d(dtype=real)):
        i = node_index(at.base, offset(n), window.shape)
        wp.atomic_add(load, world, i, area * wp.abs(share(at, n)))

    @wp.func
    def add_load(
        window: Window,
        outline: Outline,
        at: Point,
        world: int,
        p: int,
        lane: int,
        load: wp.array2d(dtype=real),
    ):
        """The lane's part of L (K9)"""
        area = outline.areas[p]
        if wp.static(apart):  # one lane; in an unrolled loop the weights along an axis are computed once
            for n in range(size):
                add_share(window, at, n, area, world, load)
        else:
            for n in range(lane, size, outline.lanes):
                add_share(window, at, n, area, world, load)

    @wp.func
    def push(
        window: Window,
        at: Point,
        impulse: vec,
        world: int,
        lane: int,
        lanes: int,
        node: wp.array2d(dtype=node_vec),
        velocity: wp.array2d(dtype=vec),
    ):
        """The lane's part of (K10)"""
        for n in range(lane, size, lanes):
            i = node_index(at.base, offset(n), window.shape)
            m = node[world, i][dim]
            if m > real(0.0):
                wp.atomic_add(velocity, world, i, (share(at, n) / m) * impulse)

    @kernel(options_of(packed))
    def add_loads(
        # Parameters:
        constants: Constants,
        window: Window,
        outline: Outline,
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        # Out, added into:
        load: wp.array2d(dtype=real),
    ):
        world, p, lane = wp.tid()
        at = point_of(constants, window, outline, now, world, p, owner[world, p])
        add_load(window, outline, at, world, p, lane, load)

    @kernel(options_of(packed), grid_stride=False)
    def press(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        outline: Outline,
        smoothing: real,
        substep: int,
        rate: wp.array(dtype=real),  # 1/T
        anew: int,  # 1 at the beginning of a control step
        owner: wp.array2d(dtype=wp.int32),
        # In:
        words_before: wp.array(dtype=wp.int64),  # this launch, or the words themselves
        now: Particles,
        anchor: wp.array3d(dtype=vec),
        node: wp.array2d(dtype=node_vec),
        free: wp.array2d(dtype=vec),  # v*
        load: wp.array2d(dtype=real),
        # In and out:
        words: wp.array(dtype=wp.int64),
        force: wp.array3d(dtype=vec),
        # Out:
        new_anchor: wp.array3d(dtype=vec),
        impulse: wp.array2d(dtype=vec),  # A J of all walls
        # Out, added into:
        velocity: wp.array2d(dtype=vec),  # v', or left to ``push_all``
    ):
        world, p, lane = wp.tid()
        before = vecs()
        pushed = vecs()
        for q in range(count):
            before[q] = load_state(anchor, world, q, p)
            if anew == 0:
                pushed[q] = load_state(force, world, q, p)
        at = point_of(constants, window, outline, now, world, p, owner[world, p])
        wall = faces_of(constants, inputs, world, at.x, before)
        stiffness = outline.stiffness[p]
        area = outline.areas[p]
        deepest = outline.deepest[p]
        per_force = rate[0] * outline.newtons[p]
        found = vD()
        await_previous()  # free and load
        alive = running(words_before, world)
        if wall.near == 1:
            for n in range(lane, size, outline.lanes):
                i = node_index(at.base, offset(n), window.shape)
                m = node[world, i][dim]
                v_i = free[world, i]
                L_i = load[world, i]
                b = share(at, n)
                for axis in range(dim):
                    found[axis] = found[axis] + b * v_i[axis]
                if m > real(0.0):
                    found[dim] = found[dim] + wp.abs(b) * L_i / m
            found = summed(found, outline.lanes)
        meet_lanes(outline.lanes)
        v = vec()
        for axis in range(dim):
            v[axis] = found[axis]
        after = vecs()
        total = vec()
        deep = int(-1)
        for q in range(count):
            met = meet(constants, wall, q, stiffness, smoothing, vec(at.x), v, found[dim])
            total += met.J
            v += found[dim] * met.J
            after[q] = met.anchor
            pushed[q] = pushed[q] + per_force * met.J
            if deep < 0 and wall.depth[q] > deepest:
                deep = q
        pushing = vec()
        if alive:
            pushing = area * total
            if wp.static(not apart):
                if wp.dot(total, total) != real(0.0):  # not finite too
                    push(window, at, pushing, world, lane, outline.lanes, node, velocity)
        if lane == 0:
            impulse[world, p] = pushing
            for q in range(count):
                if alive:
                    new_anchor[world, q, p] = after[q]
                    force[world, q, p] = pushed[q]
                else:
                    new_anchor[world, q, p] = before[q]
            if alive and deep >= 0:
                report(words, world, wp.max(substep - 1, 0), in_wall, deep * owner.shape[1] + p)

    @kernel(options_of(packed))
    def push_all(
        # Parameters:
        constants: Constants,
        window: Window,
        outline: Outline,
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        impulse: wp.array2d(dtype=vec),
        node: wp.array2d(dtype=node_vec),
        # Out, added into:
        velocity: wp.array2d(dtype=vec),  # v'
    ):
        """(K10) where ``press`` leaves it out: on the CPU, whose threads must not add to the same node."""
        world, p, lane = wp.tid()
        J = impulse[world, p]
        if wp.dot(J, J) != real(0.0):
            at = point_of(constants, window, outline, now, world, p, owner[world, p])
            push(window, at, J, world, lane, outline.lanes, node, velocity)

    @kernel(options_of(packed))
    def check_end(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        outline: Outline,
        later: wp.float64,  # than the inputs [s]
        substep: int,
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check the depth of the points in the final state of a chunk, with the inputs of its last substep."""
        world, p = wp.tid()
        at = point_of(constants, window, outline, now, world, p, owner[world, p])
        for q in range(count):
            if depth(inputs, world, number[q], later, at.x) > outline.deepest[p]:
                report(words, world, substep, in_wall, q * owner.shape[1] + p)

    return SimpleNamespace(
        add_loads=add_loads,
        press=press,
        push_all=push_all,
        check_end=check_end,
        add_load=add_load,
        apart=apart,
        push=push,
    )


@kernel_factory
def start_depth(spec: Spec) -> wp.Kernel:
    """Kernel that checks the depth of the points in the initial state of a call."""
    t, exact_vec = types(spec.dim, spec.dtype), types(spec.dim, "float64").vec
    dim, vec, mat, Outline = spec.dim, t.vec, t.mat, outline_type(spec.dim, spec.dtype)
    depth, GridInputs = wall_face(spec).depth, input_types(spec).GridInputs
    report, in_wall = status.report(spec.dim, spec.dtype).report, int(Kind.IN_WALL)
    count, number = wall_faces(spec).count, wall_faces(spec).number

    @kernel()
    def check_start(
        # Parameters:
        inputs: GridInputs,
        outline: Outline,
        nearest: wp.array(dtype=wp.int64),  # particle of each point
        arms: wp.array(dtype=exact_vec),  # X_s − X_p [m]
        # In:
        x: wp.array2d(dtype=vec),
        F: wp.array2d(dtype=mat),
        low_x: wp.array2d(dtype=vec),  # empty without low-order parts
        low_F: wp.array2d(dtype=mat),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        world, s = wp.tid()
        p = int(nearest[s])
        place = exact_vec()
        for axis in range(dim):
            place[axis] = wp.float64(x[world, p][axis])
            if low_x.shape[0] > 0:
                place[axis] += wp.float64(low_x[world, p][axis])
            for other in range(dim):
                entry = wp.float64(F[world, p][axis, other])
                if low_x.shape[0] > 0:
                    entry += wp.float64(low_F[world, p][axis, other])
                place[axis] += entry * arms[s][other]
        for q in range(count):
            if depth(inputs, world, number[q], wp.float64(0.0), place) > outline.deepest[s]:
                report(words, world, 0, in_wall, q * nearest.shape[0] + s)

    return check_start
