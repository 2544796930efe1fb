"""Masses of the nodes, and the two representations of a state: nodes, and the particles that show them. Derivation:
docs/math/lagrangian.md.

    m_i = Σ m_p N_i                                                                                  (Q2)
    x = X + shift + Σ N_i u_i,  v = Σ N_i v_i,  F = I + Σ u_i ⊗ g_i,  C = Ḟ F⁻¹ with Ḟ = Σ v_i ⊗ g_i          (Q5)
    Ḟ̄ = C̄ F⁻ᵀ,  F̄ −= Cᵀ Ḟ̄,  ū_i = Σ N_i x̄ + F̄ g_i,  v̄_i = Σ N_i v̄ + Ḟ̄ g_i                            (Q5.adj)
    u_i = Σ N_i a / m_i,  a = m (x − X − shift + (F − I) r),  v_i = Σ N_i b / m_i,  b = m (v + C F r)         (Q6)
    ũ = ū_i/m_i,  ṽ = v̄_i/m_i,  U = Σ ũ ⊗ N_i r,  V = Σ ṽ ⊗ N_i r
    x̄ = m Σ N_i ũ,  F̄ = m (U + Cᵀ V),  v̄ = m Σ N_i ṽ,  C̄ = m V Fᵀ
    m̄ += (x − X)·Σ N_i ũ + (F − I):U + v·Σ N_i ṽ + (C F):V − Σ N_i (ũ·u_i + ṽ·v_i)                   (Q6.adj)

Particles of a state are in the user's order, masses in the order of the places. Here each brick adds up what its particles give;
node_sums.py adds up the bricks.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, brick_options, meet
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.interpolation import field, sums
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import types


@kernel_factory
def masses(dim: int, dtype: str, bricks: Bricks) -> SimpleNamespace:
    t, r, s = types(dim, dtype), rest(dim, dtype), spline(dim, dtype)
    real, vec, mat, Rest, total_of = t.real, t.vec, t.mat, r.Rest, sums(dim, dtype, bricks, True)
    line, clear, add, write = total_of.line, total_of.clear, total_of.add, total_of.write
    across, along, count = bricks.window[-2], bricks.window[-1], 3**dim
    cells, turns, threads, place_of = bricks.cell_count, bricks.turns, bricks.threads, total_of.place_of
    weights, weight, offset, settings = s.weights, s.weight, s.offset, bricks.settings
    options = brick_options()

    @kernel(options, **settings)
    def bricks_of_masses(inside: Rest, mass: wp.array2d(dtype=real), partial: wp.array2d(dtype=vec)):
        """Sums of (Q2), along the first axis."""
        world, brick, lane = wp.tid()
        clear(partial, world, brick)
        meet()
        total = line()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                p = place_of(inside, row, slot)
                corner = inside.corners[brick, slot % cells]
                fx = vec()
                b = vec()
                if p >= 0:
                    fx = inside.fraction[p]
                    b[0] = mass[world, p]
                total = add(total, partial, world, brick, slot, corner, fx, mat(), b)
        write(total, partial, inside.corners[brick, lane % cells], world, brick, lane)

    @kernel(options, **settings)
    def masses_adj(inside: Rest, adj_nodes: wp.array2d(dtype=real), adj_mass: wp.array2d(dtype=real)):
        """(Q2.adj): adds Σ N m̄_i to those of the particles."""
        world, brick, lane = wp.tid()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                p = place_of(inside, row, slot)
                corner = inside.corners[brick, slot % cells]
                if p >= 0:
                    w = weights(inside.fraction[p])
                    total = real(0.0)
                    for n in range(count):
                        o = offset(n)
                        at = o[0]
                        if wp.static(dim == 3):
                            at = at * across + o[1]
                        i = inside.window[brick, corner + at * along + o[dim - 1]]
                        total += weight(w, o) * adj_nodes[world, i]
                    adj_mass[world, p] = adj_mass[world, p] + total

    return SimpleNamespace(bricks_of_masses=bricks_of_masses, masses_adj=masses_adj)


@kernel_factory
def projection(dim: int, dtype: str, bricks: Bricks) -> SimpleNamespace:
    t, r, identity = types(dim, dtype), rest(dim, dtype), kinematics(dim, dtype).identity
    real, vec, mat, Constants, Rest = t.real, t.vec, t.mat, t.Constants, r.Rest
    field_u, field_v = (field(dim, dtype, bricks, number) for number in range(2))
    stage_u, gradient_u, value_u = field_u.stage, field_u.gradient, field_u.value
    stage_v, gradient_v, value_v = field_v.stage, field_v.gradient, field_v.value
    total_of, settings = sums(dim, dtype, bricks, True), bricks.settings
    exact_vec, exact = types(dim, "float64").vec, frame(dim, dtype).exact
    cells, turns, threads, place_of = bricks.cell_count, bricks.turns, bricks.threads, total_of.place_of
    line, clear, add, write = total_of.line, total_of.clear, total_of.add, total_of.write
    options = brick_options()
    store = f"softmpm::scatter_rows<{{}}, {threads}>(&out.data->{{}}, row, lane, &value.{{}});"

    @wp.func_native(store.format(dim, "c[0]", "c[0]"))
    def store_vec(out: wp.array2d(dtype=vec), row: int, lane: int, value: vec): ...

    @wp.func_native(store.format(dim * dim, "data[0][0]", "data[0][0]"))
    def store_mat(out: wp.array2d(dtype=mat), row: int, lane: int, value: mat): ...

    @kernel(options, **settings)
    def show(
        # Parameters:
        constants: Constants,
        inside: Rest,
        rest_x: wp.array(dtype=vec),
        shift: wp.array(dtype=exact_vec),
        # In:
        u: wp.array2d(dtype=vec),
        nodal_v: wp.array2d(dtype=vec),
        # Out:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
    ):
        """(Q5)"""
        world, brick, lane = wp.tid()
        stage_u(u, inside, world, brick, lane)
        stage_v(nodal_v, inside, world, brick, lane)
        meet()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                place = place_of(inside, row, slot)
                corner = inside.corners[brick, slot % cells]
                row_of_p = int(-1)
                place_x = vec()
                speed = vec()
                affine = mat()
                here = mat()
                if place >= 0:
                    p = inside.order[place]
                    fx = inside.fraction[place]
                    here = identity() + gradient_u(u, inside, world, brick, corner, fx, constants.rate)
                    rate = gradient_v(nodal_v, inside, world, brick, corner, fx, constants.rate)
                    way = value_u(u, inside, world, brick, corner, fx)
                    place_x = vec(exact(rest_x[p]) + shift[world] + exact(way))
                    speed = value_v(nodal_v, inside, world, brick, corner, fx)
                    affine = rate * wp.inverse(here)
                    row_of_p = world * x.shape[1] + p
                store_vec(x, row_of_p, lane, place_x)
                store_vec(v, row_of_p, lane, speed)
                store_mat(C, row_of_p, lane, affine)
                store_mat(F, row_of_p, lane, here)

    @kernel(options, **settings)
    def show_adj(
        # Parameters:
        constants: Constants,
        inside: Rest,
        # In:
        C: wp.array2d(dtype=mat),
        F: wp.array2d(dtype=mat),
        adj_x: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        adj_C: wp.array2d(dtype=mat),
        adj_F: wp.array2d(dtype=mat),
        # Out:
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
    ):
        """(Q5.adj)"""
        world, brick, lane = wp.tid()
        clear(partial_u, world, brick)
        clear(partial_v, world, brick)
        meet()
        total_u = line()
        total_v = line()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                place = place_of(inside, row, slot)
                corner = inside.corners[brick, slot % cells]
                fx = vec()
                A = mat()
                b = vec()
                B = mat()
                d = vec()
                if place >= 0:
                    p = inside.order[place]
                    fx = inside.fraction[place]
                    adj_rate = adj_C[world, p] * wp.transpose(wp.inverse(F[world, p]))
                    A = constants.rate * (adj_F[world, p] - wp.transpose(C[world, p]) * adj_rate)
                    b = adj_x[world, p]
                    B = constants.rate * adj_rate
                    d = adj_v[world, p]
                total_u = add(total_u, partial_u, world, brick, slot, corner, fx, A, b)
                total_v = add(total_v, partial_v, world, brick, slot, corner, fx, B, d)
        write(total_u, partial_u, inside.corners[brick, lane % cells], world, brick, lane)
        write(total_v, partial_v, inside.corners[brick, lane % cells], world, brick, lane)

    @kernel(options, **settings)
    def project(
        # Parameters:
        constants: Constants,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        # In:
        moved: wp.array2d(dtype=vec),  # x − X
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        H: wp.array2d(dtype=mat),  # F − I
        # Out:
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
    ):
        """Sums of (Q6)."""
        world, brick, lane = wp.tid()
        clear(partial_u, world, brick)
        clear(partial_v, world, brick)
        meet()
        total_u = line()
        total_v = line()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                place = place_of(inside, row, slot)
                corner = inside.corners[brick, slot % cells]
                fx = vec()
                A = mat()
                b = vec()
                B = mat()
                d = vec()
                if place >= 0:
                    p = inside.order[place]
                    fx = inside.fraction[place]
                    m = mass[world, place]
                    A = (m * constants.spacing) * H[world, p]
                    b = m * moved[world, p]
                    B = (m * constants.spacing) * (C[world, p] * (H[world, p] + identity()))
                    d = m * v[world, p]
                total_u = add(total_u, partial_u, world, brick, slot, corner, fx, A, b)
                total_v = add(total_v, partial_v, world, brick, slot, corner, fx, B, d)
        write(total_u, partial_u, inside.corners[brick, lane % cells], world, brick, lane)
        write(total_v, partial_v, inside.corners[brick, lane % cells], world, brick, lane)

    @kernel(options, **settings)
    def project_adj(
        # Parameters:
        constants: Constants,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        # In:
        moved: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        H: wp.array2d(dtype=mat),  # F − I
        each_u: wp.array2d(dtype=vec),  # ũ
        each_v: wp.array2d(dtype=vec),  # ṽ
        # Out:
        adj_x: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        adj_C: wp.array2d(dtype=mat),
        adj_F: wp.array2d(dtype=mat),
        # Out, added into:
        adj_mass: wp.array2d(dtype=real),
    ):
        """(Q6.adj), without the last term of the mass"""
        world, brick, lane = wp.tid()
        stage_u(each_u, inside, world, brick, lane)
        stage_v(each_v, inside, world, brick, lane)
        meet()
        for row in range(inside.rows[brick], inside.rows[brick + 1]):
            for slot in range(lane, turns, threads):
                place = place_of(inside, row, slot)
                corner = inside.corners[brick, slot % cells]
                row_of_p = int(-1)
                x_here = vec()
                v_here = vec()
                C_here = mat()
                F_here = mat()
                if place >= 0:
                    p = inside.order[place]
                    fx = inside.fraction[place]
                    m = mass[world, place]
                    of_u = value_u(each_u, inside, world, brick, corner, fx)
                    of_v = value_v(each_v, inside, world, brick, corner, fx)
                    U = gradient_u(each_u, inside, world, brick, corner, fx, constants.spacing)
                    V = gradient_v(each_v, inside, world, brick, corner, fx, constants.spacing)
                    F = H[world, p] + identity()
                    x_here = m * of_u
                    v_here = m * of_v
                    C_here = m * (V * wp.transpose(F))
                    F_here = m * (U + wp.transpose(C[world, p]) * V)
                    affine = wp.ddot(H[world, p], U) + wp.ddot(C[world, p] * F, V)
                    linear = wp.dot(moved[world, p], of_u) + wp.dot(v[world, p], of_v)
                    adj_mass[world, place] = adj_mass[world, place] + affine + linear
                    row_of_p = world * adj_x.shape[1] + p
                store_vec(adj_x, row_of_p, lane, x_here)
                store_vec(adj_v, row_of_p, lane, v_here)
                store_mat(adj_C, row_of_p, lane, C_here)
                store_mat(adj_F, row_of_p, lane, F_here)

    return SimpleNamespace(show=show, show_adj=show_adj, project=project, project_adj=project_adj)
