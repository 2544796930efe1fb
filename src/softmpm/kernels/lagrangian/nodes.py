"""Motion of the nodes. Derivation: docs/math/lagrangian.md.

    v* = exp(−γ Δt) w,  w = v + dv,  dv = Δt (f/m + g)                                               (Q3)
    v' = W(v*) at X + shift + u,  u' = u − d + Δt v'                                                 (Q4), (Q9)
    v̄' += Δt ū'                                                                                      (Q4.adj)
    p̄ and m̄ by (G1.adj) for p = m v + Δt f,  f̄ = Δt p̄,  v̄ = m p̄,  m̄ += v·p̄                          (Q3.adj)

What rounding keeps from w and from u' is added in the next substep (Q12). (Q3) and (Q4) are the grid stage (G1), (G2) of the
momentum p. The side of a wall on which a node lies is constant in the adjoint; the speed of a wall that turns depends on the place of
the node.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous, recent
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.node_sums import gathering
from softmpm.kernels.lagrangian.portions import end_of, first_of
from softmpm.kernels.lagrangian.record import record
from softmpm.kernels.lagrangian.rest import LAGRANGIAN, rest
from softmpm.kernels.lagrangian.rows import rows
from softmpm.kernels.physics import status
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.grid_adj import grid_adj
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def nodes(spec: Spec) -> SimpleNamespace:
    t, r, g = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), grid(spec)
    real, vec, Constants, Rest = t.real, t.vec, t.Constants, r.Rest
    exact_vec, GridInputs = types(spec.dim, "float64").vec, input_types(spec).GridInputs
    position = g.position
    increment = g.increment
    after_free = g.after_free
    sums = gathering(spec.dim, spec.dtype)
    Entries = sums.Entries
    entries_of = sums.entries_of
    gathered = sums.gathered
    surface = bool(spec.surface_walls)
    done_here = not (surface and spec.constrained)  # nodes that no surface points act on
    f, running = frame(spec.dim, spec.dtype), status.report(spec.dim, spec.dtype).running
    Frame, recentring, exact, memory = f.Frame, f.recentring, f.exact, chunk(spec.dim, spec.dtype)
    Chunk, state_of, u_of, store = memory.Chunk, memory.state_of, memory.u_of, record(spec).store
    lost, moved = memory.lost, memory.moved
    row = rows(spec.dim, spec.dtype)

    @wp.func_native(recent(t.c_name, "world, i"))
    def load_mass(values: wp.array2d(dtype=real), world: int, i: int) -> real: ...

    @wp.struct
    class Node:
        """Data of a node that are the same in every substep of a chunk."""

        rest: exact_vec  # its position at rest [m]
        m: real
        per_m: real  # 1/m, or 0
        entries: Entries
        touched: int  # its number among those that surface points act on, or -1

    @wp.func
    def node_of(constants: Constants, inside: Rest, mass: wp.array2d(dtype=real), world: int, i: int) -> Node:
        out = Node()
        out.m = load_mass(mass, world, i)
        out.per_m = wp.where(out.m > real(0.0), real(1.0) / out.m, real(0.0))
        out.entries = entries_of(inside, i)
        out.rest = position(constants, inside.nodes[i])
        out.touched = int(-1)
        if wp.static(surface):
            out.touched = inside.touched[i]
        return out

    @wp.func
    def advance_at(
        world: int,
        i: int,
        node: Node,
        constants: Constants,
        inputs: GridInputs,
        body: Frame,
        at: Chunk,
        s: int,
    ):
        """(Q3), (Q4). Where surface points act on a node, the velocity without contact goes to ``free``, and surface.py goes on."""
        now = state_of(at, s)
        then = state_of(at, s + 1)
        u = row(at.u, u_of(at, s), world)
        new_u = row(at.u, u_of(at, s + 1), world)
        lost_u = row(at.low, world, 0)
        lost_v = row(at.low, world, 1)
        here = u[i]  # all of it loaded while the status is awaited
        low_u = lost_u[i]
        low_v = lost_v[i]
        middle = u[body.middle]
        new = row(at.v, now, world)[i]
        shift = at.shift[now, world]
        f = gathered(row(at.partial, world), node.entries)
        d = vec()
        if running(at.words, world):
            d = recentring(body, middle)
            x = node.rest + shift + exact(here)
            dv = increment(constants, inputs, world, constants.dt * f, node.per_m) + low_v
            low_v = lost(new, dv)
            w = new + dv
            store(at, world, i, node.touched, s, w)
            new = after_free(constants, inputs, world, x, w, node.m)  # (Q3)
            here, low_u = moved(here, d, constants.dt, new, low_u)  # (Q4)
        lost_v[i] = low_v
        if i == 0:
            at.shift[then, world] = shift + exact(d)
        if wp.static(surface):
            row(at.free, world)[i] = new
        if wp.static(done_here):
            if node.touched < 0:
                new_u[i] = here
                lost_u[i] = low_u
                row(at.v, then, world)[i] = new

    @kernel(LAGRANGIAN)
    def advance(
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        body: Frame,
        at: Chunk,
        s: int,
    ):
        world, k = wp.tid()
        for i in range(first_of(k), end_of(k, inside.nodes.shape[0])):
            node = node_of(constants, inside, at.mass, world, i)
            await_previous()  # the forces
            advance_at(world, i, node, constants, inputs, body, at, s)

    return SimpleNamespace(Node=Node, node_of=node_of, advance=advance, advance_at=advance_at)


@kernel_factory
def nodes_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, r, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), nodes(spec)
    real, vec, exact_vec, Constants, Rest = t.real, t.vec, types(spec.dim, "float64").vec, t.Constants, r.Rest
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    after_free_adj, sums = grid_adj(spec, wanted).after_free_adj, gathering(spec.dim, spec.dtype)
    entries_of, gathered, Node, node_of = sums.entries_of, sums.gathered, one.Node, one.node_of
    viscous, surface, moving = spec.viscosity, bool(spec.surface_walls), spec.moving
    constrained = spec.constrained
    memory = chunk(spec.dim, spec.dtype)
    exact = frame(spec.dim, spec.dtype).exact
    Chunk, Adjoint, stored = memory.Chunk, memory.Adjoint, record(spec).stored
    row = rows(spec.dim, spec.dtype)

    @wp.struct
    class Before:
        """A node before a substep."""

        x: exact_vec  # [m]
        v: vec
        w: vec  # after the substep, without damping, walls, contact and constraints

    @wp.struct
    class NodeAdj:
        u: vec
        v: vec
        m: real

    @wp.func
    def before(world: int, i: int, node: Node, at: Chunk, s: int) -> Before:
        out = Before()
        out.x = node.rest + at.shift[s, world] + exact(row(at.u, s, world)[i])
        out.v = row(at.v, s, world)[i]
        out.w = stored(at, world, i, node.touched, s)
        return out

    @wp.func
    def adj_of(world: int, i: int, bar: Adjoint) -> NodeAdj:
        out = NodeAdj()
        out.u = row(bar.u, world)[i]
        out.v = row(bar.v, world)[i]
        out.m = row(bar.mass, world)[i]
        return out

    @wp.func
    def complete(world: int, i: int, node: Node, at: Chunk, bar: Adjoint, s: int) -> NodeAdj:
        """Adjoint of a node after substep ``s``, with what the forces of the next one give, unless it has been added already."""
        out = adj_of(world, i, bar)
        if wp.static(not constrained):
            if s < at.length - 1:
                out.u += gathered(row(bar.partial_u, world), node.entries)  # (Q1.adj)
                if wp.static(viscous):
                    out.v += gathered(row(bar.partial_v, world), node.entries)
        return out

    @wp.func
    def moved_adj(
        world: int,
        i: int,
        node: Node,
        was: Before,
        after: NodeAdj,
        constants: Constants,
        inputs: GridInputs,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
    ):
        """(Q3.adj) of a node, from v̄', m̄ and ū."""
        number = world * bar.held + i
        adj = after_free_adj(
            constants, inputs, world, was.x, was.w, node.m, node.per_m, after.v, number, adj_inputs
        )
        row(bar.mass, world)[i] = after.m + adj.m + wp.dot(was.v, adj.p)
        row(bar.f, world)[i] = constants.dt * adj.p
        row(bar.v, world)[i] = node.m * adj.p
        adj_u = after.u
        if wp.static(moving):
            adj_u += adj.x
        row(bar.u, world)[i] = adj_u

    @wp.func
    def advance_adj_at(
        world: int,
        i: int,
        node: Node,
        constants: Constants,
        inputs: GridInputs,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
    ):
        """(Q4.adj), (Q3.adj); after surface contact v̄' has been computed already."""
        was = before(world, i, node, at, s)  # all of it loaded before anything is stored
        adj = complete(world, i, node, at, bar, s)
        if wp.static(not surface):
            adj.v += constants.dt * adj.u
        moved_adj(world, i, node, was, adj, constants, inputs, bar, adj_inputs)

    @kernel(LAGRANGIAN)
    def advance_adj(
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
    ):
        world, k = wp.tid()
        for i in range(first_of(k), end_of(k, inside.nodes.shape[0])):
            node = node_of(constants, inside, at.mass, world, i)
            await_previous()  # the adjoints
            advance_adj_at(world, i, node, constants, inputs, at, bar, adj_inputs, s)

    @kernel(LAGRANGIAN)
    def gather_adj(inside: Rest, bar: Adjoint):
        """Add what the forces of a substep give to its displacements and velocities (Q1.adj)."""
        world, k = wp.tid()
        for i in range(first_of(k), end_of(k, inside.nodes.shape[0])):
            entries = entries_of(inside, i)
            await_previous()  # the adjoints
            bar.u[world, i] = bar.u[world, i] + gathered(row(bar.partial_u, world), entries)
            if wp.static(viscous):
                bar.v[world, i] = bar.v[world, i] + gathered(row(bar.partial_v, world), entries)

    return SimpleNamespace(
        before=before,
        adj_of=adj_of,
        complete=complete,
        moved_adj=moved_adj,
        advance_adj=advance_adj,
        advance_adj_at=advance_adj_at,
        gather_adj=gather_adj,
    )
