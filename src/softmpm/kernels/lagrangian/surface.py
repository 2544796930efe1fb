"""Contact of the surface points of bodies with separating walls, in one pass. Derivation: docs/math/contact.md.

    D_s = Σ |w_si| L_i / m_i                                                                         (K1)
    x_s = X_s + shift + Σ w_si u_i,  v_s = Σ w_si v*_i                                               (K2)
    wall by wall: J by (K3), (K4), then v_s += D_s J
    v'_i = v*_i + Σ w_si A_s J / m_i,  u'_i = u_i + Δt v'_i                                          (K5)

    J̄_s = A_s Σ w_si v̄'_i / m_i,  m̄_i −= (v'_i − v*_i)·v̄'_i / m_i                                   (K5.adj)
    from the last wall to the first: J̄ += D v̄_s,  D̄ += J·v̄_s, then (K4.adj), (K3.adj)
    v̄*_i += Σ w_si v̄_s,  ū_i += Σ w_si x̄_s                                                           (K2.adj)
    m̄_i −= Σ D̄_s |w_si| L_i / m_i²                                                                   (K1.adj)

Nodes gather what the points give them in a fixed order, as in nodes.py. Only the height over a wall sees the shift; anchors move with
the frame.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.nodes import nodes
from softmpm.kernels.lagrangian.rest import lagrangian_module, rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def surface_type(dim: int, dtype: str):
    t, exact_vec = types(dim, dtype), types(dim, "float64").vec

    class Surface:
        """See :class:`softmpm.surface_grid.SurfaceGrid`."""

        points: wp.array(dtype=exact_vec)
        areas: wp.array(dtype=t.real)
        stiffness: wp.array(dtype=t.real)  # in units of the heaviest particle's mass
        loads: wp.array(dtype=t.real)
        stencil: wp.array2d(dtype=wp.int32)
        weights: wp.array2d(dtype=t.real)
        first: wp.array(dtype=wp.int32)
        members: wp.array(dtype=wp.int32)

    return wp.struct(Surface, module=f"softmpm.types.d{dim}.{dtype}")


@kernel_factory
def surface(spec: Spec) -> SimpleNamespace:
    t, r, block = (
        types(spec.dim, spec.dtype),
        rest(spec.dim, spec.dtype),
        surface_contact(spec.dim, spec.dtype),
    )
    real, vec, Constants, dim = t.real, t.vec, t.Constants, spec.dim
    exact_vec, GridInputs, Surface = (
        types(dim, "float64").vec,
        input_types(spec).GridInputs,
        surface_type(dim, spec.dtype),
    )
    walls = spec.surface_walls
    number = wp.types.vector(len(walls), wp.int32)(*walls)  # of each separating wall among all walls
    count, each_world, rough, arms = len(walls), "friction" in spec.given, spec.friction, r.count
    touch, across, running = block.touch, block.across, status.report(dim, spec.dtype).running
    f = frame(dim, spec.dtype)
    Frame, recentring, exact_of = f.Frame, f.recentring, f.exact
    module = lagrangian_module(spec.module + ".lagrangian")

    @wp.func
    def friction_of(inputs: GridInputs, world: int, k: int) -> real:
        if wp.static(rough and each_world):
            return inputs.friction[world, k]
        elif wp.static(rough):
            return inputs.friction[k]
        else:
            return real(0.0)

    @wp.func
    def normal_of(inputs: GridInputs, k: int) -> vec:
        n = vec()
        for axis in range(dim):
            n[axis] = real(inputs.normal[k, axis])
        return n

    @wp.func
    def height(inputs: GridInputs, k: int, x: exact_vec) -> real:
        """y of (K3), in float64 until it is small."""
        y = -inputs.offset[k]
        for axis in range(dim):
            y += inputs.normal[k, axis] * x[axis]
        return real(y)

    @wp.func
    def at_point(body: Surface, nodal: wp.array2d(dtype=vec), world: int, p: int) -> vec:
        """Σ w a of a nodal field."""
        total = vec()
        for n in range(r.count):
            total += body.weights[p, n] * nodal[world, body.stencil[p, n]]
        return total

    @wp.func
    def from_points(body: Surface, values: wp.array2d(dtype=vec), world: int, i: int) -> vec:
        """Σ w a of a field of the surface points, at a node, in a fixed order."""
        total = vec()
        for m in range(body.first[i], body.first[i + 1]):
            entry = body.members[m]
            p = entry / arms
            total += body.weights[p, entry - p * arms] * values[world, p]
        return total

    @wp.func
    def present(body: Surface, p: int, u: vec) -> exact_vec:
        """x of (K2) without the shift."""
        return body.points[p] + exact_of(u)

    @wp.kernel(module=module, enable_backward=False)
    def delassus(body: Surface, mass: wp.array2d(dtype=real), D: wp.array2d(dtype=real)):
        """(K1)"""
        world, p = wp.tid()
        total = real(0.0)
        for n in range(r.count):
            i = body.stencil[p, n]
            if body.weights[p, n] != real(0.0):
                total += wp.abs(body.weights[p, n]) * body.loads[i] / mass[world, i]
        D[world, p] = total

    @wp.kernel(module=module, enable_backward=False)
    def press(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        moving: Frame,
        smoothing: real,
        words: wp.array(dtype=wp.int64),
        D: wp.array2d(dtype=real),
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        anchor: wp.array3d(dtype=vec),
        # Out:
        impulse: wp.array2d(dtype=vec),
        new_anchor: wp.array3d(dtype=vec),
    ):
        """(K2) to (K4): impulse A J of each point."""
        world, p = wp.tid()
        total = vec()
        if running(words, world):
            d = recentring(moving, u, world)
            exact = present(body, p, at_point(body, u, world, p))
            x = vec(exact)
            exact += shift[world]
            v = at_point(body, free, world, p)
            for q in range(count):
                k = number[q]
                found = touch(
                    normal_of(inputs, k),
                    height(inputs, k, exact),
                    x,
                    v,
                    anchor[world, q, p],
                    D[world, p],
                    friction_of(inputs, world, k),
                    body.stiffness[p],
                    constants.dt,
                    smoothing,
                )
                new_anchor[world, q, p] = found.anchor - across(normal_of(inputs, k), d)
                total += found.J
                v += D[world, p] * found.J
        else:
            for q in range(count):
                new_anchor[world, q, p] = anchor[world, q, p]
        impulse[world, p] = body.areas[p] * total

    @wp.kernel(module=module, enable_backward=False)
    def settle(
        # Parameters:
        constants: Constants,
        body: Surface,
        moving: Frame,
        mass: wp.array2d(dtype=real),
        impulse: wp.array2d(dtype=vec),
        words: wp.array(dtype=wp.int64),
        # In:
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        # Out:
        new_u: wp.array2d(dtype=vec),
        new_v: wp.array2d(dtype=vec),
    ):
        """(K5)"""
        world, i = wp.tid()
        here = u[world, i]
        new = v[world, i]
        if running(words, world):
            new = free[world, i]
            if body.first[i + 1] > body.first[i]:
                new += from_points(body, impulse, world, i) / mass[world, i]
            here = (here - recentring(moving, u, world)) + constants.dt * new
        new_u[world, i] = here
        new_v[world, i] = new

    return SimpleNamespace(
        delassus=delassus,
        press=press,
        settle=settle,
        friction_of=friction_of,
        normal_of=normal_of,
        height=height,
        at_point=at_point,
        from_points=from_points,
        present=present,
        number=number,
    )


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
    friction_of, normal_of, height, present = one.friction_of, one.normal_of, one.height, one.present
    at_point, from_points, node_velocity = one.at_point, one.from_points, grid(spec).node_velocity
    arms, place, before_wall = r.count, nodes(spec).place, wp.types.matrix((count, dim), real)
    exact_vec, mirrored = types(dim, "float64").vec, bool(spec.mirrors)
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
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        anchor: wp.array3d(dtype=vec),
        shared: wp.array2d(dtype=vec),
        # In and out:
        adj_anchor: wp.array3d(dtype=vec),
        # Out:
        adj_x: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        # Out, added into:
        adj_D: wp.array2d(dtype=real),
        adj_inputs: GridInputsAdj,
    ):
        world, p = wp.tid()
        exact = present(body, p, at_point(body, u, world, p))
        x = vec(exact)
        exact += shift[world]
        v = at_point(body, free, world, p)
        dv = D[world, p]
        reached = before_wall()
        for q in range(count):
            for axis in range(dim):
                reached[q, axis] = v[axis]
            k = number[q]
            found = touch(
                normal_of(inputs, k),
                height(inputs, k, exact),
                x,
                v,
                anchor[world, q, p],
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
        for back in range(count):
            q = count - 1 - back
            k = number[q]
            here = vec()
            for axis in range(dim):
                here[axis] = reached[q, axis]
            n = normal_of(inputs, k)
            adj = touch_adj(
                n,
                height(inputs, k, exact),
                x,
                here,
                anchor[world, q, p],
                dv,
                friction_of(inputs, world, k),
                body.stiffness[p],
                constants.dt,
                smoothing,
                adj_J + dv * back_v,
                adj_anchor[world, q, p],
            )
            total_D += wp.dot(after - here, back_v) / dv + adj.D
            back_v += adj.v
            back_x += adj.x
            adj_anchor[world, q, p] = adj.anchor
            if wp.static("friction" in wanted):
                i = world * held + p
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
