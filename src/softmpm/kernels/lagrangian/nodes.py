"""Motion of the nodes. Derivation: docs/math/lagrangian.md.

    m_i = Σ m_p N_i                                                                                  (Q2)
    v* = exp(−γ Δt) (p/m + Δt g),  p = m v + Δt f                                                    (Q3)
    v' = W(v*) at X + u,  u' = u + Δt v'                                                             (Q4)
    v̄' += Δt ū'                                                                                      (Q4.adj)
    p̄ and m̄ by (G1.adj),  f̄ = Δt p̄,  v̄ = m p̄,  m̄ += v·p̄                                            (Q3.adj)
    m̄_p += Σ N_i m̄_i                                                                                 (Q2.adj)

(Q3) and (Q4) are the grid stage (G1), (G2) of the momentum p. The side of a wall on which a node lies is constant in the adjoint; the
speed of a wall that turns depends on the place of the node.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.rest import lagrangian_module, rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.grid import grid, grid_adj
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def nodes(spec: Spec) -> SimpleNamespace:
    t, r, g = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), grid(spec)
    real, vec, Constants, Rest = t.real, t.vec, t.Constants, r.Rest
    exact_vec, ParticleInputs = types(spec.dim, "float64").vec, input_types(spec).ParticleInputs
    GridInputs, dim = input_types(spec).GridInputs, spec.dim
    position, node_velocity = g.position, g.node_velocity
    running = status.report(spec.dim, spec.dtype).running
    weights, weight, offset, surface = r.weights, r.weight, r.offset, bool(spec.surface_walls)
    module = lagrangian_module(spec.module + ".lagrangian")

    @wp.func
    def place(constants: Constants, inside: Rest, i: int, u: vec) -> exact_vec:
        """Present position X_i + u_i of a node [m]."""
        x = position(constants, inside.nodes[i])
        for axis in range(dim):
            x[axis] = x[axis] + wp.float64(u[axis])
        return x

    @wp.func
    def gathered(partial: wp.array3d(dtype=vec), inside: Rest, world: int, i: int) -> vec:
        """Sum of what the cells around a node have for it, in a fixed order."""
        total = vec()
        for n in range(r.count):
            c = inside.node_cells[i, n]
            if c >= 0:
                total += partial[world, c, n]
        return total

    @wp.kernel(module=module, enable_backward=False)
    def masses(inputs: ParticleInputs, inside: Rest, mass: wp.array2d(dtype=real)):
        """m of (Q2), in units of the heaviest particle's mass."""
        world, i = wp.tid()
        total = real(0.0)
        for n in range(r.count):
            c = inside.node_cells[i, n]
            if c >= 0:
                for at in range(inside.first[c], inside.first[c + 1]):
                    share = weight(weights(inside.fraction[at]), offset(n))
                    total += share * inputs.mass[world, inside.particles[at]]
        mass[world, i] = total

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        partial: wp.array3d(dtype=vec),
        words: wp.array(dtype=wp.int64),
        # In:
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        # Out:
        p: wp.array2d(dtype=vec),
        new_u: wp.array2d(dtype=vec),
        new_v: wp.array2d(dtype=vec),
    ):
        """(Q3), (Q4). With surface contact the new velocity is v*, and surface.py goes on."""
        world, i = wp.tid()
        here = u[world, i]
        new = v[world, i]
        if running(words, world):
            m = mass[world, i]
            momentum = m * new + constants.dt * gathered(partial, inside, world, i)  # (Q3)
            p[world, i] = momentum
            new = node_velocity(constants, inputs, world, place(constants, inside, i, here), momentum, m)
            here += constants.dt * new  # (Q4)
        if wp.static(not surface):
            new_u[world, i] = here
        new_v[world, i] = new

    return SimpleNamespace(masses=masses, advance=advance, gathered=gathered, place=place)


@kernel_factory
def nodes_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, r, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), nodes(spec)
    real, vec, Constants, Rest = t.real, t.vec, t.Constants, r.Rest
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    node_velocity_adj = grid_adj(spec, wanted).node_velocity_adj
    gathered, place = one.gathered, one.place
    weights, weight, offset = r.weights, r.weight, r.offset
    viscous, surface, moving = spec.viscosity, bool(spec.surface_walls), spec.moving
    module = lagrangian_module(adj_module(spec, wanted) + ".lagrangian")

    @wp.kernel(module=module, enable_backward=False)
    def advance_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        held: int,  # accumulators of one world
        # In:
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        p: wp.array2d(dtype=vec),
        # In and out:
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        # Out:
        adj_f: wp.array2d(dtype=vec),
        # Out, added into:
        adj_mass: wp.array2d(dtype=real),
        adj_inputs: GridInputsAdj,
    ):
        """(Q4.adj), (Q3.adj)"""
        world, i = wp.tid()
        m = mass[world, i]
        here = place(constants, inside, i, u[world, i])
        adj_new = adj_v[world, i]
        if wp.static(not surface):  # else done already
            adj_new += constants.dt * adj_u[world, i]
        number = world * held + i
        adj = node_velocity_adj(constants, inputs, world, here, p[world, i], m, adj_new, number, adj_inputs)
        adj_f[world, i] = constants.dt * adj.p
        adj_v[world, i] = m * adj.p
        if wp.static(moving):
            adj_u[world, i] = adj_u[world, i] + adj.x
        adj_mass[world, i] = adj_mass[world, i] + adj.m + wp.dot(v[world, i], adj.p)

    @wp.kernel(module=module, enable_backward=False)
    def gather_adj(
        # Parameters:
        inside: Rest,
        # In:
        partial_u: wp.array3d(dtype=vec),
        partial_v: wp.array3d(dtype=vec),
        # Out, added into:
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
    ):
        """What the forces of a substep give to its displacements and velocities (Q1.adj)."""
        world, i = wp.tid()
        adj_u[world, i] = adj_u[world, i] + gathered(partial_u, inside, world, i)
        if wp.static(viscous):
            adj_v[world, i] = adj_v[world, i] + gathered(partial_v, inside, world, i)

    @wp.kernel(module=module, enable_backward=False)
    def masses_adj(inside: Rest, adj_mass: wp.array2d(dtype=real), adj_inputs: ParticleInputsAdj):
        """(Q2.adj)"""
        world, c = wp.tid()
        for at in range(inside.first[c], inside.first[c + 1]):
            w = weights(inside.fraction[at])
            total = real(0.0)
            for n in range(r.count):
                total += weight(w, offset(n)) * adj_mass[world, inside.cell_nodes[c, n]]
            p = inside.particles[at]
            if wp.static("material" in wanted):
                adj_inputs.mass[world, p] = adj_inputs.mass[world, p] + total

    return SimpleNamespace(advance_adj=advance_adj, gather_adj=gather_adj, masses_adj=masses_adj)
