"""Adjoint of contact at surface points (surface.py). Derivation: docs/math/contact.md.

    J̄_s = A_s Σ w_si v̄'_i / m_i,  m̄_i −= (v'_i − v*_i)·v̄'_i / m_i                                   (K5.adj)
    J̄_s += A_s f̄_s / T                                                                               (K7.adj)
    from the last wall to the first: J̄ += D v̄_s,  D̄ += J·v̄_s, then (K4.adj), (K3.adj), (K6.adj)
    v̄*_i += Σ w_si v̄_s,  ū_i += Σ w_si x̄_s                                                           (K2.adj)
    m̄_i −= Σ D̄_s |w_si| L_i / m_i²                                                                   (K1.adj)

The nodes gather x̄_s, v̄_s and D̄_s in a fixed order.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.portions import end_of, first_of
from softmpm.kernels.lagrangian.rest import LAGRANGIAN, rest
from softmpm.kernels.lagrangian.rows import rows
from softmpm.kernels.lagrangian.surface_sums import surface_sums, surface_type
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.wall_face import wall_face_adj, wall_faces
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def surface_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, r, walls = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), wall_faces(spec)
    real, vec, Constants, Rest, dim = t.real, t.vec, t.Constants, r.Rest, spec.dim
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    Surface = surface_type(dim, spec.dtype)
    face_adj = wall_face_adj(spec, wanted)
    after_free = grid(spec).after_free
    faces_of, meet, meet_adj = walls.faces_of, walls.meet, walls.meet_adj
    count, number, vecs, reals = walls.count, walls.number, walls.vecs, walls.reals
    mirrored, constrained, rough = bool(spec.mirrors), spec.constrained, "friction" in wanted
    sums = surface_sums(dim, spec.dtype)
    Point, point_of, at_point, present = sums.Point, sums.point_of, sums.at_point, sums.present
    Touched, touched_of, both_from_points = sums.Touched, sums.touched_of, sums.both_from_points
    Node, node_of = nodes(spec).Node, nodes(spec).node_of
    back, memory = nodes_adj(spec, wanted), chunk(dim, spec.dtype)
    before, adj_of, complete, moved_adj = back.before, back.adj_of, back.complete, back.moved_adj
    Chunk, Adjoint = memory.Chunk, memory.Adjoint
    row = rows(dim, spec.dtype)

    @wp.func
    def settle_adj_at(
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
        """(K5.adj): v* once more, v̄' with what u' gives to it, and v̄' / m. Nodes that no surface points act on are done here."""
        was = before(world, i, node, at, s)  # all of it loaded before anything is stored
        after = row(at.v, s + 1, world)[i]
        free_v = vec()
        if wp.static(mirrored):
            free_v = row(at.free, world)[i]  # reflected already
        adj = complete(world, i, node, at, bar, s)
        adj.v += constants.dt * adj.u
        if node.touched >= 0:
            if wp.static(not mirrored):
                free_v = after_free(constants, inputs, world, was.x, was.w, node.m)
            row(at.free, world)[i] = free_v
            each = node.per_m * adj.v
            row(bar.u, world)[i] = adj.u
            row(bar.v, world)[i] = adj.v
            row(bar.shared, world)[i] = each
            row(bar.mass, world)[i] = adj.m - wp.dot(after - free_v, each)
        else:
            moved_adj(world, i, node, was, adj, constants, inputs, bar, adj_inputs)

    @wp.func
    def press_adj_at(
        world: int,
        p: int,
        point: Point,
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
        anew: int,  # 1 if a control step begins
    ):
        """(K7.adj), and (K4.adj), (K3.adj), (K6.adj) from the last wall to the first."""
        anchor = at.anchor[s]
        # All of it is loaded before anything is stored:
        x = present(point, at_point(body, p, point, row(at.u, s, world)))
        v = at_point(body, p, point, row(at.free, world))
        dv = row(at.D, world)[p]
        per_force = at.rate[0] * point.newtons
        i = world * bar.held + p
        anchored = vecs()
        adj_anchor = vecs()
        pushed = vecs()
        rubbed = reals()
        for q in range(count):
            anchored[q] = row(anchor, world, q)[p]
            adj_anchor[q] = row(bar.anchor, world, q)[p]
            pushed[q] = row(bar.force, world, q)[p]
            if wp.static(rough):
                rubbed[q] = row(adj_inputs.friction, number[q])[i]
        wall = faces_of(constants, inputs, world, x + at.shift[s, world], anchored)
        adj_D = row(bar.D, world)[p]
        adj_J = point.area * at_point(body, p, point, row(bar.shared, world))
        reached = vecs()
        for q in range(count):
            reached[q] = v
            found = meet(constants, wall, q, point.stiffness, body.width, vec(x), v, dv)
            v += dv * found.J
        back_x = vec()
        back_v = vec()
        after = v
        for back in range(count):
            q = count - 1 - back
            k = number[q]
            here = reached[q]
            adj = meet_adj(
                constants,
                wall,
                q,
                point.stiffness,
                body.width,
                vec(x),
                here,
                dv,
                adj_J + dv * back_v + per_force * pushed[q],
                adj_anchor[q],
            )
            adj_D += wp.dot(after - here, back_v) / dv + adj.D
            back_v += adj.v
            back_x += adj.x
            adj_anchor[q] = face_adj(
                constants, inputs, world, k, anchored[q], adj.n, adj.y, adj.anchor, i, adj_inputs
            )
            rubbed[q] += adj.friction
            after = here
        for q in range(count):
            row(bar.anchor, world, q)[p] = adj_anchor[q]
            if anew == 1:  # the mean before is dropped
                row(bar.force, world, q)[p] = vec()
            if wp.static(rough):
                row(adj_inputs.friction, number[q])[i] = rubbed[q]
        row(bar.x, world)[p] = back_x
        row(bar.free, world)[p] = back_v
        row(bar.D, world)[p] = adj_D

    @wp.func
    def spread_adj_at(
        world: int,
        lane: int,
        entry: Touched,
        node: Node,
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
    ):
        """(K2.adj), then (Q3.adj), at the nodes that surface points act on; the adjoint of constraints comes between."""
        i = entry.i
        was = before(world, i, node, at, s)  # all of it loaded before anything is stored
        adj = adj_of(world, i, bar)
        back_x, back_v = both_from_points(body, entry, row(bar.x, world), row(bar.free, world))
        adj.u += back_x
        adj.v += back_v
        if lane == 0:
            if wp.static(constrained):
                row(bar.u, world)[i] = adj.u
                row(bar.v, world)[i] = adj.v
            else:
                moved_adj(world, i, node, was, adj, constants, inputs, bar, adj_inputs)

    @kernel(LAGRANGIAN)
    def settle_adj(
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
            settle_adj_at(world, i, node, constants, inputs, at, bar, adj_inputs, s)

    @kernel(LAGRANGIAN)
    def press_adj(
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
        anew: int,
    ):
        world, k = wp.tid()
        for p in range(first_of(k), end_of(k, body.points.shape[0])):
            point = point_of(body, p)
            await_previous()  # the adjoints
            press_adj_at(world, p, point, constants, inputs, body, at, bar, adj_inputs, s, anew)

    @kernel(LAGRANGIAN)
    def spread_adj(
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        body: Surface,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
    ):
        world, k, lane = wp.tid()
        for n in range(first_of(k), end_of(k, body.nodes.shape[0])):
            entry = touched_of(body, n, lane)
            node = node_of(constants, inside, at.mass, world, entry.i)
            await_previous()  # the adjoints
            spread_adj_at(world, lane, entry, node, constants, inputs, body, at, bar, adj_inputs, s)

    @kernel(LAGRANGIAN)
    def delassus_adj(
        body: Surface,
        mass: wp.array2d(dtype=real),
        adj_D: wp.array2d(dtype=real),
        adj_mass: wp.array2d(dtype=real),
    ):
        """(K1.adj)"""
        world, n = wp.tid()
        i = body.nodes[n]
        total = real(0.0)
        for m in range(body.first[n], body.first[n + 1]):
            total += wp.abs(body.shares[m]) * adj_D[world, body.members[m]]
        if body.first[n + 1] > body.first[n]:
            square = mass[world, i] * mass[world, i]
            adj_mass[world, i] = adj_mass[world, i] - total * body.loads[i] / square

    return SimpleNamespace(
        settle_adj_at=settle_adj_at,
        press_adj_at=press_adj_at,
        spread_adj_at=spread_adj_at,
        settle_adj=settle_adj,
        press_adj=press_adj,
        spread_adj=spread_adj,
        delassus_adj=delassus_adj,
    )
