"""Adjoint of contact at surface points on the moving grid (surface.py). Derivation: docs/math/contact.md.

    J̄_s = A_s Σ W_si v̄'_i / m_i
    from the last wall to the first: J̄ += A_s f̄_s / T + D v̄_s,  D̄ += J·v̄_s, then (K4.adj), (K3.adj), (K6.adj)
    v̄*_i = v̄'_i + Σ W_si v̄_s
    m̄_i −= (|W_si| L_i D̄_s + W_si A_s J_s·v̄'_i) / m_i²,  L̄_i += |W_si| D̄_s / m_i
    W̄_si = v*_i·v̄_s + A_s J_s·v̄'_i / m_i + σ (L_i D̄_s / m_i + A_s L̄_i),  σ = sign W_si           (K9.adj), (K10.adj)

and (K8.adj). ``press_adj`` is all but the part with L̄, which all points add to first; that is ``add_loads_adj``. Both add to the
adjoint of the particles. v̄* − v̄' and m̄ have an array beside v̄', since points read that one.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.carried.point import options_of, outline_type, surface_point
from softmpm.kernels.carried.surface import surface
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.physics.lanes import lane_sum, meet_lanes
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.physics.wall_face import wall_face_adj, wall_faces
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def loads_adj(dim: int, dtype: str, packed: bool) -> wp.Function:
    """Function of a point's part in L̄ (K9.adj)"""
    t = types(dim, dtype)
    s = spline(dim, dtype)
    point = surface_point(dim, dtype, packed)
    Outline = outline_type(dim, dtype)
    real, vec, Constants, Window = t.real, t.vec, t.Constants, t.Window
    Point, ParticlesAdj, PlaceAdj = point.Point, point.ParticlesAdj, point.PlaceAdj
    share, with_share_adj, add_place_adj = point.share, point.with_share_adj, point.add_place_adj
    offset, node_index, size = s.offset, s.node_index, s.count

    @wp.func
    def add_load_adj(
        constants: Constants,
        window: Window,
        outline: Outline,
        at: Point,
        world: int,
        p: int,
        lane: int,
        owner: int,
        adj_load: wp.array2d(dtype=real),
        adj: ParticlesAdj,
    ):
        area = outline.areas[p]
        found = PlaceAdj()
        for n in range(lane, size, outline.lanes):
            i = node_index(at.base, offset(n), window.shape)
            a = adj_load[world, i]
            if a != real(0.0):  # only at nodes near a wall
                found = with_share_adj(found, at, n, wp.sign(share(at, n)) * area * a)
        add_place_adj(constants, outline, found, vec(), world, p, owner, lane, adj)

    return add_load_adj


