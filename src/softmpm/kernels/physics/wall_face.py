"""The walls that a surface point meets in a substep: each moves first, and takes the anchor of the point along.

With its unit normal and offset n°, o° at the beginning of the substep and n, o at the end, both of (C4), and the velocity w of the
surface

    a = a° carried from n°, o° to n, o (carry.py) + Δt (w − (n·w) n)                                 (K6)
    y = n·x − o − Δt n·w                                                                             (K3)

    w̄ += Δt (ā − (n·ā + ȳ) n),  n̄ −= Δt ((ȳ + n·ā) w + (n·w) ā),  ō −= ȳ                             (K3.adj), (K6.adj)
    at t, with the adjoints of the normal and the offset at both ends of the substep:
    n̄_c += n̄ + n̄°,  ṅ̄ += t (n̄ + n̄°) + Δt n̄,  ō and ȱ alike                                           (C4.adj)

The part ȳ x of n̄ is in surface_contact.py. A wall at rest has n° = n, o° = o and w = 0. Derivation: docs/math/contact.md.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.carry import carry
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def wall_face(spec: Spec) -> SimpleNamespace:
    t, exact_vec = types(spec.dim, spec.dtype), types(spec.dim, "float64").vec
    real, vec, Constants, GridInputs = t.real, t.vec, t.Constants, input_types(spec).GridInputs
    dim, moving, Pose, way = spec.dim, spec.moving, carry(spec.dim).Pose, carry(spec.dim).way

    @wp.struct
    class Face:
        n: vec
        y: real  # [m]
        depth: real  # of the point under the wall at the beginning of the substep [m]
        anchor: vec

    @wp.func
    def elapsed(inputs: GridInputs) -> wp.float64:
        if wp.static(moving):
            return inputs.elapsed[0]
        else:
            return wp.float64(0.0)

    @wp.func
    def pose(inputs: GridInputs, world: int, k: int, later: wp.float64) -> Pose:
        """(C4), so much later than the inputs."""
        out = Pose()
        if wp.static(moving):
            time = elapsed(inputs) + later
            a = inputs.normal[world, k] + time * inputs.normal_rate[world, k]
            out.length = wp.length(a)
            out.n = a / out.length
            out.o = (inputs.offset[world, k] + time * inputs.offset_rate[world, k]) / out.length
        else:
            for axis in range(dim):
                out.n[axis] = inputs.normal[k, axis]
            out.o = inputs.offset[k]
            out.length = wp.float64(1.0)
        return out

    @wp.func
    def depth(inputs: GridInputs, world: int, k: int, later: wp.float64, x: exact_vec) -> real:
        """Depth of a point under the wall, so much later than the inputs [m]."""
        at = pose(inputs, world, k, later)
        return real(at.o - wp.dot(at.n, x))

    @wp.func
    def face(constants: Constants, inputs: GridInputs, world: int, k: int, x: exact_vec, anchor: vec) -> Face:
        """Wall ``k`` as the point at ``x`` meets it; y is computed in float64 until it is small."""
        out = Face()
        before = pose(inputs, world, k, wp.float64(0.0))
        deep = before.o - wp.dot(before.n, x)
        out.depth = real(deep)
        if wp.static(moving):
            now = pose(inputs, world, k, wp.float64(constants.dt))
            n = vec(now.n)
            w = inputs.surface_velocity[world, k]
            out.n = n
            out.y = real(wp.dot(now.n, x) - now.o) - constants.dt * wp.dot(n, w)
            slid = constants.dt * (w - wp.dot(n, w) * n)
            out.anchor = anchor + (vec(way(before, now, exact_vec(anchor))) + slid)
        else:
            out.n = vec(before.n)
            out.y = real(-deep)
            out.anchor = anchor
        return out

    return SimpleNamespace(face=face, depth=depth, pose=pose, elapsed=elapsed)


@kernel_factory
def wall_face_adj(spec: Spec, wanted: RequestedGrads) -> wp.Function:
    """Adjoint of ``face``: that of the anchor before; adds those of the wall's inputs at ``i`` into ``adj_inputs``."""
    t, exact_vec, one = types(spec.dim, spec.dtype), types(spec.dim, "float64").vec, wall_face(spec)
    real, vec, Constants, GridInputs = t.real, t.vec, t.Constants, input_types(spec).GridInputs
    GridInputsAdj, moving = input_adj_types(spec, wanted).GridInputsAdj, spec.moving
    pose, elapsed, way_adj = one.pose, one.elapsed, carry(spec.dim).way_adj

    @wp.func
    def face_adj(
        constants: Constants,
        inputs: GridInputs,
        world: int,
        k: int,
        anchor: vec,
        adj_n: vec,
        adj_y: real,
        adj_anchor: vec,
        i: int,
        adj_inputs: GridInputsAdj,
    ) -> vec:
        if wp.static(moving):
            before = pose(inputs, world, k, wp.float64(0.0))
            now = pose(inputs, world, k, wp.float64(constants.dt))
            n = vec(now.n)
            w = inputs.surface_velocity[world, k]
            push = adj_y + wp.dot(n, adj_anchor)
            all_n = adj_n - constants.dt * (push * w + wp.dot(n, w) * adj_anchor)
            g = exact_vec(adj_anchor)
            back = way_adj(before, now, exact_vec(anchor), g, exact_vec(all_n), wp.float64(-adj_y))
            if wp.static("wall" in wanted):
                dt = constants.dt
                since = real(elapsed(inputs))
                normal = vec(back.normal)
                offset = real(back.offset)
                adj_inputs.normal[k, i] = adj_inputs.normal[k, i] + normal
                adj_inputs.offset[k, i] = adj_inputs.offset[k, i] + offset
                turn = since * normal + dt * vec(back.late_normal)
                rise = since * offset + dt * real(back.late_offset)
                adj_inputs.normal_rate[k, i] = adj_inputs.normal_rate[k, i] + turn
                adj_inputs.offset_rate[k, i] = adj_inputs.offset_rate[k, i] + rise
                adj_w = dt * (adj_anchor - push * n)
                adj_inputs.surface_velocity[k, i] = adj_inputs.surface_velocity[k, i] + adj_w
            return vec(back.anchor)
        else:
            return adj_anchor

    return face_adj


