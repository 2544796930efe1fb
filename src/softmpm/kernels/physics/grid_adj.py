"""Adjoint of the grid stage (grid.py). Derivation: docs/math/grid.md.

p̄ = exp(−γ Δt) v̄₀ / m,  m̄ = −p̄ · u        v̄₀ being the adjoint before the walls               (G1.adj)
ḡ = Σ Δt m p̄,  adjoint of exp(−γ Δt) = Σ v̄₀·(u + Δt g)        over the nodes of a world
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.physics.contact import meet_adj_type, wall, wall_adj
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def grid_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, forward = types(spec.dim, spec.dtype), grid(spec)
    real, vec, node_vec, Constants = t.real, t.vec, t.node, t.Constants
    exact_vec, position = types(spec.dim, "float64").vec, forward.position
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    nodes, dim = spline(spec.dim, spec.dtype), spec.dim
    node_coordinates, momentum, pack = nodes.node_coordinates, nodes.momentum, nodes.pack
    gravity, accelerated, damped = forward.gravity, forward.accelerated, forward.damped
    MeetAdj = meet_adj_type(spec.dim, spec.dtype)

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
    def free_adj(
        constants: Constants,
        inputs: GridInputs,
        world: int,
        u: vec,
        w: vec,
        m: real,
        back: MeetAdj,
        adj_p: vec,
        i: int,
        adj_inputs: GridInputsAdj,
    ) -> NodeAdj:
        """(G1.adj) from the adjoint before the walls and v̄₀ / m; adds what is wanted at node ``i`` of all into ``adj_inputs``."""
        adj = NodeAdj()
        adj.x = back.x
        adj.p = damped(constants, inputs, world, adj_p)
        adj.m = -wp.dot(adj.p, u)
        if wp.static("damping" in wanted):
            adj_inputs.decay[i] = adj_inputs.decay[i] + wp.dot(back.v, w)
        if wp.static("gravity" in wanted):
            adj_inputs.gravity[i] = adj_inputs.gravity[i] + (m * constants.dt) * adj.p
        return adj

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
        """Adjoint of ``node_velocity``."""
        adj = NodeAdj()
        if m > real(0.0):
            u = p / m
            w = accelerated(constants, inputs, world, u)
            v = damped(constants, inputs, world, w)
            back = after_all_walls_adj(constants, inputs, world, x, v, adj_velocity, i, adj_inputs)
            adj = free_adj(constants, inputs, world, u, w, m, back, back.v / m, i, adj_inputs)
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
            u = w
            if wp.static(spec.gravity):
                u -= constants.dt * gravity(constants, inputs, world)
            v = damped(constants, inputs, world, w)
            back = after_all_walls_adj(constants, inputs, world, x, v, adj_velocity, i, adj_inputs)
            adj = free_adj(constants, inputs, world, u, w, m, back, per_m * back.v, i, adj_inputs)
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