@kernel_factory
def surface_adj(spec: Spec, wanted: RequestedGrads, packed: bool, single: bool) -> SimpleNamespace:
    """Kernels on particles that are ``packed`` as in the fast scheme, or not.

    Args:
        single: Whether a lane has at most one node, which it then reads once.
    """
    dim, t, s = spec.dim, types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype)
    real, vec, node_vec, Constants, Window, pack = t.real, t.vec, t.node, t.Constants, t.Window, s.pack
    point, Outline = surface_point(dim, spec.dtype, packed), outline_type(dim, spec.dtype)
    Point = point.Point
    Particles = point.Particles
    ParticlesAdj = point.ParticlesAdj
    PlaceAdj = point.PlaceAdj
    point_of, share, with_share_adj = point.point_of, point.share, point.with_share_adj
    add_place_adj = point.add_place_adj
    load_state, load_velocity, load_number = point.load_state, point.load_velocity, point.load_number
    vD, summed, pulled = wp.types.vector(dim + 1, real), lane_sum(dim + 1, real), lane_sum(dim, real)
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    walls, face_adj = wall_faces(spec), wall_face_adj(spec, wanted)
    faces_of, meet, meet_adj = walls.faces_of, walls.meet, walls.meet_adj
    count, number, vecs = walls.count, walls.number, walls.vecs
    offset, node_index, size, apart = s.offset, s.node_index, s.count, surface(spec, packed).apart
    add_load_adj = loads_adj(dim, spec.dtype, packed)

    @wp.struct
    class Seen:
        i: int  # number of the node
        b: real  # W
        m: real
        v: vec  # v*
        L: real

    @wp.func
    def seen(
        window: Window,
        at: Point,
        n: int,
        world: int,
        node: wp.array2d(dtype=node_vec),
        free: wp.array2d(dtype=vec),
        load: wp.array2d(dtype=real),
    ) -> Seen:
        """Node ``n`` of a point."""
        out = Seen()
        out.i = node_index(at.base, offset(n), window.shape)
        out.m = node[world, out.i][dim]
        out.v = load_velocity(free, world, out.i)
        out.L = load_number(load, world, out.i)
        out.b = share(at, n)
        return out

    @kernel(options_of(packed), grid_stride=False)
    def press_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        outline: Outline,
        smoothing: real,
        rate: wp.array(dtype=real),  # 1/T
        anew: int,  # 1 at the beginning of a control step
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        anchor: wp.array3d(dtype=vec),
        node: wp.array2d(dtype=node_vec),
        free: wp.array2d(dtype=vec),
        load: wp.array2d(dtype=real),
        adj_velocity: wp.array2d(dtype=vec),  # v̄'
        # In and out:
        adj_force: wp.array3d(dtype=vec),
        adj_anchor: wp.array3d(dtype=vec),
        # Out, added into:
        adj_load: wp.array2d(dtype=real),
        gained: wp.array2d(dtype=node_vec),  # v̄* − v̄' and m̄
        adj: ParticlesAdj,
        adj_inputs: GridInputsAdj,
    ):
        world, p, lane = wp.tid()
        before = vecs()
        adj_after = vecs()
        adj_pushed = vecs()
        for q in range(count):
            before[q] = anchor[world, q, p]
            adj_after[q] = load_state(adj_anchor, world, q, p)
            adj_pushed[q] = load_state(adj_force, world, q, p)
        at = point_of(constants, window, outline, now, world, p, owner[world, p])
        wall = faces_of(constants, inputs, world, at.x, before)
        if wp.static(apart):
            idle = wall.near == 0  # as most points are
            for q in range(count):
                for axis in range(dim):
                    idle = idle and adj_after[q, axis] == real(0.0)
            if idle:
                await_previous()
                if anew == 1:
                    for q in range(count):
                        adj_force[world, q, p] = vec()
                return
        stiffness = outline.stiffness[p]
        area = outline.areas[p]
        per_force = rate[0] * outline.newtons[p]
        found = vD()
        mine = Seen()
        if wall.near == 1:
            for n in range(lane, size, outline.lanes):
                mine = seen(window, at, n, world, node, free, load)
                for axis in range(dim):
                    found[axis] = found[axis] + mine.b * mine.v[axis]
                if mine.m > real(0.0):
                    found[dim] = found[dim] + wp.abs(mine.b) * mine.L / mine.m
            found = summed(found, outline.lanes)
        D = found[dim]
        v = vec()
        for axis in range(dim):
            v[axis] = found[axis]
        reached = vecs()
        given = vecs()
        total = vec()
        for q in range(count):
            reached[q] = v
            met = meet(constants, wall, q, stiffness, smoothing, vec(at.x), v, D)
            given[q] = met.J
            v += D * met.J
            total += met.J
        await_previous()  # adj_velocity
        if wall.near == 1 and not D > real(0.0):  # a point of a world that failed
            return
        pull = vec()
        adj_v = vec()
        if wall.near == 1:
            for n in range(lane, size, outline.lanes):
                if wp.static(not single):
                    mine = seen(window, at, n, world, node, free, load)
                adj_v = adj_velocity[world, mine.i]
                if mine.m > real(0.0):
                    pull += (area * mine.b / mine.m) * adj_v
            pull = pulled(pull, outline.lanes)
        meet_lanes(outline.lanes)
        back_x = vec()
        back_v = vec()
        back_D = real(0.0)
        slot = world * window.count + p
        for back in range(count):
            q = count - 1 - back
            more = meet_adj(
                constants,
                wall,
                q,
                stiffness,
                smoothing,
                vec(at.x),
                reached[q],
                D,
                pull + D * back_v + per_force * adj_pushed[q],
                adj_after[q],
            )
            back_D += wp.dot(given[q], back_v) + more.D
            back_v += more.v
            back_x += more.x
            if lane == 0:
                adj_anchor[world, q, p] = face_adj(
                    constants,
                    inputs,
                    world,
                    number[q],
                    before[q],
                    more.n,
                    more.y,
                    more.anchor,
                    slot,
                    adj_inputs,
                )
                if anew == 1:  # the mean before is dropped
                    adj_force[world, q, p] = vec()
                if wp.static("friction" in wanted):
                    adj_inputs.friction[number[q], slot] = (
                        adj_inputs.friction[number[q], slot] + more.friction
                    )
        impulse = area * total
        back_place = PlaceAdj()
        if wall.near == 1:
            for n in range(lane, size, outline.lanes):
                if wp.static(not single):
                    mine = seen(window, at, n, world, node, free, load)
                    adj_v = adj_velocity[world, mine.i]
                b = mine.b
                lightness = real(0.0)
                if mine.m > real(0.0):
                    lightness = real(1.0) / mine.m
                along = lightness * wp.dot(impulse, adj_v)
                loaded = lightness * back_D * mine.L
                adj_share = wp.dot(mine.v, back_v) + along + wp.sign(b) * loaded
                back_place = with_share_adj(back_place, at, n, adj_share)
                wp.atomic_add(adj_load, world, mine.i, wp.abs(b) * lightness * back_D)
                adj_m = -lightness * (wp.abs(b) * loaded + b * along)
                wp.atomic_add(gained, world, mine.i, pack(b * back_v, adj_m))
        add_place_adj(constants, outline, back_place, back_x, world, p, owner[world, p], lane, adj)

    @kernel(options_of(packed))
    def add_loads_adj(
        # Parameters:
        constants: Constants,
        window: Window,
        outline: Outline,
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        adj_load: wp.array2d(dtype=real),
        # Out, added into:
        adj: ParticlesAdj,
    ):
        world, p, lane = wp.tid()
        particle = owner[world, p]
        at = point_of(constants, window, outline, now, world, p, particle)
        add_load_adj(constants, window, outline, at, world, p, lane, particle, adj_load, adj)

    return SimpleNamespace(press_adj=press_adj, add_loads_adj=add_loads_adj)
