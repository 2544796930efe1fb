"""Adjoint of contact at surface points on the moving grid (surface.py). Derivation: docs/math/contact.md.

    J̄_s = A_s Σ W_si v̄'_i / m_i
    from the last wall to the first: J̄ += A_s f̄_s / T + D v̄_s,  D̄ += J·v̄_s, then (K4.adj), (K3.adj), (K6.adj)
    v̄*_i = v̄'_i + Σ W_si v̄_s
    m̄_i −= (|W_si| L_i D̄_s + W_si A_s J_s·v̄'_i) / m_i²,  L̄_i += |W_si| D̄_s / m_i
    W̄_si = v*_i·v̄_s + A_s J_s·v̄'_i / m_i + σ (L_i D̄_s / m_i + A_s L̄_i),  σ = sign W_si           (K9.adj), (K10.adj)

and (K8.adj). ``press_adj`` is all but the part with L̄, which all points add to first; that is ``add_loads_adj``. Both add to the
adjoint of the particles. v̄* − v̄' and m̄ have an array beside v̄', since points read that one.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.carried.point import module_of, outline_type, surface_point
from softmpm.kernels.carried.surface import surface
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face, wall_face_adj
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


@kernel_factory
def loads_adj(dim: int, dtype: str, packed: bool) -> wp.Function:
    """Function of a point's part in L̄ (K9.adj)"""
    t, s, point, Outline = (
        types(dim, dtype),
        spline(dim, dtype),
        surface_point(dim, dtype, packed),
        outline_type(dim, dtype),
    )
    real, vec, Constants, Window = t.real, t.vec, t.Constants, t.Window
    Particles, ParticlesAdj, Table = point.Particles, point.ParticlesAdj, point.Table
    point_of, share, shares_adj = point.point_of, point.share, point.shares_adj
    weights, slopes, offset, node_index, size = s.weights, s.slopes, s.offset, s.node_index, s.count

    @wp.func
    def add_load_adj(
        constants: Constants,
        window: Window,
        outline: Outline,
        now: Particles,
        world: int,
        p: int,
        owner: int,
        adj_load: wp.array2d(dtype=real),
        adj: ParticlesAdj,
    ):
        at = point_of(constants, window, outline, now, world, p, owner)
        w = weights(at.fx)
        area = outline.areas[p]
        adj_shares = Table()
        for n in range(size):
            i = node_index(at.base, offset(n), window.shape)
            adj_shares[n] = wp.sign(share(at, w, n)) * area * adj_load[world, i]
        slope = slopes(at.fx)
        shares_adj(constants, outline, at, w, slope, adj_shares, vec(), world, p, owner, adj)

    return add_load_adj


