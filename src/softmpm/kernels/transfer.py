"""Particles to grid and back: the plain three-kernel scheme, with its twins. Derivation: docs/math/transfer.md.

With r = x_i − x_p, D = dx²/4, w = w_i(x_p), A = m C − Δt V⁰ τ / D:

    (p, m)_i += w (m v + A r, m)                                                                     (T1)
    v' = Σ w v_i,  C' = Σ w v_i rᵀ / D                                                               (T2)
    x' = x + Δt v',  H' = H + Δt C' (I + H)                                                          (T3)

Adjoints, ∇w being the derivative with respect to x_p:

    g = p̄_i·(m v + A r) + m m̄_i,  x̄ += Σ g ∇w − w Aᵀ p̄_i,  Ā = Σ w p̄_i rᵀ,  C̄ += m Ā               (T1.adj)
    v̄ += m Σ w p̄_i,  m̄ += Σ w (p̄_i·(v + C r) + m̄_i),  τ̄ = −(Δt V⁰ / D) Ā
    v̄' += Δt x̄',  C̄' += Δt H̄' (I + H)ᵀ,  H̄ += H̄' + Δt C'ᵀ H̄',  x̄ += x̄'                              (T3.adj)
    v̄_i += w (v̄' + C̄' r / D),  x̄ += Σ ∇w (v_i·(v̄' + C̄' r / D)) − w C̄'ᵀ v_i / D                     (T2.adj)

Positions are held as base node and fraction, fx = x / dx − base, hence ∂L/∂fx = dx ∂L/∂x. In float32 fx is a compensated
sum: what adding Δt v' / dx loses is kept and added in the next step.
Sources: Hu et al. 2018 ("MLS-MPM", Eq. 29), Jiang et al. 2015 ("APIC"); the adjoint as in Hu et al. 2019, rederived.
"""

import functools
from types import SimpleNamespace

import warp as wp

from softmpm.kernels import failure
from softmpm.kernels.elasticity import elasticity
from softmpm.kernels.solid import solid, solid_adj
from softmpm.kernels.spline import spline
from softmpm.kernels.types import Spec, Wanted, adj_module, solid_adj_type, solid_types, types
from softmpm.watch import Kind


@functools.lru_cache(maxsize=None)
def transfer(spec: Spec) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, vec, mat, node_vec, Scale, Motion = t.real, t.vec, t.mat, t.node, t.Scale, t.Motion
    Solid, stress = solid_types(spec).Solid, solid(spec).stress
    s, dim = spline(spec.dim, spec.dtype), spec.dim
    weights, offset, position, weight, node_index = s.weights, s.offset, s.position, s.weight, s.node_index
    pack = s.pack
    identity = elasticity(spec.dim, spec.dtype).identity
    running, rounds = failure.report(spec.dim, spec.dtype).running, spec.dtype == "float32"
    sound, complain = failure.check(spec).sound, failure.check(spec).complain

    @wp.func
    def affine_momentum(scale: Scale, body: Solid, world: int, p: int, C: mat, H: mat) -> mat:
        """A [kg/s] of (T1)."""
        impulse = real(4.0) * scale.dt * body.volume[p] / (scale.spacing * scale.spacing)
        return body.mass[world, p] * C - impulse * stress(body, world, p, H)

    @wp.kernel(module=spec.module, enable_backward=False)
    def p2g(
        # Parameters:
        scale: Scale,
        body: Solid,
        # In:
        now: Motion,
        # Out, added into:
        node: wp.array2d(dtype=node_vec),
    ):
        world, p = wp.tid()
        base = now.base[world, p]  # valid also in a world that failed: it was not moved
        fx = now.fx[world, p]
        m = body.mass[world, p]
        mv = m * now.v[world, p]
        A = scale.spacing * affine_momentum(scale, body, world, p, now.C[world, p], now.H[world, p])
        w = weights(fx)
        for n in range(s.count):
            o = offset(n)
            share = weight(w, o)
            wp.atomic_add(
                node, world, node_index(base, o, scale.shape), share * pack(mv + A * (position(o) - fx), m)
            )

    @wp.kernel(module=spec.module, enable_backward=False)
    def g2p(
        # Parameters:
        scale: Scale,
        body: Solid,
        substep: int,
        # In:
        velocity: wp.array2d(dtype=vec),
        now: Motion,
        # Out:
        watch: wp.array(dtype=wp.int64),
        then: Motion,
    ):
        world, p = wp.tid()
        base = now.base[world, p]
        fx = now.fx[world, p]
        H = now.H[world, p]
        if not running(watch, world):
            then.base[world, p] = base
            then.fx[world, p] = fx
            then.v[world, p] = now.v[world, p]
            then.C[world, p] = now.C[world, p]
            then.H[world, p] = H
            if wp.static(rounds):
                then.fx_low[world, p] = now.fx_low[world, p]
            return
        v = vec()
        B = mat()
        w = weights(fx)
        for n in range(s.count):
            o = offset(n)
            share = weight(w, o) * velocity[world, node_index(base, o, scale.shape)]
            v += share
            B += wp.outer(share, position(o) - fx)
        C = (real(4.0) / scale.spacing) * B
        H = H + scale.dt * (C + C * H)
        step = (scale.dt / scale.spacing) * v
        if wp.static(rounds):
            step += now.fx_low[world, p]
            then.fx_low[world, p] = step - ((fx + step) - fx)
        fx = fx + step
        cells = vec()
        new_base = base
        for axis in range(dim):
            cells[axis] = wp.floor(fx[axis] - real(0.5))
            new_base[axis] = base[axis] + int(cells[axis])
        if sound(body, scale.shape, p, fx, new_base, H):
            base = new_base
            fx = fx - cells
        else:
            complain(watch, world, p, substep, fx, H)
        then.base[world, p] = base
        then.fx[world, p] = fx
        then.v[world, p] = v
        then.C[world, p] = C
        then.H[world, p] = H

    return SimpleNamespace(affine_momentum=affine_momentum, p2g=p2g, g2p=g2p, identity=identity)