@kernel_factory
def wall_faces(spec: Spec) -> SimpleNamespace:
    """All separating walls as a surface point meets them, and its contact with the ``q``-th of them."""
    t = types(spec.dim, spec.dtype)
    exact_vec = types(spec.dim, "float64").vec
    GridInputs = input_types(spec).GridInputs
    real, vec, Constants, face = t.real, t.vec, t.Constants, wall_face(spec).face
    one, walls = surface_contact(spec.dim, spec.dtype), spec.surface_walls
    Touch, touch, TouchAdj, touch_adj = one.Touch, one.touch, one.TouchAdj, one.touch_adj
    count, number = len(walls), wp.types.vector(len(walls), wp.int32)(*walls)  # among all walls
    vecs, reals = wp.types.matrix((count, spec.dim), real), wp.types.vector(count, real)
    rough, each_world = spec.friction, "friction" in spec.given

    @wp.struct
    class Faces:
        near: int  # 1 if a wall is not further away than a cell
        n: vecs
        y: reals
        depth: reals
        anchor: vecs
        friction: reals

    @wp.func
    def friction_of(inputs: GridInputs, world: int, k: int) -> real:
        if wp.static(rough and each_world):
            return inputs.friction[world, k]
        elif wp.static(rough):
            return inputs.friction[k]
        else:
            return real(0.0)

    @wp.func
    def faces_of(constants: Constants, inputs: GridInputs, world: int, x: exact_vec, anchor: vecs) -> Faces:
        """The walls as the point at ``x`` meets them. All are read before the first acts, so that they wait for memory together."""
        out = Faces()
        for q in range(count):
            k = number[q]
            wall = face(constants, inputs, world, k, x, anchor[q])
            out.n[q] = wall.n
            out.y[q] = wall.y
            out.depth[q] = wall.depth
            out.anchor[q] = wall.anchor
            out.friction[q] = friction_of(inputs, world, k)
            if not wall.y > constants.spacing:  # nor for a place that is not a number
                out.near = 1
        return out

    @wp.func
    def meet(
        constants: Constants, wall: Faces, q: int, stiffness: real, smoothing: real, x: vec, v: vec, D: real
    ) -> Touch:
        """J and the new anchor of (K3), (K4)."""
        return touch(
            wall.n[q],
            wall.y[q],
            x,
            v,
            wall.anchor[q],
            D,
            wall.friction[q],
            stiffness,
            constants.dt,
            smoothing,
            constants.spacing,
        )

    @wp.func
    def meet_adj(
        constants: Constants,
        wall: Faces,
        q: int,
        stiffness: real,
        smoothing: real,
        x: vec,
        v: vec,
        D: real,
        adj_J: vec,
        adj_next: vec,
    ) -> TouchAdj:
        """Adjoint of ``meet``: (K3.adj), (K4.adj)."""
        return touch_adj(
            wall.n[q],
            wall.y[q],
            x,
            v,
            wall.anchor[q],
            D,
            wall.friction[q],
            stiffness,
            constants.dt,
            smoothing,
            constants.spacing,
            adj_J,
            adj_next,
        )

    return SimpleNamespace(
        faces_of=faces_of, meet=meet, meet_adj=meet_adj, count=count, number=number, vecs=vecs, reals=reals
    )
