"""Grid stage: nodal momentum to nodal velocity. Derivation: docs/math/grid.md.

    u = p / m                                                                                        (G1)
    v = W_k(... W_1(exp(−γ Δt) (u + Δt g)))   with the walls W_1 … W_k in the order of the scene     (G2)
    p̄ = exp(−γ Δt) v̄₀ / m,  m̄ = −p̄ · u        v̄₀ being the adjoint before the walls               (G1.adj)
    ḡ = Σ Δt m p̄,  adjoint of exp(−γ Δt) = Σ v̄₀·(u + Δt g)        over the nodes of a world

Empty nodes get zero in both directions; in the fast scheme they keep what they held (kernels/fast/g2p2g.py).
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.physics.contact import meet_adj_type, wall, wall_adj
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def grid(spec: Spec) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, vec, ivec, node_vec, Constants = t.real, t.vec, t.ivec, t.node, t.Constants
    GridInputs, dim, given = input_types(spec).GridInputs, spec.dim, spec.given
    exact_vec = types(spec.dim, "float64").vec
    nodes = spline(spec.dim, spec.dtype)
    node_coordinates, momentum = nodes.node_coordinates, nodes.momentum

    @wp.func
    def position(constants: Constants, node: ivec) -> exact_vec:
        """Position of a node at rest [m]; in float64, so that both precisions put it on the same side of a wall."""
        x = exact_vec()
        for axis in range(dim):
            x[axis] = wp.float64(node[axis]) * constants.exact_spacing
        return x

    @wp.func
    def gravity(constants: Constants, inputs: GridInputs, world: int) -> vec:
        if wp.static("gravity" in given):
            return inputs.gravity[world]
        else:
            return constants.gravity

    @wp.func
    def decay(constants: Constants, inputs: GridInputs, world: int) -> real:
        """exp(−γ Δt)."""
        if wp.static("damping" in given):
            return inputs.decay[world]
        else:
            return constants.decay

    @wp.func
    def free_velocity(constants: Constants, inputs: GridInputs, world: int, u: vec) -> vec:
        v = u
        if wp.static(spec.gravity):
            v += constants.dt * gravity(constants, inputs, world)
        if wp.static(spec.damping):
            v = decay(constants, inputs, world) * v
        return v

    def after_walls(count: int) -> wp.Function:
        """v after the first ``count`` walls (G2)."""
        if count == 0:

            @wp.func
            def after(constants: Constants, inputs: GridInputs, world: int, x: exact_vec, v: vec) -> vec:
                return v
        elif count - 1 not in spec.node_walls:
            return after_walls(count - 1)
        else:
            before, last = after_walls(count - 1), wall(spec, count - 1)
            inside, meet = last.inside, last.meet

            @wp.func
            def after(constants: Constants, inputs: GridInputs, world: int, x: exact_vec, v: vec) -> vec:
                w = before(constants, inputs, world, x, v)
                if inside(inputs, world, x):
                    w = meet(inputs, world, x, w)
                return w

        return after

    after_all_walls = after_walls(len(spec.contacts))

    @wp.func
    def node_velocity(
        constants: Constants, inputs: GridInputs, world: int, x: exact_vec, p: vec, m: real
    ) -> vec:
        """Velocity of the node at ``x`` [m] from its momentum and mass."""
        v = vec()
        if m > real(0.0):
            free = free_velocity(constants, inputs, world, p / m)  # (G1)
            v = after_all_walls(constants, inputs, world, x, free)  # (G2)
        return v

    @wp.func
    def increment(constants: Constants, inputs: GridInputs, world: int, impulse: vec, per_m: real) -> vec:
        """Change of the velocity of a node by the impulse of its forces [N s] and by gravity, with 1/m, or 0 without mass."""
        dv = per_m * impulse
        if wp.static(spec.gravity):
            if per_m > real(0.0):
                dv += constants.dt * gravity(constants, inputs, world)
        return dv

    @wp.func
    def after_free(
        constants: Constants, inputs: GridInputs, world: int, x: exact_vec, w: vec, m: real
    ) -> vec:
        """Velocity of the node at ``x`` [m] from that without damping and walls."""
        v = vec()
        if m > real(0.0):
            free = w
            if wp.static(spec.damping):
                free = decay(constants, inputs, world) * free
            v = after_all_walls(constants, inputs, world, x, free)
        return v

    @kernel()
    def grid_velocity(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        # In:
        node: wp.array2d(dtype=node_vec),
        # Out:
        velocity: wp.array2d(dtype=vec),
    ):
        world, n = wp.tid()
        node_n = node[world, n]
        x = position(constants, node_coordinates(n, constants.shape))
        velocity[world, n] = node_velocity(constants, inputs, world, x, momentum(node_n), node_n[dim])

    return SimpleNamespace(
        position=position,
        gravity=gravity,
        decay=decay,
        free_velocity=free_velocity,
        node_velocity=node_velocity,
        increment=increment,
        after_free=after_free,
        grid_velocity=grid_velocity,
    )


@kernel_factory
def grid_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, forward = types(spec.dim, spec.dtype), grid(spec)
    real, vec, node_vec, Constants = t.real, t.vec, t.node, t.Constants
    exact_vec, position = types(spec.dim, "float64").vec, forward.position
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    nodes, dim = spline(spec.dim, spec.dtype), spec.dim
    node_coordinates, momentum, pack = nodes.node_coordinates, nodes.momentum, nodes.pack
    gravity, decay, free_velocity = forward.gravity, forward.decay, forward.free_velocity
    damped, MeetAdj = spec.damping, meet_adj_type(spec.dim, spec.dtype)

    @wp.struct
    class NodeAdj:
        p: vec
        m: real
        x: vec  # through the speed of walls that turn

    def after_walls_adj(k: int) -> wp.Function:
        """Adjoints of the velocity before wall ``k`` and of the position, from that of the velocity after all walls."""
        if k == len(spec.contacts):

            @wp.func
            def back(
                constants: Constants,
                inputs: GridInputs,
                world: int,
                x: exact_vec,
                v: vec,
                adj: vec,
                i: int,
                adj_inputs: GridInputsAdj,
            ) -> MeetAdj:
                out = MeetAdj()
                out.v = adj
                return out
        elif k not in spec.node_walls:
            return after_walls_adj(k + 1)
        else:
            through_others, inside, meet = after_walls_adj(k + 1), wall(spec, k).inside, wall(spec, k).meet
            meet_adj = wall_adj(spec, wanted, k)

            @wp.func
            def back(
                constants: Constants,
                inputs: GridInputs,
                world: int,
                x: exact_vec,
                v: vec,
                adj: vec,
                i: int,
                adj_inputs: GridInputsAdj,
            ) -> MeetAdj:
                meets = inside(inputs, world, x)
                w = v
                if meets:
                    w = meet(inputs, world, x, v)
                out = through_others(constants, inputs, world, x, w, adj, i, adj_inputs)
                if meets:
                    here = meet_adj(inputs, world, x, v, out.v, i, adj_inputs)
                    out.v = here.v
                    out.x += here.x
                return out

        return back

    after_all_walls_adj = after_walls_adj(0)

    @wp.func
    def node_velocity_adj(
        constants: Constants,
        inputs: GridInputs,
        world: int,
        x: exact_vec,
        p: vec,
        m: real,
        adj_velocity: vec,
        i: int,
        adj_inputs: GridInputsAdj,
    ) -> NodeAdj:
        """Adjoint of ``node_velocity``; adds what is wanted at node ``i`` of all worlds into ``adj_inputs``."""
        adj = NodeAdj()
        if m > real(0.0):
            u = p / m
            free = free_velocity(constants, inputs, world, u)
            back = after_all_walls_adj(constants, inputs, world, x, free, adj_velocity, i, adj_inputs)
            adj_v = back.v
            adj.x = back.x
            adj.p = adj_v / m  # (G1.adj)
            if wp.static(damped):
                adj.p = decay(constants, inputs, world) * adj.p
            adj.m = -wp.dot(adj.p, u)
            if wp.static("damping" in wanted):
                driven = u + constants.dt * gravity(constants, inputs, world)
                adj_inputs.decay[i] = adj_inputs.decay[i] + wp.dot(adj_v, driven)
            if wp.static("gravity" in wanted):
                adj_inputs.gravity[i] = adj_inputs.gravity[i] + (m * constants.dt) * adj.p
        return adj

    @wp.func
    def after_free_adj(
        constants: Constants,
        inputs: GridInputs,
        world: int,
        x: exact_vec,
        w: vec,
        m: real,
        per_m: real,
        adj_velocity: vec,
        i: int,
        adj_inputs: GridInputsAdj,
    ) -> NodeAdj:
        """As ``node_velocity_adj``, of ``after_free``: w = p/m + Δt g, with 1/m, or 0 without mass."""
        adj = NodeAdj()
        if m > real(0.0):
            free = w
            if wp.static(damped):
                free = decay(constants, inputs, world) * free
            back = after_all_walls_adj(constants, inputs, world, x, free, adj_velocity, i, adj_inputs)
            adj_v = back.v
            adj.x = back.x
            adj.p = per_m * adj_v
            if wp.static(damped):
                adj.p = decay(constants, inputs, world) * adj.p
            u = w
            if wp.static(spec.gravity):
                u -= constants.dt * gravity(constants, inputs, world)
            adj.m = -wp.dot(adj.p, u)
            if wp.static("damping" in wanted):
                adj_inputs.decay[i] = adj_inputs.decay[i] + wp.dot(adj_v, w)
            if wp.static("gravity" in wanted):
                adj_inputs.gravity[i] = adj_inputs.gravity[i] + (m * constants.dt) * adj.p
        return adj

    @kernel()
    def grid_velocity_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        # In:
        node: wp.array2d(dtype=node_vec),
        adj_velocity: wp.array2d(dtype=vec),
        # Out:
        adj_node: wp.array2d(dtype=node_vec),
        # Out, added into:
        adj_inputs: GridInputsAdj,
    ):
        world, n = wp.tid()
        node_n = node[world, n]
        x = position(constants, node_coordinates(n, constants.shape))
        i = world * node.shape[1] + n
        adj = node_velocity_adj(
            constants,
            inputs,
            world,
            x,
            momentum(node_n),
            node_n[dim],
            adj_velocity[world, n],
            i,
            adj_inputs,
        )
        adj_node[world, n] = pack(adj.p, adj.m)

    return SimpleNamespace(
        node_velocity_adj=node_velocity_adj,
        after_free_adj=after_free_adj,
        grid_velocity_adj=grid_velocity_adj,
    )