@kernel_factory
def surface_adj(spec: Spec, wanted: RequestedGrads, packed: bool) -> SimpleNamespace:
    """Kernels on particles that are ``packed`` as in the fast scheme, or not."""
    dim, t, s, one = (
        spec.dim,
        types(spec.dim, spec.dtype),
        spline(spec.dim, spec.dtype),
        surface(spec, packed),
    )
    real, vec, node_vec, Constants, Window, pack = t.real, t.vec, t.node, t.Constants, t.Window, s.pack
    point, Outline = surface_point(dim, spec.dtype, packed), outline_type(dim, spec.dtype)
    Particles, ParticlesAdj, Table = point.Particles, point.ParticlesAdj, point.Table
    point_of, share, shares_adj = point.point_of, point.share, point.shares_adj
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    touch_adj, meet, number = surface_contact(dim, spec.dtype).touch_adj, one.meet, one.number
    face, friction_of, face_adj = (
        wall_face(spec).face,
        wall_face(spec).friction_of,
        wall_face_adj(spec, wanted),
    )
    weights, slopes, offset, node_index, size = s.weights, s.slopes, s.offset, s.node_index, s.count
    add_load_adj = loads_adj(dim, spec.dtype, packed)
    count = len(spec.surface_walls)
    before_wall = wp.types.matrix((count, dim), real)
    module = module_of(adj_module(spec, wanted) + ".surface", packed)

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
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        anchor: wp.array3d(dtype=vec),
        node: wp.array2d(dtype=node_vec),
        free: wp.array2d(dtype=vec),
        load: wp.array2d(dtype=real),
        adj_velocity: wp.array2d(dtype=vec),  # v̄'
        # In and out:
        adj_force: wp.array3d(dtype=vec),
        adj_anchor: wp.array3d(dtype=vec),
        # Out, added into:
        adj_load: wp.array2d(dtype=real),
        gained: wp.array2d(dtype=node_vec),  # v̄* − v̄' and m̄
        adj: ParticlesAdj,
        adj_inputs: GridInputsAdj,
    ):
        world, p = wp.tid()
        at = point_of(constants, window, outline, now, world, p, owner[world, p])
        w = weights(at.fx)
        lightness = Table()  # 1/m, or zero
        v = vec()
        D = real(0.0)
        pull = vec()
        for n in range(size):
            i = node_index(at.base, offset(n), window.shape)
            m = node[world, i][dim]
            b = share(at, w, n)
            v += b * free[world, i]
            if m > real(0.0):
                lightness[n] = real(1.0) / m
                D += wp.abs(b) * load[world, i] / m
                pull += (b / m) * adj_velocity[world, i]
        if not D > real(0.0):  # a point of a world that failed
            return
        reached = before_wall()
        total = vec()
        for q in range(count):
            for axis in range(dim):
                reached[q, axis] = v[axis]
            k = number[q]
            wall = face(constants, inputs, world, k, at.x, anchor[world, q, p])
            found = meet(
                constants, inputs, outline, smoothing, world, k, p, wall.n, wall.y, at.x, v, wall.anchor, D
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
            wall = face(constants, inputs, world, k, at.x, anchor[world, q, p])
            adj_J = (
                outline.areas[p] * pull + D * back_v + (rate[0] * outline.newtons[p]) * adj_force[world, q, p]
            )
            more = touch_adj(
                wall.n,
                wall.y,
                vec(at.x),
                here,
                wall.anchor,
                D,
                friction_of(inputs, world, k),
                outline.stiffness[p],
                constants.dt,
                smoothing,
                adj_J,
                adj_anchor[world, q, p],
            )
            back_D += wp.dot(after - here, back_v) / D + more.D
            back_v += more.v
            back_x += more.x
            adj_anchor[world, q, p] = face_adj(
                constants,
                inputs,
                world,
                k,
                anchor[world, q, p],
                more.n,
                more.y,
                more.anchor,
                slot,
                adj_inputs,
            )
            if anew == 1:  # the mean before is dropped
                adj_force[world, q, p] = vec()
            if wp.static("friction" in wanted):
                adj_inputs.friction[k, slot] = adj_inputs.friction[k, slot] + more.friction
            after = here
        impulse = outline.areas[p] * total
        adj_shares = Table()
        for n in range(size):
            i = node_index(at.base, offset(n), window.shape)
            b = share(at, w, n)
            along = lightness[n] * wp.dot(impulse, adj_velocity[world, i])
            loaded = lightness[n] * back_D * load[world, i]
            adj_shares[n] = wp.dot(free[world, i], back_v) + along + wp.sign(b) * loaded
            wp.atomic_add(adj_load, world, i, wp.abs(b) * lightness[n] * back_D)
            adj_m = -lightness[n] * (wp.abs(b) * loaded + b * along)
            wp.atomic_add(gained, world, i, pack(b * back_v, adj_m))
        slope = slopes(at.fx)
        shares_adj(constants, outline, at, w, slope, adj_shares, back_x, world, p, owner[world, p], adj)

    @wp.kernel(module=module, enable_backward=False)
    def add_loads_adj(
        # Parameters:
        constants: Constants,
        window: Window,
        outline: Outline,
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        adj_load: wp.array2d(dtype=real),
        # Out, added into:
        adj: ParticlesAdj,
    ):
        world, p = wp.tid()
        add_load_adj(constants, window, outline, now, world, p, owner[world, p], adj_load, adj)

    return SimpleNamespace(press_adj=press_adj, add_loads_adj=add_loads_adj)
