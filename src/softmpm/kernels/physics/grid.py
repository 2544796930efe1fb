"""Grid stage: nodal momentum to nodal velocity. Derivation: docs/math/grid.md.

    u = p / m                                                                                        (G1)
    v = W_k(... W_1(exp(−γ Δt) (u + Δt g)))   with the walls W_1 … W_k in the order of the scene     (G2)
    p̄ = exp(−γ Δt) v̄₀ / m,  m̄ = −p̄ · u        v̄₀ being the adjoint before the walls               (G1.adj)

Empty nodes get zero in both directions; in the fast scheme they keep what they held (kernels/fast/g2p2g.py).
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.contact import contact
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import Spec, solid_types, types


@kernel_factory
def grid(spec: Spec) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, vec, ivec, node_vec, Constants = t.real, t.vec, t.ivec, t.node, t.Constants
    Walls = solid_types(spec).Walls
    nodes = spline(spec.dim, spec.dtype)
    node_coordinates, momentum, pack = nodes.node_coordinates, nodes.momentum, nodes.pack
    dim, gravity, damping = spec.dim, spec.gravity, spec.damping

    @wp.struct
    class NodeAdj:
        p: vec
        m: real

    @wp.func
    def free_velocity(constants: Constants, u: vec) -> vec:
        v = u
        if wp.static(gravity):
            v += constants.dt * constants.gravity
        if wp.static(damping):
            v = constants.decay * v
        return v

    def after_walls(count: int) -> wp.Function:
        """v after the first ``count`` walls (G2)."""
        if count == 0:

            @wp.func
            def after(constants: Constants, walls: Walls, here: ivec, v: vec) -> vec:
                return v
        else:
            before, wall = after_walls(count - 1), contact(spec, count - 1)
            inside, respond = wall.inside, wall.respond

            @wp.func
            def after(constants: Constants, walls: Walls, here: ivec, v: vec) -> vec:
                w = before(constants, walls, here, v)
                if inside(walls, here, constants.exact_spacing):
                    w = respond(walls, w)
                return w

        return after

    def after_walls_adj(k: int) -> wp.Function:
        """Adjoint of the velocity before wall ``k``, from that of the velocity after all walls."""
        if k == len(spec.contacts):

            @wp.func
            def back(constants: Constants, walls: Walls, here: ivec, v: vec, adj: vec) -> vec:
                return adj
        else:
            through_others, wall = after_walls_adj(k + 1), contact(spec, k)
            inside, respond, respond_adj = wall.inside, wall.respond, wall.respond_adj

            @wp.func
            def back(constants: Constants, walls: Walls, here: ivec, v: vec, adj: vec) -> vec:
                meets = inside(walls, here, constants.exact_spacing)
                w = v
                if meets:
                    w = respond(walls, v)
                adj_v = through_others(constants, walls, here, w, adj)
                if meets:
                    adj_v = respond_adj(walls, v, adj_v)
                return adj_v

        return back

    after_all_walls, after_all_walls_adj = after_walls(len(spec.contacts)), after_walls_adj(0)

    @wp.func
    def node_velocity(constants: Constants, walls: Walls, here: ivec, p: vec, m: real) -> vec:
        """Velocity of the node at ``here`` from its momentum and mass."""
        v = vec()
        if m > real(0.0):
            v = after_all_walls(constants, walls, here, free_velocity(constants, p / m))  # (G1), (G2)
        return v

    @wp.func
    def node_velocity_adj(
        constants: Constants, walls: Walls, here: ivec, p: vec, m: real, adj_velocity: vec
    ) -> NodeAdj:
        adj = NodeAdj()
        if m > real(0.0):
            u = p / m
            adj_v = after_all_walls_adj(constants, walls, here, free_velocity(constants, u), adj_velocity)
            adj.p = adj_v / m  # (G1.adj)
            if wp.static(damping):
                adj.p = constants.decay * adj.p
            adj.m = -wp.dot(adj.p, u)
        return adj

    @wp.kernel(module=spec.module, enable_backward=False)
    def grid_velocity(
        # Parameters:
        constants: Constants,
        walls: Walls,
        # In:
        node: wp.array2d(dtype=node_vec),
        # Out:
        velocity: wp.array2d(dtype=vec),
    ):
        world, n = wp.tid()
        node_n = node[world, n]
        here = node_coordinates(n, constants.shape)
        velocity[world, n] = node_velocity(constants, walls, here, momentum(node_n), node_n[dim])

    @wp.kernel(module=spec.module + ".adj", enable_backward=False)
    def grid_velocity_adj(
        # Parameters:
        constants: Constants,
        walls: Walls,
        # In:
        node: wp.array2d(dtype=node_vec),
        adj_velocity: wp.array2d(dtype=vec),
        # Out:
        adj_node: wp.array2d(dtype=node_vec),
    ):
        world, n = wp.tid()
        node_n = node[world, n]
        here = node_coordinates(n, constants.shape)
        adj = node_velocity_adj(constants, walls, here, momentum(node_n), node_n[dim], adj_velocity[world, n])
        adj_node[world, n] = pack(adj.p, adj.m)

    return SimpleNamespace(
        node_velocity=node_velocity,
        node_velocity_adj=node_velocity_adj,
        grid_velocity=grid_velocity,
        grid_velocity_adj=grid_velocity_adj,
    )
