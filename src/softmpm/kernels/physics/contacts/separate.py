"""A wall that stops motion into it, with Coulomb's friction c.

    v' = v_t max(0, 1 + c vₙ / |v_t|) if vₙ < 0, else v                                              (C3)

A node held by friction has zero gradient. Source: Stomakhin et al. 2013, "A material point method for snow simulation", section 8.
"""

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.contacts import contact_adj_type
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def friction(spec: Spec, k: int) -> wp.Function:
    """Coulomb's coefficient of wall ``k`` in a world."""
    real, GridInputs, given = types(spec.dim, spec.dtype).real, input_types(spec).GridInputs, spec.given

    @wp.func
    def friction_of(inputs: GridInputs, world: int) -> real:
        if wp.static("friction" in given):
            return inputs.friction[world, k]
        else:
            return inputs.friction[k]

    return friction_of


@kernel_factory
def sliding(spec: Spec, k: int) -> wp.Function:
    """Tangential velocity that friction leaves, for v_n < 0."""
    t, rough = types(spec.dim, spec.dtype), spec.friction
    real, vec, GridInputs = t.real, t.vec, input_types(spec).GridInputs
    friction_of = friction(spec, k) if rough else None

    @wp.func
    def slide(inputs: GridInputs, world: int, v_n: real, v_t: vec) -> vec:
        if wp.static(rough):
            limit = -friction_of(inputs, world) * v_n
            if limit > real(0.0):
                speed = wp.length(v_t)
                if speed <= limit:
                    return vec()
                return v_t * (real(1.0) - limit / speed)
        return v_t

    return slide


@kernel_factory
def response(spec: Spec, k: int) -> wp.Function:
    t, slide, GridInputs = types(spec.dim, spec.dtype), sliding(spec, k), input_types(spec).GridInputs
    real, vec = t.real, t.vec

    @wp.func
    def respond(inputs: GridInputs, world: int, n: vec, v: vec) -> vec:
        v_n = wp.dot(v, n)
        if v_n < real(0.0):
            return slide(inputs, world, v_n, v - v_n * n)  # (C3)
        return v

    return respond


@kernel_factory
def response_adj(spec: Spec, wanted: RequestedGrads, k: int) -> wp.Function:
    t, rough, ContactAdj = types(spec.dim, spec.dtype), spec.friction, contact_adj_type(spec.dim, spec.dtype)
    real, vec, GridInputs = t.real, t.vec, input_types(spec).GridInputs
    GridInputsAdj, slide = input_adj_types(spec, wanted).GridInputsAdj, sliding(spec, k)
    friction_of, moving = friction(spec, k) if rough else None, spec.moving

    @wp.func
    def slide_adj(
        inputs: GridInputs,
        world: int,
        v_n: real,
        v_t: vec,
        adj: vec,
        n: vec,
        i: int,
        adj_inputs: GridInputsAdj,
    ) -> ContactAdj:
        """Adjoints of v and n through v_t and v_n (C3.adj); ``adj`` lies in the tangent plane."""
        back = ContactAdj()
        back.v = adj
        back.n = -v_n * adj
        if wp.static(rough):
            c = friction_of(inputs, world)
            limit = -c * v_n
            if wp.static("friction" in wanted):
                if wp.length(v_t) > limit:
                    adj_c = v_n * wp.dot(adj, v_t) / wp.length(v_t)
                    adj_inputs.friction[k, i] = adj_inputs.friction[k, i] + adj_c
            if limit > real(0.0):
                speed = wp.length(v_t)
                if speed <= limit:
                    return ContactAdj()
                along = wp.dot(adj, v_t) / speed
                adj_v_t = adj * (real(1.0) - limit / speed) + (along * limit / (speed * speed)) * v_t
                back.v = adj_v_t + (c * along) * n
                back.n = (c * along) * v_t - v_n * adj_v_t
        return back

    @wp.func
    def respond_adj(
        inputs: GridInputs, world: int, n: vec, v: vec, adj: vec, i: int, adj_inputs: GridInputsAdj
    ) -> ContactAdj:
        v_n = wp.dot(v, n)
        if v_n < real(0.0):
            adj_n = wp.dot(adj, n)
            v_t = v - v_n * n
            back = slide_adj(inputs, world, v_n, v_t, adj - adj_n * n, n, i, adj_inputs)
            if wp.static(moving):
                back.n -= adj_n * slide(inputs, world, v_n, v_t)
            return back
        free = ContactAdj()
        free.v = adj
        return free

    return respond_adj
