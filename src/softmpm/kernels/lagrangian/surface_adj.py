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

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.rest import lagrangian_module, rest
from softmpm.kernels.lagrangian.surface import surface, surface_type
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face_adj
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def surface_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, r, one = types(spec.dim, spec.dtype), rest(spec.dim, spec.dtype), surface(spec)
    real, vec, Constants, Rest, dim = t.real, t.vec, t.Constants, r.Rest, spec.dim
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    Surface, block, count = (
        surface_type(dim, spec.dtype),
        surface_contact(dim, spec.dtype),
        len(spec.surface_walls),
    )
    touch, touch_adj, number = block.touch, block.touch_adj, one.number
    faces_of, face_adj, present = one.faces_of, wall_face_adj(spec, wanted), one.present
    at_point, from_points, node_velocity = one.at_point, one.from_points, grid(spec).node_velocity
    mirrored, constrained = bool(spec.mirrors), spec.constrained
    place, vecs, back = nodes(spec).place, one.vecs, nodes_adj(spec, wanted)
    gather_pending, moved_adj, memory = back.gather_pending, back.moved_adj, chunk(dim, spec.dtype)
    Chunk, Adjoint = memory.Chunk, memory.Adjoint
    module = lagrangian_module(adj_module(spec, wanted) + ".lagrangian")

    @wp.func
    def settle_adj_at(
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
        """(K5.adj): v* once more, v̄' with what u' gives to it, and v̄' / m. Nodes that no surface points act on are done here."""
        gather_pending(world, i, inside, at, bar, s)
        adj = bar.v[world, i] + constants.dt * bar.u[world, i]
        if inside.touched[i] == 1:
            m = at.mass[world, i]
            x = place(constants, inside, i, at.shift[s, world], at.u[s, world, i])
            free_v = node_velocity(constants, inputs, world, x, at.p[s, world, i], m)
            if wp.static(mirrored):
                free_v = at.free[world, i]  # reflected already
            at.free[world, i] = free_v
            bar.v[world, i] = adj
            each = vec()
            if m > real(0.0):
                each = adj / m
            bar.shared[world, i] = each
            bar.mass[world, i] = bar.mass[world, i] - wp.dot(at.v[s + 1, world, i] - free_v, each)
        else:
            moved_adj(world, i, constants, inputs, inside, at, bar, adj_inputs, s, adj)

    @wp.func
    def press_adj_at(
        world: int,
        p: int,
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
        u = at.u[s]
        anchor = at.anchor[s]
        x = present(body, p, at_point(body, u, world, p))
        v = at_point(body, at.free, world, p)
        dv = at.D[world, p]
        stiffness = body.stiffness[p]
        per_force = at.rate[0] * body.newtons[p]
        wall = faces_of(constants, inputs, anchor, world, p, x + at.shift[s, world])
        before = vecs()
        adj_after = vecs()
        pushed = vecs()
        for q in range(count):
            before[q] = anchor[world, q, p]
            adj_after[q] = bar.anchor[world, q, p]
            pushed[q] = bar.force[world, q, p]
        adj_J = body.areas[p] * at_point(body, bar.shared, world, p)
        reached = vecs()
        for q in range(count):
            reached[q] = v
            found = touch(
                wall.n[q],
                wall.y[q],
                vec(x),
                v,
                wall.anchor[q],
                dv,
                wall.friction[q],
                stiffness,
                constants.dt,
                body.width,
                constants.spacing,
            )
            v += dv * found.J
        back_x = vec()
        back_v = vec()
        total_D = real(0.0)
        after = v
        i = world * bar.held + p
        for back in range(count):
            q = count - 1 - back
            k = number[q]
            here = reached[q]
            adj = touch_adj(
                wall.n[q],
                wall.y[q],
                vec(x),
                here,
                wall.anchor[q],
                dv,
                wall.friction[q],
                stiffness,
                constants.dt,
                body.width,
                constants.spacing,
                adj_J + dv * back_v + per_force * pushed[q],
                adj_after[q],
            )
            total_D += wp.dot(after - here, back_v) / dv + adj.D
            back_v += adj.v
            back_x += adj.x
            bar.anchor[world, q, p] = face_adj(
                constants, inputs, world, k, before[q], adj.n, adj.y, adj.anchor, i, adj_inputs
            )
            if anew == 1:  # the mean before is dropped
                bar.force[world, q, p] = vec()
            if wp.static("friction" in wanted):
                adj_inputs.friction[k, i] = adj_inputs.friction[k, i] + adj.friction
            after = here
        bar.x[world, p] = back_x
        bar.free[world, p] = back_v
        bar.D[world, p] = bar.D[world, p] + total_D

    @wp.func
    def spread_adj_at(
        world: int,
        n: int,
        lane: int,
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        body: Surface,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
    ):
        """(K2.adj), then (Q3.adj), at the nodes that surface points act on; the adjoint of constraints comes between."""
        i = body.nodes[n]
        more_u = from_points(body, bar.x, world, n, lane)
        more_v = from_points(body, bar.free, world, n, lane)
        if lane == 0:
            bar.u[world, i] = bar.u[world, i] + more_u
            adj_new = bar.v[world, i] + more_v
            if wp.static(constrained):
                bar.v[world, i] = adj_new
            else:
                moved_adj(world, i, constants, inputs, inside, at, bar, adj_inputs, s, adj_new)

    @wp.kernel(module=module, enable_backward=False)
    def settle_adj(
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: GridInputsAdj,
        s: int,
    ):
        world, i = wp.tid()
        settle_adj_at(world, i, constants, inputs, inside, at, bar, adj_inputs, s)

    @wp.kernel(module=module, enable_backward=False)
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
        world, p = wp.tid()
        press_adj_at(world, p, constants, inputs, body, at, bar, adj_inputs, s, anew)

    @wp.kernel(module=module, enable_backward=False)
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
        world, n, lane = wp.tid()
        spread_adj_at(world, n, lane, constants, inputs, inside, body, at, bar, adj_inputs, s)

    @wp.kernel(module=module, enable_backward=False)
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
