"""Motion of the nodes. Derivation: docs/math/lagrangian.md.

    v* = exp(−γ Δt) (p/m + Δt g),  p = m v + Δt f                                                    (Q3)
    v' = W(v*) at X + shift + u,  u' = u − d + Δt v'                                                 (Q4), (Q9)
    v̄' += Δt ū'                                                                                      (Q4.adj)
    p̄ and m̄ by (G1.adj),  f̄ = Δt p̄,  v̄ = m p̄,  m̄ += v·p̄                                            (Q3.adj)

(Q3) and (Q4) are the grid stage (G1), (G2) of the momentum p. The side of a wall on which a node lies is constant in the adjoint; the
speed of a wall that turns depends on the place of the node.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.rest import lagrangian_module, rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.grid import grid, grid_adj
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def gathering(dim: int, dtype: str):
    vec, Rest, most = types(dim, dtype).vec, rest(dim, dtype).Rest, 2**dim
    entries = wp.types.vector(most, wp.int32)

    @wp.func
    def gathered(partial: wp.array2d(dtype=vec), inside: Rest, world: int, i: int) -> vec:
        """Sum of what the bricks around a node have for it, in a fixed order. Loads without branches wait for memory together."""
        entry = entries()
        for n in range(most):
            entry[n] = inside.shares[n, i]
        total = vec()
        for n in range(most):
            share = partial[world, wp.max(entry[n], 0)]
            if entry[n] >= 0:
                total += share
        return total

    return gathered


@kernel_factory
def nodes(spec: Spec) -> SimpleNamespace:
    t, r, g = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), grid(spec)
    real, vec, Constants, Rest = t.real, t.vec, t.Constants, r.Rest
    exact_vec, GridInputs = types(spec.dim, "float64").vec, input_types(spec).GridInputs
    position, node_velocity = g.position, g.node_velocity
    gathered, surface = gathering(spec.dim, spec.dtype), bool(spec.surface_walls)
    apart = surface and not spec.constrained  # nodes that no surface points act on are done here
    f, running = frame(spec.dim, spec.dtype), status.report(spec.dim, spec.dtype).running
    Frame, recentring, exact = f.Frame, f.recentring, f.exact
    module = lagrangian_module(spec.module + ".lagrangian")

    @wp.func
    def place(constants: Constants, inside: Rest, i: int, shift: exact_vec, u: vec) -> exact_vec:
        """Present position of a node [m]."""
        return position(constants, inside.nodes[i]) + shift + exact(u)

    @wp.func
    def advance_at(
        world: int,
        i: int,
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        body: Frame,
        mass: wp.array2d(dtype=real),
        partial: wp.array2d(dtype=vec),
        words: wp.array(dtype=wp.int64),
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        # Out:
        p: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        new_shift: wp.array(dtype=exact_vec),
        new_u: wp.array2d(dtype=vec),
        new_v: wp.array2d(dtype=vec),
    ):
        """(Q3), (Q4). Where surface points act on a node, the velocity without contact goes to ``free``, and surface.py goes on."""
        here = u[world, i]  # all of it loaded while the status is awaited
        middle = u[world, body.middle]
        new = v[world, i]
        m = mass[world, i]
        f = gathered(partial, inside, world, i)
        x = place(constants, inside, i, shift[world], here)
        d = vec()
        if running(words, world):
            d = recentring(body, middle)
            momentum = m * new + constants.dt * f  # (Q3)
            p[world, i] = momentum
            new = node_velocity(constants, inputs, world, x, momentum, m)
            here = (here - d) + constants.dt * new  # (Q4)
        if i == 0:
            new_shift[world] = shift[world] + exact(d)
        if wp.static(surface):
            free[world, i] = new
        if wp.static(apart):
            if inside.touched[i] == 0:
                new_u[world, i] = here
                new_v[world, i] = new
        if wp.static(not surface):
            new_u[world, i] = here
            new_v[world, i] = new

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        body: Frame,
        mass: wp.array2d(dtype=real),
        partial: wp.array2d(dtype=vec),
        words: wp.array(dtype=wp.int64),
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        # Out:
        p: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        new_shift: wp.array(dtype=exact_vec),
        new_u: wp.array2d(dtype=vec),
        new_v: wp.array2d(dtype=vec),
    ):
        world, i = wp.tid()
        advance_at(
            world,
            i,
            constants,
            inputs,
            inside,
            body,
            mass,
            partial,
            words,
            shift,
            u,
            v,
            p,
            free,
            new_shift,
            new_u,
            new_v,
        )

    return SimpleNamespace(advance=advance, advance_at=advance_at, place=place)


@kernel_factory
def nodes_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, r, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), nodes(spec)
    real, vec, Constants, Rest = t.real, t.vec, t.Constants, r.Rest
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    node_velocity_adj = grid_adj(spec, wanted).node_velocity_adj
    gathered, place, exact_vec = gathering(spec.dim, spec.dtype), one.place, types(spec.dim, "float64").vec
    viscous, surface, moving = spec.viscosity, bool(spec.surface_walls), spec.moving
    module = lagrangian_module(adj_module(spec, wanted) + ".lagrangian")

    @wp.func
    def moved_adj(
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        held: int,  # accumulators of one world
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        p: wp.array2d(dtype=vec),
        world: int,
        i: int,
        adj_new: vec,
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        adj_f: wp.array2d(dtype=vec),
        adj_mass: wp.array2d(dtype=real),
        adj_inputs: GridInputsAdj,
    ):
        """(Q3.adj) of a node, from v̄'."""
        m = mass[world, i]
        here = place(constants, inside, i, shift[world], u[world, i])
        number = world * held + i
        adj = node_velocity_adj(constants, inputs, world, here, p[world, i], m, adj_new, number, adj_inputs)
        adj_mass[world, i] = adj_mass[world, i] + adj.m + wp.dot(v[world, i], adj.p)
        adj_f[world, i] = constants.dt * adj.p
        adj_v[world, i] = m * adj.p
        if wp.static(moving):
            adj_u[world, i] = adj_u[world, i] + adj.x

    @wp.func
    def gather(
        inside: Rest,
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
        world: int,
        i: int,
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
    ):
        """What the forces of a substep give to its displacements and velocities (Q1.adj)."""
        adj_u[world, i] = adj_u[world, i] + gathered(partial_u, inside, world, i)
        if wp.static(viscous):
            adj_v[world, i] = adj_v[world, i] + gathered(partial_v, inside, world, i)

    @wp.func
    def advance_adj_at(
        world: int,
        i: int,
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        held: int,
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        p: wp.array2d(dtype=vec),
        pending: bool,  # whether the partial sums of the substep after are still to be added
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
        # In and out:
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        # Out:
        adj_f: wp.array2d(dtype=vec),
        # Out, added into:
        adj_mass: wp.array2d(dtype=real),
        adj_inputs: GridInputsAdj,
    ):
        """(Q4.adj), (Q3.adj); after surface contact v̄' has been computed already."""
        if pending:
            gather(inside, partial_u, partial_v, world, i, adj_u, adj_v)
        adj_new = adj_v[world, i]
        if wp.static(not surface):
            adj_new += constants.dt * adj_u[world, i]
        moved_adj(
            constants,
            inputs,
            inside,
            mass,
            held,
            shift,
            u,
            v,
            p,
            world,
            i,
            adj_new,
            adj_u,
            adj_v,
            adj_f,
            adj_mass,
            adj_inputs,
        )

    @wp.kernel(module=module, enable_backward=False)
    def advance_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        held: int,
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        p: wp.array2d(dtype=vec),
        pending: bool,  # whether the partial sums of the substep after are still to be added
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
        # In and out:
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        # Out:
        adj_f: wp.array2d(dtype=vec),
        # Out, added into:
        adj_mass: wp.array2d(dtype=real),
        adj_inputs: GridInputsAdj,
    ):
        world, i = wp.tid()
        advance_adj_at(
            world,
            i,
            constants,
            inputs,
            inside,
            mass,
            held,
            shift,
            u,
            v,
            p,
            pending,
            partial_u,
            partial_v,
            adj_u,
            adj_v,
            adj_f,
            adj_mass,
            adj_inputs,
        )

    @wp.kernel(module=module, enable_backward=False)
    def gather_adj(
        # Parameters:
        inside: Rest,
        # In:
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
        # Out, added into:
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
    ):
        world, i = wp.tid()
        gather(inside, partial_u, partial_v, world, i, adj_u, adj_v)

    return SimpleNamespace(
        advance_adj=advance_adj,
        advance_adj_at=advance_adj_at,
        gather_adj=gather_adj,
        gather=gather,
        moved_adj=moved_adj,
    )
