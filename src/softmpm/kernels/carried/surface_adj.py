"""Adjoint of contact at surface points on the moving grid (surface.py). Derivation: docs/math/contact.md.

    v̄'_i += Δt m_i b_si x̄'_s,  b̄_si = Δt m_i v'_i·x̄'_s,  m̄_i += Δt b_si v'_i·x̄'_s,  x̄_s = x̄'_s
    J̄_s = A_s Σ b_si v̄'_i,  b̄_si += A_s J_s·v̄'_i,  v̄*_i = v̄'_i                                      (K10.adj)
    from the last wall to the first: J̄ += A_s f̄_s / T + D v̄_s,  D̄ += J·v̄_s, then (K4.adj), (K3.adj), (K6.adj)
    v̄*_i += m_i b_si v̄_s,  b̄_si += m_i (v*_i·v̄_s ± l_i D̄_s),  m̄_i += b_si v*_i·v̄_s + |b_si| l_i D̄_s,
    l̄_i += m_i |b_si| D̄_s,  b̄_si += ± A_s l̄_i,  with the sign of b_si                                (K9.adj)
    z̄ = −Σ (w_i/M) b̄_i d_i,  q = K⁻¹ z̄,  h = z Σ (w_i/M) b̄_i + q
    c_i = h·r_i − (z·d_i)(q·d_i),  k̄_i = (c_i − Σ k_j c_j / M − Σ b_j b̄_j) / M
    w̄_i = b̄_i (1 − z·d_i) / M + m_i k̄_i,  m̄_i += w_i k̄_i,  x̄_s += (Σ w̄_i ∇w_i − q) / dx             (K8.adj)

First ``share_again`` and ``press`` recompute v'_i; ``share_again`` stores v*_i, which ``press`` overwrites, of the nodes around the
points, and adds Δt m_i b_si x̄'_s to v̄'_i. When G2P has added its part, ``press_adj`` is (K10.adj) to l̄_i, and ``share_adj`` the rest.
The points add to velocities, loads and masses of the nodes atomically.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.carried.surface import point_types, surface, unrolled
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.point_share import point_share
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face, wall_face_adj
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def surface_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    dim, t, s, one = spec.dim, types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype), surface(spec)
    real, vec, node_vec, Constants, Window = t.real, t.vec, t.node, t.Constants, t.Window
    exact_vec, GridInputs = types(dim, "float64").vec, input_types(spec).GridInputs
    GridInputsAdj, structs = input_adj_types(spec, wanted).GridInputsAdj, point_types(dim, spec.dtype)
    Outline, Stencils, shared = structs.Outline, structs.Stencils, point_share(dim, spec.dtype)
    place, masses_of, fit, Table = shared.place, shared.masses_of, shared.fit, shared.Table
    touch_adj, weigh, meet, number = (
        surface_contact(dim, spec.dtype).touch_adj,
        one.weigh,
        one.meet,
        one.number,
    )
    face, face_adj, friction_of = (
        wall_face(spec).face,
        wall_face_adj(spec, wanted),
        wall_face(spec).friction_of,
    )
    weights, slopes, offset, position = s.weights, s.slopes, s.offset, s.position
    weight, weight_slope, node_index, size = s.weight, s.weight_slope, s.node_index, s.count
    count = len(spec.surface_walls)
    before_wall = wp.types.matrix((count, dim), real)
    module = unrolled(adj_module(spec, wanted) + ".surface")

    @wp.kernel(module=module, enable_backward=False)
    def share_again(
        # Parameters:
        constants: Constants,
        window: Window,
        outline: Outline,
        substep: int,
        # In:
        x: wp.array2d(dtype=exact_vec),
        node: wp.array2d(dtype=node_vec),
        velocity: wp.array2d(dtype=vec),
        adj_x: wp.array2d(dtype=vec),
        # In and out:
        words: wp.array(dtype=wp.int64),
        # Out:
        stencils: Stencils,
        free: wp.array2d(dtype=vec),  # v*
        adj_load: wp.array2d(dtype=real),  # cleared
        # Out, added into:
        load: wp.array2d(dtype=real),
        adj_velocity: wp.array2d(dtype=vec),
    ):
        world, p = wp.tid()
        adj = constants.dt * adj_x[world, p]
        found = weigh(
            constants, window, outline, substep, world, p, x[world, p], node, velocity, words, stencils, load
        )
        for n in range(size):
            i = node_index(found.base, offset(n), window.shape)
            free[world, i] = velocity[world, i]
            adj_load[world, i] = real(0.0)
            wp.atomic_add(adj_velocity, world, i, found.weights[n] * adj)

    @wp.kernel(module=module, enable_backward=False)
    def press_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        outline: Outline,
        smoothing: real,
        rate: wp.array(dtype=real),  # 1/T
        anew: int,  # 1 at the beginning of a control step
        # In:
        places: wp.array2d(dtype=exact_vec),
        anchor: wp.array3d(dtype=vec),
        node: wp.array2d(dtype=node_vec),
        velocity: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        load: wp.array2d(dtype=real),
        stencils: Stencils,
        adj_velocity: wp.array2d(dtype=vec),
        # In and out:
        adj_force: wp.array3d(dtype=vec),
        adj_anchor: wp.array3d(dtype=vec),
        adj_x: wp.array2d(dtype=vec),
        # Out:
        adj_stencils: Stencils,  # adjoints of shares and velocity
        # Out, added into:
        adj_load: wp.array2d(dtype=real),
        adj_mass: wp.array2d(dtype=real),
        adj_inputs: GridInputsAdj,
    ):
        world, p = wp.tid()
        base = stencils.base[world, p]
        at = places[world, p]
        v = stencils.velocity[world, p]
        area = outline.areas[p]
        newtons = rate[0] * outline.newtons[p]
        adj_way = constants.dt * adj_x[world, p]
        masses = Table()
        shares = Table()
        loads = Table()
        D = real(0.0)
        pull = vec()
        for n in range(size):
            i = node_index(base, offset(n), window.shape)
            masses[n] = node[world, i][dim]
            shares[n] = stencils.shares[world, p, n]
            loads[n] = load[world, i]
            D += masses[n] * wp.abs(shares[n]) * loads[n]
            pull += shares[n] * adj_velocity[world, i]
        if not D > real(0.0):  # a point of a world that failed
            adj_stencils.velocity[world, p] = vec()
            for n in range(size):
                adj_stencils.shares[world, p, n] = real(0.0)
            return
        reached = before_wall()
        total = vec()
        for q in range(count):
            for axis in range(dim):
                reached[q, axis] = v[axis]
            k = number[q]
            wall = face(constants, inputs, world, k, at, anchor[world, q, p])
            found = meet(
                constants, inputs, outline, smoothing, world, k, p, wall.n, wall.y, at, v, wall.anchor, D
            )
            v += D * found.J
            total += found.J
        back_x = vec()
        back_v = vec()
        back_D = real(0.0)
        after = v
        slot = world * window.count + p
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
                area * pull + D * back_v + newtons * adj_force[world, q, p],
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
        impulse = area * total
        along = Table()
        gained = Table()
        for n in range(size):
            i = node_index(base, offset(n), window.shape)
            along[n] = wp.dot(velocity[world, i], adj_way) + wp.dot(free[world, i], back_v)
            gained[n] = wp.dot(impulse, adj_velocity[world, i])
        adj_stencils.velocity[world, p] = back_v
        adj_x[world, p] = adj_x[world, p] + back_x
        for n in range(size):
            i = node_index(base, offset(n), window.shape)
            b = shares[n]
            weighed = loads[n] * back_D
            adj_stencils.shares[world, p, n] = gained[n] + masses[n] * (along[n] + wp.sign(b) * weighed)
            wp.atomic_add(adj_load, world, i, masses[n] * wp.abs(b) * back_D)
            wp.atomic_add(adj_mass, world, i, b * along[n] + wp.abs(b) * weighed)

    @wp.kernel(module=module, enable_backward=False)
    def share_adj(
        # Parameters:
        constants: Constants,
        window: Window,
        outline: Outline,
        # In:
        places: wp.array2d(dtype=exact_vec),
        node: wp.array2d(dtype=node_vec),
        stencils: Stencils,
        adj_stencils: Stencils,
        adj_load: wp.array2d(dtype=real),
        # In and out:
        adj_x: wp.array2d(dtype=vec),
        # Out, added into:
        adj_velocity: wp.array2d(dtype=vec),
        adj_mass: wp.array2d(dtype=real),
    ):
        """v̄* of (K9.adj), (K8.adj)"""
        world, p = wp.tid()
        x = places[world, p]
        at = place(x, constants.exact_spacing, constants.shape, window.origin[world], window.shape)
        masses = masses_of(node, world, at.base, window.shape)
        w = weights(at.fx)
        slope = slopes(at.fx)
        around = fit(masses, w, at.fx)
        if not (at.valid and around.mass > real(0.0)):
            return
        adj_v = adj_stencils.velocity[world, p]
        area = outline.areas[p]
        z = around.lean
        shares = Table()
        adj = Table()
        sum_b = real(0.0)  # Σ b b̄
        sum_w = real(0.0)  # Σ w b̄
        adj_z = vec()
        for n in range(size):
            o = offset(n)
            i = node_index(at.base, o, window.shape)
            shares[n] = stencils.shares[world, p, n]
            adj[n] = adj_stencils.shares[world, p, n] + wp.sign(shares[n]) * area * adj_load[world, i]
            sum_b += shares[n] * adj[n]
            sum_w += weight(w, o) * adj[n]
            adj_z -= (weight(w, o) * adj[n] / around.mass) * (position(o) - at.fx - around.mean)
        q = around.inverse * adj_z
        h = (sum_w / around.mass) * z + q
        bent = Table()  # c
        mean = real(0.0)  # Σ k c / M
        for n in range(size):
            o = offset(n)
            r = position(o) - at.fx
            d = r - around.mean
            bent[n] = wp.dot(h, r) - wp.dot(z, d) * wp.dot(q, d)
            mean += weight(w, o) * masses[n] / around.mass * bent[n]
        adj_fx = -q
        for n in range(size):
            o = offset(n)
            d = position(o) - at.fx - around.mean
            adj_k = (bent[n] - mean - sum_b) / around.mass
            adj_w = adj[n] * (real(1.0) - wp.dot(z, d)) / around.mass + masses[n] * adj_k
            adj_fx += adj_w * weight_slope(w, slope, o)
            i = node_index(at.base, o, window.shape)
            wp.atomic_add(adj_mass, world, i, weight(w, o) * adj_k)
            wp.atomic_add(adj_velocity, world, i, (masses[n] * shares[n]) * adj_v)
        adj_x[world, p] = adj_x[world, p] + adj_fx / constants.spacing

    return SimpleNamespace(share_again=share_again, press_adj=press_adj, share_adj=share_adj)