@functools.lru_cache(maxsize=None)
def transfer_adj(spec: Spec, wanted: Wanted) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, vec, mat, node_vec, Scale, Motion, MotionAdj = (
        t.real,
        t.vec,
        t.mat,
        t.node,
        t.Scale,
        t.Motion,
        t.MotionAdj,
    )
    Solid, SolidAdj, stress_adj = (
        solid_types(spec).Solid,
        solid_adj_type(spec, wanted),
        solid_adj(spec, wanted).stress_adj,
    )
    s, dim = spline(spec.dim, spec.dtype), spec.dim
    weights, slopes, offset, position = s.weights, s.slopes, s.offset, s.position
    weight, weight_slope, node_index = s.weight, s.weight_slope, s.node_index
    momentum, identity = s.momentum, elasticity(spec.dim, spec.dtype).identity
    affine_momentum, report = transfer(spec).affine_momentum, failure.report(spec.dim, spec.dtype).report
    bad_gradient = int(Kind.GRADIENT)

    @wp.kernel(module=adj_module(spec, wanted), enable_backward=False)
    def p2g_adj(
        # Parameters:
        scale: Scale,
        body: Solid,
        substep: int,
        # In:
        now: Motion,
        adj_node: wp.array2d(dtype=node_vec),
        # Out, added into:
        watch: wp.array(dtype=wp.int64),
        adj_body: SolidAdj,
        adj_now: MotionAdj,
    ):
        world, p = wp.tid()
        base = now.base[world, p]
        fx = now.fx[world, p]
        v = now.v[world, p]
        C = now.C[world, p]
        H = now.H[world, p]
        m = body.mass[world, p]
        A = scale.spacing * affine_momentum(scale, body, world, p, C, H)  # per cell, as B below
        w = weights(fx)
        slope = slopes(fx)
        adj_mv = vec()
        adj_m = real(0.0)
        B = mat()  # Σ w p̄_i (r / dx)ᵀ
        adj_fx = vec()
        for n in range(s.count):
            o = offset(n)
            r = position(o) - fx
            adj_i = adj_node[world, node_index(base, o, scale.shape)]
            adj_p = momentum(adj_i)
            share = weight(w, o)
            g = wp.dot(adj_p, m * v + A * r) + m * adj_i[dim]
            adj_fx += g * weight_slope(w, slope, o) - share * (wp.transpose(A) * adj_p)
            adj_mv += share * adj_p
            adj_m += share * adj_i[dim]
            B += wp.outer(share * adj_p, r)
        adj_A = scale.spacing * B
        impulse = real(4.0) * scale.dt * body.volume[p] / (scale.spacing * scale.spacing)
        adj_v = adj_now.v[world, p] + m * adj_mv
        adj_C = adj_now.C[world, p] + m * adj_A
        adj_H = adj_now.H[world, p] + stress_adj(body, world, p, H, -impulse * adj_A, adj_body)
        adj_fx += adj_now.fx[world, p]
        if wp.static(wanted.material):
            adj_body.mass[world, p] = adj_body.mass[world, p] + adj_m + wp.dot(adj_mv, v) + wp.ddot(adj_A, C)
        adj_now.fx[world, p] = adj_fx
        adj_now.v[world, p] = adj_v
        adj_now.C[world, p] = adj_C
        adj_now.H[world, p] = adj_H
        size = wp.dot(adj_fx, adj_fx) + wp.dot(adj_v, adj_v) + wp.ddot(adj_C, adj_C) + wp.ddot(adj_H, adj_H)
        if not wp.isfinite(size):
            report(watch, world, substep, bad_gradient, p)

    @wp.kernel(module=adj_module(spec, wanted), enable_backward=False)
    def g2p_adj(
        # Parameters:
        scale: Scale,
        # In:
        velocity: wp.array2d(dtype=vec),
        now: Motion,
        then: Motion,
        adj_then: MotionAdj,
        # Out, added into:
        adj_velocity: wp.array2d(dtype=vec),
        adj_now: MotionAdj,
    ):
        world, p = wp.tid()
        base = now.base[world, p]
        fx = now.fx[world, p]
        adj_H = adj_then.H[world, p]
        adj_fx = adj_then.fx[world, p]
        adj_v = adj_then.v[world, p] + (scale.dt / scale.spacing) * adj_fx
        adj_C = adj_then.C[world, p] + scale.dt * (adj_H * wp.transpose(identity() + now.H[world, p]))
        adj_now.H[world, p] = (
            adj_now.H[world, p] + adj_H + scale.dt * (wp.transpose(then.C[world, p]) * adj_H)
        )  # (T3.adj)
        adj_B = (real(4.0) / scale.spacing) * adj_C
        w = weights(fx)
        slope = slopes(fx)
        for n in range(s.count):
            o = offset(n)
            i = node_index(base, o, scale.shape)
            r = position(o) - fx
            v_i = velocity[world, i]
            adj_i = adj_v + adj_B * r
            share = weight(w, o)
            wp.atomic_add(adj_velocity, world, i, share * adj_i)
            adj_fx += wp.dot(v_i, adj_i) * weight_slope(w, slope, o) - share * (wp.transpose(adj_B) * v_i)
        adj_now.fx[world, p] = adj_now.fx[world, p] + adj_fx

    return SimpleNamespace(p2g_adj=p2g_adj, g2p_adj=g2p_adj)
