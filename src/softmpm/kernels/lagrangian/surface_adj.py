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
from softmpm.kernels.lagrangian.nodes import nodes
from softmpm.kernels.lagrangian.rest import lagrangian_module, rest
from softmpm.kernels.lagrangian.surface import surface, surface_type
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face, wall_face_adj
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
    face, face_adj = wall_face(spec).face, wall_face_adj(spec, wanted)
    friction_of, present = one.friction_of, one.present
    at_point, from_points, node_velocity = one.at_point, one.from_points, grid(spec).node_velocity
    exact_vec, mirrored = types(dim, "float64").vec, bool(spec.mirrors)
    arms, place, before_wall = r.count, nodes(spec).place, wp.types.matrix((count, dim), real)
    module = lagrangian_module(adj_module(spec, wanted) + ".lagrangian")

    @wp.kernel(module=module, enable_backward=False)
    def settle_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        p: wp.array2d(dtype=vec),
        new_v: wp.array2d(dtype=vec),
        adj_u: wp.array2d(dtype=vec),
        # In and out:
        adj_v: wp.array2d(dtype=vec),
        # Out, with clamps in:
        free: wp.array2d(dtype=vec),
        # Out:
        shared: wp.array2d(dtype=vec),
        # Out, added into:
        adj_mass: wp.array2d(dtype=real),
    ):
        """(K5.adj): v* once more, v̄' with what u' gives to it, and v̄' / m."""
        world, i = wp.tid()
        m = mass[world, i]
        x = place(constants, inside, i, shift[world], u[world, i])
        v = node_velocity(constants, inputs, world, x, p[world, i], m)
        if wp.static(mirrored):
            v = free[world, i]  # reflected already
        adj = adj_v[world, i] + constants.dt * adj_u[world, i]
        free[world, i] = v
        adj_v[world, i] = adj
        each = vec()
        if m > real(0.0):
            each = adj / m
        shared[world, i] = each
        adj_mass[world, i] = adj_mass[world, i] - wp.dot(new_v[world, i] - v, each)

    @wp.kernel(module=module, enable_backward=False)
    def press_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        smoothing: real,
        D: wp.array2d(dtype=real),
        held: int,  # accumulators of one world
        rate: wp.array(dtype=real),  # 1/T
        anew: int,  # 1 at the beginning of a control step
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        anchor: wp.array3d(dtype=vec),
        shared: wp.array2d(dtype=vec),
        # In and out:
        adj_force: wp.array3d(dtype=vec),
        adj_anchor: wp.array3d(dtype=vec),
        # Out:
        adj_x: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        # Out, added into:
        adj_D: wp.array2d(dtype=real),
        adj_inputs: GridInputsAdj,
    ):
        world, p = wp.tid()
        x = present(body, p, at_point(body, u, world, p))
        v = at_point(body, free, world, p)
        dv = D[world, p]
        reached = before_wall()
        for q in range(count):
            for axis in range(dim):
                reached[q, axis] = v[axis]
            k = number[q]
            wall = face(constants, inputs, world, k, x + shift[world], anchor[world, q, p])
            found = touch(
                wall.n,
                wall.y,
                vec(x),
                v,
                wall.anchor,
                dv,
                friction_of(inputs, world, k),
                body.stiffness[p],
                constants.dt,
                smoothing,
            )
            v += dv * found.J
        adj_J = body.areas[p] * at_point(body, shared, world, p)
        back_x = vec()
        back_v = vec()
        total_D = real(0.0)
        after = v
        i = world * held + p
        for back in range(count):
            q = count - 1 - back
            k = number[q]
            here = vec()
            for axis in range(dim):
                here[axis] = reached[q, axis]
            wall = face(constants, inputs, world, k, x + shift[world], anchor[world, q, p])
            adj = touch_adj(
                wall.n,
                wall.y,
                vec(x),
                here,
                wall.anchor,
                dv,
                friction_of(inputs, world, k),
                body.stiffness[p],
                constants.dt,
                smoothing,
                adj_J + dv * back_v + (rate[0] * body.newtons[p]) * adj_force[world, q, p],
                adj_anchor[world, q, p],
            )
            total_D += wp.dot(after - here, back_v) / dv + adj.D
            back_v += adj.v
            back_x += adj.x
            adj_anchor[world, q, p] = face_adj(
                constants, inputs, world, k, anchor[world, q, p], adj.n, adj.y, adj.anchor, i, adj_inputs
            )
            if anew == 1:  # the mean before is dropped
                adj_force[world, q, p] = vec()
            if wp.static("friction" in wanted):
                adj_inputs.friction[k, i] = adj_inputs.friction[k, i] + adj.friction
            after = here
        adj_x[world, p] = back_x
        adj_v[world, p] = back_v
        adj_D[world, p] = adj_D[world, p] + total_D

    @wp.kernel(module=module, enable_backward=False)
    def spread_adj(
        # Parameters:
        body: Surface,
        # In:
        adj_x: wp.array2d(dtype=vec),
        adj_free: wp.array2d(dtype=vec),
        # Out, added into:
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
    ):
        """(K2.adj)"""
        world, i = wp.tid()
        adj_u[world, i] = adj_u[world, i] + from_points(body, adj_x, world, i)
        adj_v[world, i] = adj_v[world, i] + from_points(body, adj_free, world, i)

    @wp.kernel(module=module, enable_backward=False)
    def delassus_adj(
        body: Surface,
        mass: wp.array2d(dtype=real),
        adj_D: wp.array2d(dtype=real),
        adj_mass: wp.array2d(dtype=real),
    ):
        """(K1.adj)"""
        world, i = wp.tid()
        total = real(0.0)
        for m in range(body.first[i], body.first[i + 1]):
            entry = body.members[m]
            p = entry / arms
            total += wp.abs(body.weights[p, entry - p * arms]) * adj_D[world, p]
        if body.first[i + 1] > body.first[i]:
            square = mass[world, i] * mass[world, i]
            adj_mass[world, i] = adj_mass[world, i] - total * body.loads[i] / square

    return SimpleNamespace(
        settle_adj=settle_adj, press_adj=press_adj, spread_adj=spread_adj, delassus_adj=delassus_adj
    )
