"""One wall at one grid node: whether the node is inside, how the wall moves there, the response, and the adjoint of all three.

A wall at rest has n·x ≤ o inside. A wall that moves has, t seconds after the beginning of a control step,

    a = n + t ṅ,   a·x ≤ o + t ȯ inside,   n̂ = a / |a|                                              (C4)
    u = ((ȯ − ṅ·x) / |a|) n̂ + w,   v' = u + respond(v − u)                                          (C5)

with the velocity w of its surface. With r̄ and n̄ from the response (contacts/) and ū = v̄' − r̄, r = (ȯ − ṅ·x) / |a|:

    v̄ = r̄,   w̄ = ū,   r̄_u = n̂·ū,   ȱ = r̄_u / |a|,   n̄ += r ū,                                     (C5.adj)
    ā = (n̄ − (n̂·n̄) n̂ − r r̄_u n̂) / |a|,   ṅ̄ = t ā − (r̄_u / |a|) x,   x̄ = −(r̄_u / |a|) ṅ
x̄ counts in the reference formulation, whose nodes move. Derivation: docs/math/grid.md.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.contacts import response, response_adj
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def wall(spec: Spec, k: int) -> SimpleNamespace:
    """Wall number ``k``."""
    t = types(spec.dim, spec.dtype)
    vec = t.vec
    exact_vec, GridInputs = types(spec.dim, "float64").vec, input_types(spec).GridInputs
    respond, moving = response(spec, k), spec.moving

    @wp.func
    def plane(inputs: GridInputs, world: int) -> exact_vec:
        """a of (C4)."""
        return inputs.normal[world, k] + inputs.elapsed[0] * inputs.normal_rate[world, k]

    @wp.func
    def inside(inputs: GridInputs, world: int, x: exact_vec) -> bool:
        """Decided in float64, so that both precisions put a point on the surface to the same side."""
        reach = wp.float64(0.0)
        if wp.static(moving):
            a = plane(inputs, world)
            for axis in range(spec.dim):
                reach += a[axis] * x[axis]
            return reach <= inputs.offset[world, k] + inputs.elapsed[0] * inputs.offset_rate[world, k]
        else:
            for axis in range(spec.dim):
                reach += inputs.normal[k, axis] * x[axis]
            return reach <= inputs.offset[k]

    @wp.func
    def normal(inputs: GridInputs, world: int) -> vec:
        if wp.static(moving):
            return vec(wp.normalize(plane(inputs, world)))  # (C4)
        else:
            return vec(inputs.normal[k])

    @wp.func
    def velocity(inputs: GridInputs, world: int, x: exact_vec) -> vec:
        """u of (C5)."""
        a = plane(inputs, world)
        speed = inputs.offset_rate[world, k] - wp.dot(inputs.normal_rate[world, k], x)
        return vec(speed / wp.dot(a, a) * a) + inputs.surface_velocity[world, k]

    @wp.func
    def meet(inputs: GridInputs, world: int, x: exact_vec, v: vec) -> vec:
        """Velocity after the wall of a node inside it."""
        if wp.static(moving):
            u = velocity(inputs, world, x)
            return u + respond(inputs, world, normal(inputs, world), v - u)  # (C5)
        else:
            return respond(inputs, world, normal(inputs, world), v)

    return SimpleNamespace(inside=inside, meet=meet, normal=normal, velocity=velocity, plane=plane)


@kernel_factory
def meet_adj_type(dim: int, dtype: str):
    vec = types(dim, dtype).vec

    @wp.struct
    class MeetAdj:
        v: vec
        x: vec

    return MeetAdj


@kernel_factory
def wall_adj(spec: Spec, wanted: RequestedGrads, k: int) -> wp.Function:
    """Adjoints of ``meet`` of wall number ``k``; adds those of the wall's inputs at node ``i`` into ``adj_inputs``."""
    t, w = types(spec.dim, spec.dtype), wall(spec, k)
    real, vec, GridInputs = t.real, t.vec, input_types(spec).GridInputs
    exact_vec = types(spec.dim, "float64").vec
    GridInputsAdj = input_adj_types(spec, wanted).GridInputsAdj
    normal, velocity, plane = w.normal, w.velocity, w.plane
    respond_adj, moving = response_adj(spec, wanted, k), spec.moving
    MeetAdj = meet_adj_type(spec.dim, spec.dtype)

    @wp.func
    def motion_adj(
        inputs: GridInputs,
        world: int,
        x: exact_vec,
        adj_n: vec,
        adj_u: vec,
        i: int,
        adj_inputs: GridInputsAdj,
    ):
        """(C5.adj)"""
        a = plane(inputs, world)
        length = real(wp.length(a))
        n = normal(inputs, world)
        at = vec(x)
        rate = (real(inputs.offset_rate[world, k]) - wp.dot(vec(inputs.normal_rate[world, k]), at)) / length
        adj_rate = wp.dot(n, adj_u)
        adj_unit = adj_n + rate * adj_u
        adj_a = (adj_unit - (wp.dot(adj_unit, n) + rate * adj_rate) * n) / length
        adj_inputs.offset_rate[k, i] = adj_inputs.offset_rate[k, i] + adj_rate / length
        adj_inputs.normal[k, i] = adj_inputs.normal[k, i] + adj_a
        adj_normal_rate = real(inputs.elapsed[0]) * adj_a - (adj_rate / length) * at
        adj_inputs.normal_rate[k, i] = adj_inputs.normal_rate[k, i] + adj_normal_rate
        adj_inputs.surface_velocity[k, i] = adj_inputs.surface_velocity[k, i] + adj_u

    @wp.func
    def meet_adj(
        inputs: GridInputs,
        world: int,
        x: exact_vec,
        v: vec,
        adj: vec,
        i: int,
        adj_inputs: GridInputsAdj,
    ) -> MeetAdj:
        out = MeetAdj()
        n = normal(inputs, world)
        if wp.static(moving):
            back = respond_adj(inputs, world, n, v - velocity(inputs, world, x), adj, i, adj_inputs)
            if wp.static("wall" in wanted):
                motion_adj(inputs, world, x, back.n, adj - back.v, i, adj_inputs)
            length = real(wp.length(plane(inputs, world)))
            out.x = (-wp.dot(n, adj - back.v) / length) * vec(inputs.normal_rate[world, k])
            out.v = back.v
        else:
            still = respond_adj(inputs, world, n, v, adj, i, adj_inputs)
            out.v = still.v
        return out

    return meet_adj
