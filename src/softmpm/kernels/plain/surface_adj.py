"""Adjoint of contact at surface points on the moving grid (surface.py). Derivation: docs/math/contact.md.

    v̄'_i += Δt m_i b_si x̄'_s,  b̄_si = Δt m_i v'_i·x̄'_s,  m̄_i += Δt b_si v'_i·x̄'_s,  x̄_s = x̄'_s
    J̄_s = A_s Σ b_si v̄'_i,  b̄_si += A_s J_s·v̄'_i,  v̄*_i = v̄'_i                                      (K10.adj)
    from the last wall to the first: J̄ += A_s f̄_s / T + D v̄_s,  D̄ += J·v̄_s, then (K4.adj), (K3.adj), (K6.adj)
    v̄*_i += m_i b_si v̄_s,  b̄_si += m_i (v*_i·v̄_s ± l_i D̄_s),  m̄_i += b_si v*_i·v̄_s + |b_si| l_i D̄_s,
    l̄_i += m_i |b_si| D̄_s,  b̄_si += ± A_s l̄_i,  with the sign of b_si                                (K9.adj)
    z̄ = −Σ (w_i/M) b̄_i d_i,  q = K⁻¹ z̄,  h = z Σ (w_i/M) b̄_i + q
    c_i = h·r_i − (z·d_i)(q·d_i),  k̄_i = (c_i − Σ k_j c_j / M − Σ b_j b̄_j) / M
    w̄_i = b̄_i (1 − z·d_i) / M + m_i k̄_i,  m̄_i += w_i k̄_i,  x̄_s += (Σ w̄_i ∇w_i − q) / dx             (K8.adj)

The points add to velocities, loads and masses of the nodes atomically.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.point_share import point_share
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face, wall_face_adj
from softmpm.kernels.plain.surface import outline_type, surface
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def surface_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    dim, t, s, one = (
        spec.dim,
        types(spec.dim, spec.dtype),
        spline(spec.dim, spec.dtype),
        surface(spec),
    )
    real, vec, ivec, node_vec, Constants = t.real, t.vec, t.ivec, t.node, t.Constants
    exact_vec, GridInputs = types(dim, "float64").vec, input_types(spec).GridInputs
    GridInputsAdj, Outline = input_adj_types(spec, wanted).GridInputsAdj, outline_type(dim, spec.dtype)
    shared, block = point_share(dim, spec.dtype), surface_contact(dim, spec.dtype)
    place, fit, touch, touch_adj = shared.place, shared.fit, block.touch, block.touch_adj
    face, face_adj = wall_face(spec).face, wall_face_adj(spec, wanted)
    weights, slopes, offset, position = s.weights, s.slopes, s.offset, s.position
    weight, weight_slope, node_index = s.weight, s.weight_slope, s.node_index
    friction_of, at_point, number, count = one.friction_of, one.at_point, one.number, len(spec.surface_walls)
    before_wall = wp.types.matrix((count, dim), real)
    module = adj_module(spec, wanted) + ".surface"

    @wp.kernel(module=module, enable_backward=False)
    def advance_adj(
        # Parameters:
        constants: Constants,
        # In:
        node: wp.array2d(dtype=node_vec),
        velocity: wp.array2d(dtype=vec),
        base: wp.array2d(dtype=ivec),
        shares: wp.array3d(dtype=real),
        adj_x: wp.array2d(dtype=vec),
        # Out:
        adj_shares: wp.array3d(dtype=real),
        # Out, added into:
        adj_velocity: wp.array2d(dtype=vec),
        adj_mass: wp.array2d(dtype=real),
    ):
        world, p = wp.tid()
        adj = constants.dt * adj_x[world, p]
        for n in range(s.count):
            i = node_index(base[world, p], offset(n), constants.shape)
            m = node[world, i][dim]
            b = shares[world, p, n]
            along = wp.dot(velocity[world, i], adj)
            adj_shares[world, p, n] = m * along
            wp.atomic_add(adj_velocity, world, i, (m * b) * adj)
            wp.atomic_add(adj_mass, world, i, b * along)

    @wp.kernel(module=module, enable_backward=False)
    def press_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        outline: Outline,
        smoothing: real,
        held: int,  # accumulators of one world
        rate: real,  # 1/T
        anew: int,  # 1 at the beginning of a control step
        # In:
        places: wp.array2d(dtype=exact_vec),
        anchor: wp.array3d(dtype=vec),
        node: wp.array2d(dtype=node_vec),
        free: wp.array2d(dtype=vec),
        base: wp.array2d(dtype=ivec),
        shares: wp.array3d(dtype=real),
        load: wp.array2d(dtype=real),
        adj_velocity: wp.array2d(dtype=vec),
        # In and out:
        adj_force: wp.array3d(dtype=vec),
        adj_anchor: wp.array3d(dtype=vec),
        adj_x: wp.array2d(dtype=vec),
        adj_shares: wp.array3d(dtype=real),
        # Out, added into:
        adj_free: wp.array2d(dtype=vec),
        adj_load: wp.array2d(dtype=real),
        adj_mass: wp.array2d(dtype=real),
        adj_inputs: GridInputsAdj,
    ):
        world, p = wp.tid()
        first = base[world, p]
        D = real(0.0)
        pull = vec()
        for n in range(s.count):
            i = node_index(first, offset(n), constants.shape)
            b = shares[world, p, n]
            D += node[world, i][dim] * wp.abs(b) * load[world, i]
            pull += b * adj_velocity[world, i]
        if not D > real(0.0):  # a point of a world that failed
            return
        v = at_point(node, shares, free, world, p, first, constants.shape)
        at = places[world, p]
        reached = before_wall()
        total = vec()
        for q in range(count):
            for axis in range(dim):
                reached[q, axis] = v[axis]
            k = number[q]
            wall = face(constants, inputs, world, k, at, anchor[world, q, p])
            found = touch(
                wall.n,
                wall.y,
                vec(at),
                v,
                wall.anchor,
                D,
                friction_of(inputs, world, k),
                outline.stiffness[p],
                constants.dt,
                smoothing,
            )
            v += D * found.J
            total += found.J
        back_x = vec()
        back_v = vec()
        back_D = real(0.0)
        after = v
        slot = world * held + p
        for back in range(count):
            q = count - 1 - back
            k = number[q]
            here = vec()
            for axis in range(dim):
                here[axis] = reached[q, axis]
            wall = face(constants, inputs, world, k, at, anchor[world, q, p])
            adj = touch_adj(
                wall.n,
                wall.y,
                vec(at),
                here,
                wall.anchor,
                D,
                friction_of(inputs, world, k),
                outline.stiffness[p],
                constants.dt,
                smoothing,
                outline.areas[p] * pull + D * back_v + (rate * outline.newtons[p]) * adj_force[world, q, p],
                adj_anchor[world, q, p],
            )
            back_D += wp.dot(after - here, back_v) / D + adj.D
            back_v += adj.v
            back_x += adj.x
            adj_anchor[world, q, p] = face_adj(
                constants, inputs, world, k, anchor[world, q, p], adj.n, adj.y, adj.anchor, slot, adj_inputs
            )
            if anew == 1:  # the mean before is dropped
                adj_force[world, q, p] = vec()
            if wp.static("friction" in wanted):
                adj_inputs.friction[k, slot] = adj_inputs.friction[k, slot] + adj.friction
            after = here
        adj_x[world, p] = adj_x[world, p] + back_x
        impulse = outline.areas[p] * total
        for n in range(s.count):
            i = node_index(first, offset(n), constants.shape)
            m = node[world, i][dim]
            b = shares[world, p, n]
            along = wp.dot(free[world, i], back_v)
            weighed = load[world, i] * back_D
            gained = wp.dot(impulse, adj_velocity[world, i])
            adj_shares[world, p, n] = adj_shares[world, p, n] + gained + m * (along + wp.sign(b) * weighed)
            wp.atomic_add(adj_free, world, i, (m * b) * back_v)
            wp.atomic_add(adj_load, world, i, m * wp.abs(b) * back_D)
            wp.atomic_add(adj_mass, world, i, b * along + wp.abs(b) * weighed)

    @wp.kernel(module=module, enable_backward=False)
    def share_adj(
        # Parameters:
        constants: Constants,
        outline: Outline,
        # In:
        places: wp.array2d(dtype=exact_vec),
        node: wp.array2d(dtype=node_vec),
        shares: wp.array3d(dtype=real),
        adj_shares: wp.array3d(dtype=real),
        adj_load: wp.array2d(dtype=real),
        # In and out:
        adj_x: wp.array2d(dtype=vec),
        # Out, added into:
        adj_mass: wp.array2d(dtype=real),
    ):
        """(K8.adj)"""
        world, p = wp.tid()
        at = place(places[world, p], constants.exact_spacing, constants.shape)
        around = fit(node, world, at, constants.shape)
        if not (at.valid and around.mass > real(0.0)):
            return
        w = weights(at.fx)
        slope = slopes(at.fx)
        z = around.lean
        sum_b = real(0.0)  # Σ b b̄
        sum_w = real(0.0)  # Σ w b̄
        adj_z = vec()
        for n in range(s.count):
            o = offset(n)
            i = node_index(at.base, o, constants.shape)
            b = shares[world, p, n]
            adj = adj_shares[world, p, n] + wp.sign(b) * outline.areas[p] * adj_load[world, i]
            sum_b += b * adj
            sum_w += weight(w, o) * adj
            adj_z -= (weight(w, o) * adj / around.mass) * (position(o) - at.fx - around.mean)
        q = around.inverse * adj_z
        h = (sum_w / around.mass) * z + q
        mean = real(0.0)  # Σ k c / M
        for n in range(s.count):
            o = offset(n)
            i = node_index(at.base, o, constants.shape)
            r = position(o) - at.fx
            d = r - around.mean
            c = wp.dot(h, r) - wp.dot(z, d) * wp.dot(q, d)
            mean += weight(w, o) * node[world, i][dim] / around.mass * c
        adj_fx = -q
        for n in range(s.count):
            o = offset(n)
            i = node_index(at.base, o, constants.shape)
            r = position(o) - at.fx
            d = r - around.mean
            c = wp.dot(h, r) - wp.dot(z, d) * wp.dot(q, d)
            up = wp.sign(shares[world, p, n])
            adj = adj_shares[world, p, n] + up * outline.areas[p] * adj_load[world, i]
            adj_k = (c - mean - sum_b) / around.mass
            adj_w = adj * (real(1.0) - wp.dot(z, d)) / around.mass + node[world, i][dim] * adj_k
            adj_fx += adj_w * weight_slope(w, slope, o)
            wp.atomic_add(adj_mass, world, i, weight(w, o) * adj_k)
        adj_x[world, p] = adj_x[world, p] + adj_fx / constants.spacing

    return SimpleNamespace(advance_adj=advance_adj, press_adj=press_adj, share_adj=share_adj)
