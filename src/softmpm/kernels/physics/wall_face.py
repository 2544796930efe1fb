"""The wall that a surface point meets in a substep: it moves first, and takes the anchor of the point along.

With its unit normal and offset n°, o° at the beginning of the substep and n, o at the end, both of (C4), the velocity w of its surface
and c = n·n°

    a = a° + [(o° + o)(n° − c n) − (n·a°)(n° + n)] / (1 + c) + Δt (w − (n·w) n)                      (K6)
    y = n·x − o − Δt n·w                                                                             (K3)

    ȳ:  n̄ −= Δt ȳ w,  ō −= ȳ,  w̄ −= Δt ȳ n        its part ȳ x in n̄ is in surface_contact.py        (K3.adj)
    with q = ((n° + n)·ā)/(1 + c),  r = ((n° − c n)·ā)/(1 + c),  h = (o° + o)/(1 + c):
    ā° += ā − q n,  ō° += r,  ō += r,  w̄ += Δt (ā − (n·ā) n)                                         (K6.adj)
    c̄ = ((n·a°) q − (o° + o) r)/(1 + c) − h n·ā
    n̄° += (h − (n·a°)/(1 + c)) ā + c̄ n
    n̄ −= (c h + (n·a°)/(1 + c)) ā + q a° − c̄ n° + Δt ((n·ā) w + (n·w) ā)

and through each pose by (C4.adj). A wall at rest has n° = n, o° = o and w = 0. Derivation: docs/math/contact.md.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def wall_face(spec: Spec) -> SimpleNamespace:
    t, exact_vec = types(spec.dim, spec.dtype), types(spec.dim, "float64").vec
    real, vec, Constants, GridInputs = t.real, t.vec, t.Constants, input_types(spec).GridInputs
    dim, moving = spec.dim, spec.moving

    @wp.struct
    class Face:
        n: vec
        y: real  # [m]
        depth: real  # of the point under the wall at the beginning of the substep [m]
        anchor: vec

    @wp.struct
    class Pose:
        n: exact_vec  # of unit length
        o: wp.float64
        length: wp.float64  # |a|

    @wp.func
    def pose(inputs: GridInputs, world: int, k: int, time: wp.float64) -> Pose:
        """(C4), ``time`` after the beginning of the control step."""
        out = Pose()
        if wp.static(moving):
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
    def way(before: Pose, now: Pose, anchor: exact_vec) -> exact_vec:
        """Way of an anchor (K6), without that of the surface."""
        cosine = wp.dot(now.n, before.n)
        turned = (before.o + now.o) * (before.n - cosine * now.n) - wp.dot(now.n, anchor) * (before.n + now.n)
        return turned / (wp.float64(1.0) + cosine)

    @wp.func
    def elapsed(inputs: GridInputs) -> wp.float64:
        if wp.static(moving):
            return inputs.elapsed[0]
        else:
            return wp.float64(0.0)

    @wp.func
    def depth(inputs: GridInputs, world: int, k: int, later: wp.float64, x: exact_vec) -> real:
        """Depth of a point under the wall, this much later than the inputs [m]."""
        at = pose(inputs, world, k, elapsed(inputs) + later)
        return real(at.o - wp.dot(at.n, x))

    @wp.func
    def face(constants: Constants, inputs: GridInputs, world: int, k: int, x: exact_vec, anchor: vec) -> Face:
        """Wall ``k`` as the point at ``x`` meets it; y is computed in float64 until it is small."""
        out = Face()
        before = pose(inputs, world, k, elapsed(inputs))
        depth = before.o - wp.dot(before.n, x)
        out.depth = real(depth)
        if wp.static(moving):
            dt = wp.float64(constants.dt)
            now = pose(inputs, world, k, elapsed(inputs) + dt)
            n = vec(now.n)
            w = inputs.surface_velocity[world, k]
            out.n = n
            out.y = real(wp.dot(now.n, x) - now.o) - constants.dt * wp.dot(n, w)
            slid = constants.dt * (w - wp.dot(n, w) * n)
            out.anchor = anchor + (vec(way(before, now, exact_vec(anchor))) + slid)
        else:
            out.n = vec(before.n)
            out.y = real(-depth)
            out.anchor = anchor
        return out

    return SimpleNamespace(face=face, depth=depth, pose=pose, elapsed=elapsed, Pose=Pose)


@kernel_factory
def wall_face_adj(spec: Spec, wanted: RequestedGrads) -> wp.Function:
    """Adjoint of ``face``: that of the anchor before; adds those of the wall's inputs at ``i`` into ``adj_inputs``."""
    t, exact_vec, one = types(spec.dim, spec.dtype), types(spec.dim, "float64").vec, wall_face(spec)
    real, vec, Constants, GridInputs = t.real, t.vec, t.Constants, input_types(spec).GridInputs
    GridInputsAdj, moving = input_adj_types(spec, wanted).GridInputsAdj, spec.moving
    pose, elapsed, Pose = one.pose, one.elapsed, one.Pose

    @wp.func
    def pose_adj(
        k: int,
        time: wp.float64,
        at: Pose,
        adj_n: exact_vec,
        adj_o: wp.float64,
        i: int,
        adj_inputs: GridInputsAdj,
    ):
        """(C4.adj)"""
        adj_a = (adj_n - (wp.dot(at.n, adj_n) + at.o * adj_o) * at.n) / at.length
        adj_offset = adj_o / at.length
        adj_inputs.normal[k, i] = adj_inputs.normal[k, i] + vec(adj_a)
        adj_inputs.normal_rate[k, i] = adj_inputs.normal_rate[k, i] + vec(time * adj_a)
        adj_inputs.offset[k, i] = adj_inputs.offset[k, i] + real(adj_offset)
        adj_inputs.offset_rate[k, i] = adj_inputs.offset_rate[k, i] + real(time * adj_offset)

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
            one = wp.float64(1.0)
            dt = wp.float64(constants.dt)
            time = elapsed(inputs)
            before = pose(inputs, world, k, time)
            now = pose(inputs, world, k, time + dt)
            n = now.n
            cosine = wp.dot(n, before.n)
            g = exact_vec(adj_anchor)
            share = wp.dot(before.n + n, g) / (one + cosine)
            if wp.static("wall" in wanted):
                a = exact_vec(anchor)
                w = exact_vec(inputs.surface_velocity[world, k])
                height = wp.float64(adj_y)
                lever = (before.o + now.o) / (one + cosine)
                along = wp.dot(n, a) / (one + cosine)
                adj_o = wp.dot(before.n - cosine * n, g) / (one + cosine)
                adj_cosine = along * share - lever * adj_o - lever * wp.dot(n, g)
                adj_before = (lever - along) * g + adj_cosine * n
                adj_now = exact_vec(adj_n) - dt * height * w - (cosine * lever + along) * g - share * a
                adj_now += adj_cosine * before.n - dt * (wp.dot(n, g) * w + wp.dot(n, w) * g)
                pose_adj(k, time, before, adj_before, adj_o, i, adj_inputs)
                pose_adj(k, time + dt, now, adj_now, adj_o - height, i, adj_inputs)
                adj_w = vec(dt * (g - (wp.dot(n, g) + height) * n))
                adj_inputs.surface_velocity[k, i] = adj_inputs.surface_velocity[k, i] + adj_w
            return adj_anchor - vec(share * n)
        else:
            return adj_anchor

    return face_adj
