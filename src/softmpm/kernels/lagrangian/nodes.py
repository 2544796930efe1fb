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
from softmpm.kernels.lagrangian.chunk import chunk
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
    vec, Constants, Rest = t.vec, t.Constants, r.Rest
    exact_vec, GridInputs = types(spec.dim, "float64").vec, input_types(spec).GridInputs
    position, node_velocity = g.position, g.node_velocity
    gathered, surface = gathering(spec.dim, spec.dtype), bool(spec.surface_walls)
    apart = surface and not spec.constrained  # nodes that no surface points act on are done here
    f, running = frame(spec.dim, spec.dtype), status.report(spec.dim, spec.dtype).running
    Frame, recentring, exact, memory = f.Frame, f.recentring, f.exact, chunk(spec.dim, spec.dtype)
    Chunk, state_of, momenta_of = memory.Chunk, memory.state_of, memory.momenta_of
    module = lagrangian_module(spec.module + ".lagrangian")

    @wp.func
    def place(constants: Constants, inside: Rest, i: int, shift: exact_vec, u: vec) -> exact_vec:
        """Present position of a node [m]."""
        return position(constants, inside.nodes[i]) + shift + exact(u)

    @wp.func
    def advance_at(
        world: int,
        i: int,
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        body: Frame,
        at: Chunk,
        s: int,
    ):
        """(Q3), (Q4). Where surface points act on a node, the velocity without contact goes to ``free``, and surface.py goes on."""
        now = state_of(at, s)
        then = state_of(at, s + 1)
        p = momenta_of(at, s)
        here = at.u[now, world, i]  # all of it loaded while the status is awaited
        middle = at.u[now, world, body.middle]
        new = at.v[now, world, i]
        m = at.mass[world, i]
        f = gathered(at.partial, inside, world, i)
        x = place(constants, inside, i, at.shift[now, world], here)
        d = vec()
        if running(at.words, world):
            d = recentring(body, middle)
            momentum = m * new + constants.dt * f  # (Q3)
            at.p[p, world, i] = momentum
            new = node_velocity(constants, inputs, world, x, momentum, m)
            here = (here - d) + constants.dt * new  # (Q4)
        if i == 0:
            at.shift[then, world] = at.shift[now, world] + exact(d)
        if wp.static(surface):
            at.free[world, i] = new
        if wp.static(apart):
            if inside.touched[i] == 0:
                at.u[then, world, i] = here
                at.v[then, world, i] = new
        if wp.static(not surface):
            at.u[then, world, i] = here
            at.v[then, world, i] = new

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        body: Frame,
        at: Chunk,
        s: int,
    ):
        world, i = wp.tid()
        advance_at(world, i, constants, inputs, inside, body, at, s)

    return SimpleNamespace(advance=advance, advance_at=advance_at, place=place)


@kernel_factory
def nodes_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, r, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), nodes(spec)
    vec, Constants, Rest = t.vec, t.Constants, r.Rest
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    node_velocity_adj = grid_adj(spec, wanted).node_velocity_adj
    gathered, place = gathering(spec.dim, spec.dtype), one.place
    viscous, surface, moving = spec.viscosity, bool(spec.surface_walls), spec.moving
    constrained, memory = spec.constrained, chunk(spec.dim, spec.dtype)
    Chunk, Adjoint = memory.Chunk, memory.Adjoint
    module = lagrangian_module(adj_module(spec, wanted) + ".lagrangian")

    @wp.func
    def moved_adj(
        world: int,
        i: int,
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
        adj_new: vec,
    ):
        """(Q3.adj) of a node, from v̄'."""
        m = at.mass[world, i]
        here = place(constants, inside, i, at.shift[s, world], at.u[s, world, i])
        p = at.p[s, world, i]
        number = world * bar.held + i
        adj = node_velocity_adj(constants, inputs, world, here, p, m, adj_new, number, adj_inputs)
        bar.mass[world, i] = bar.mass[world, i] + adj.m + wp.dot(at.v[s, world, i], adj.p)
        bar.f[world, i] = constants.dt * adj.p
        bar.v[world, i] = m * adj.p
        if wp.static(moving):
            bar.u[world, i] = bar.u[world, i] + adj.x

    @wp.func
    def gather(world: int, i: int, inside: Rest, bar: Adjoint):
        """What the forces of a substep give to its displacements and velocities (Q1.adj)."""
        bar.u[world, i] = bar.u[world, i] + gathered(bar.partial_u, inside, world, i)
        if wp.static(viscous):
            bar.v[world, i] = bar.v[world, i] + gathered(bar.partial_v, inside, world, i)

    @wp.func
    def gather_pending(world: int, i: int, inside: Rest, at: Chunk, bar: Adjoint, s: int):
        """What the forces of the substep after ``s`` have given, unless it has been added already."""
        if wp.static(not constrained):
            if s < at.length - 1:
                gather(world, i, inside, bar)

    @wp.func
    def advance_adj_at(
        world: int,
        i: int,
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
    ):
        """(Q4.adj), (Q3.adj); after surface contact v̄' has been computed already."""
        gather_pending(world, i, inside, at, bar, s)
        adj_new = bar.v[world, i]
        if wp.static(not surface):
            adj_new += constants.dt * bar.u[world, i]
        moved_adj(world, i, constants, inputs, inside, at, bar, adj_inputs, s, adj_new)

    @wp.kernel(module=module, enable_backward=False)
    def advance_adj(
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
    ):
        world, i = wp.tid()
        advance_adj_at(world, i, constants, inputs, inside, at, bar, adj_inputs, s)

    @wp.kernel(module=module, enable_backward=False)
    def gather_adj(inside: Rest, bar: Adjoint):
        world, i = wp.tid()
        gather(world, i, inside, bar)

    return SimpleNamespace(
        advance_adj=advance_adj,
        advance_adj_at=advance_adj_at,
        gather_adj=gather_adj,
        gather_pending=gather_pending,
        moved_adj=moved_adj,
    )
