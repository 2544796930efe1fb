"""Particles to grid and back: the three kernels of the plain scheme, with their adjoints. Derivation: docs/math/transfer.md.

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

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory, kernel_in_order
from softmpm.kernels.physics import status
from softmpm.kernels.physics.particle import particle, particle_adj
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


def transfer(spec: Spec, ordered: bool = False) -> SimpleNamespace:
    """Both kernels; ``ordered``: a GPU adds to a node in the order of the particles."""
    return SimpleNamespace(p2g=_p2g(spec, ordered), g2p=_g2p(spec))


def transfer_adj(spec: Spec, wanted: RequestedGrads, ordered: bool = False) -> SimpleNamespace:
    """Their adjoints, likewise."""
    return SimpleNamespace(p2g_adj=_p2g_adj(spec, wanted), g2p_adj=_g2p_adj(spec, wanted, ordered))


@kernel_factory
def _p2g(spec: Spec, ordered: bool):
    t, s, one = types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype), particle(spec)
    node_vec = t.node
    Constants = t.Constants
    Motion = t.Motion
    ParticleInputs = input_types(spec).ParticleInputs
    weights, offset, position, weight, node_index = s.weights, s.offset, s.position, s.weight, s.node_index
    rotation, linear_momentum, affine_momentum = one.rotation, one.linear_momentum, one.affine_momentum
    pack, define = s.pack, kernel_in_order(s.count) if ordered else kernel()

    @define
    def p2g(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        # In:
        now: Motion,
        # Out, added into:
        node: wp.array2d(dtype=node_vec),
    ):
        world, p = wp.tid()
        base = now.base[world, p]  # valid also in a world that failed: it was not moved
        fx = now.fx[world, p]
        m = inputs.mass[world, p]
        mv = linear_momentum(constants, inputs, world, p, now.v[world, p])
        H = now.H[world, p]
        A = affine_momentum(constants, inputs, world, p, now.C[world, p], H, rotation(inputs, world, p, H))
        w = weights(fx)
        for n in range(s.count):  # (T1)
            o = offset(n)
            share = weight(w, o)
            wp.atomic_add(
                node,
                world,
                node_index(base, o, constants.shape),
                share * pack(mv + A * (position(o) - fx), m),
            )

    return p2g


@kernel_factory
def _g2p(spec: Spec):
    t, s, one = types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype), particle(spec)
    vec, mat, ivec, Constants, Motion = t.vec, t.mat, t.ivec, t.Constants, t.Motion
    weights, offset, position, weight, node_index = s.weights, s.offset, s.position, s.weight, s.node_index
    ParticleInputs, Particle, moved = input_types(spec).ParticleInputs, one.Particle, one.moved
    running, rounds = status.report(spec.dim, spec.dtype).running, spec.dtype == "float32"
    report_invalid = status.check(spec).report_invalid

    @kernel()
    def g2p(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        substep: int,
        # In:
        velocity: wp.array2d(dtype=vec),
        now: Motion,
        # Out:
        words: wp.array(dtype=wp.int64),
        then: Motion,
    ):
        world, p = wp.tid()
        old = Particle()
        old.base = now.base[world, p]
        old.fx = now.fx[world, p]
        old.H = now.H[world, p]
        if wp.static(rounds):
            old.low = now.fx_low[world, p]
        new = Particle()
        if running(words, world):
            v = vec()
            B = mat()
            w = weights(old.fx)
            for n in range(s.count):  # (T2)
                o = offset(n)
                share = weight(w, o) * velocity[world, node_index(old.base, o, constants.shape)]
                v += share
                B += wp.outer(share, position(o) - old.fx)
            new = moved(constants, inputs, world, p, ivec(), constants.shape, old, v, B)  # (T3)
            if not new.valid:
                report_invalid(words, constants, world, p, substep, new.fx, new.base, new.H)
                new.base = old.base
        else:
            new = old
            new.v = now.v[world, p]
            new.C = now.C[world, p]
        then.base[world, p] = new.base
        then.fx[world, p] = new.fx
        then.v[world, p] = new.v
        then.C[world, p] = new.C
        then.H[world, p] = new.H
        if wp.static(rounds):
            then.fx_low[world, p] = new.low

    return g2p


@kernel_factory
def _p2g_adj(spec: Spec, wanted: RequestedGrads):
    t, s, one = types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype), particle(spec)
    real, vec, mat, node_vec, dim = t.real, t.vec, t.mat, t.node, spec.dim
    Constants, Motion, MotionAdj = t.Constants, t.Motion, t.MotionAdj
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    weights, slopes, offset, position = s.weights, s.slopes, s.offset, s.position
    weight, weight_slope, node_index, momentum = s.weight, s.weight_slope, s.node_index, s.momentum
    rotation, linear_momentum, affine_momentum = one.rotation, one.linear_momentum, one.affine_momentum
    momentum_adj = particle_adj(spec, wanted).momentum_adj
    report, bad_gradient = status.report(spec.dim, spec.dtype).report, int(Kind.GRADIENT)

    @kernel()
    def p2g_adj(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        substep: int,
        # In:
        now: Motion,
        adj_node: wp.array2d(dtype=node_vec),
        # Out, added into:
        words: wp.array(dtype=wp.int64),
        adj_inputs: ParticleInputsAdj,
        adj_now: MotionAdj,
    ):
        world, p = wp.tid()
        base = now.base[world, p]
        fx = now.fx[world, p]
        v = now.v[world, p]
        C = now.C[world, p]
        H = now.H[world, p]
        m = inputs.mass[world, p]
        mv = linear_momentum(constants, inputs, world, p, v)
        Q = rotation(inputs, world, p, H)
        A = affine_momentum(constants, inputs, world, p, C, H, Q)
        w = weights(fx)
        slope = slopes(fx)
        adj_mv = vec()
        adj_m = real(0.0)
        B = mat()  # Σ w p̄_i rᵀ, r in cells
        adj_fx = vec()
        for n in range(s.count):  # (T1.adj)
            o = offset(n)
            r = position(o) - fx
            adj_i = adj_node[world, node_index(base, o, constants.shape)]
            adj_p = momentum(adj_i)
            share = weight(w, o)
            g = wp.dot(adj_p, mv + A * r) + m * adj_i[dim]
            adj_fx += g * weight_slope(w, slope, o) - share * (wp.transpose(A) * adj_p)
            adj_mv += share * adj_p
            adj_m += share * adj_i[dim]
            B += wp.outer(share * adj_p, r)
        adj = momentum_adj(constants, inputs, world, p, v, C, H, Q, adj_mv, adj_m, B, adj_inputs)
        adj.fx = adj_fx + adj_now.fx[world, p]
        adj.v += adj_now.v[world, p]
        adj.C += adj_now.C[world, p]
        adj.H += adj_now.H[world, p]
        adj_now.fx[world, p] = adj.fx
        adj_now.v[world, p] = adj.v
        adj_now.C[world, p] = adj.C
        adj_now.H[world, p] = adj.H
        size = wp.dot(adj.fx, adj.fx) + wp.dot(adj.v, adj.v) + wp.ddot(adj.C, adj.C) + wp.ddot(adj.H, adj.H)
        if not wp.isfinite(size):
            report(words, world, substep, bad_gradient, p)

    return p2g_adj


@kernel_factory
def _g2p_adj(spec: Spec, wanted: RequestedGrads, ordered: bool):
    t, s, one = types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype), particle_adj(spec, wanted)
    vec, Constants, Motion, MotionAdj = t.vec, t.Constants, t.Motion, t.MotionAdj
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    weights, slopes, offset, position = s.weights, s.slopes, s.offset, s.position
    weight, weight_slope, node_index = s.weight, s.weight_slope, s.node_index
    ParticleAdj, moved_adj = one.ParticleAdj, one.moved_adj
    define = kernel_in_order(s.count) if ordered else kernel()

    @define
    def g2p_adj(
        # Parameters:
        constants: Constants,
        inputs: ParticleInputs,
        # In:
        velocity: wp.array2d(dtype=vec),
        now: Motion,
        then: Motion,
        adj_then: MotionAdj,
        # Out, added into:
        adj_inputs: ParticleInputsAdj,
        adj_velocity: wp.array2d(dtype=vec),
        adj_now: MotionAdj,
    ):
        world, p = wp.tid()
        base = now.base[world, p]
        fx = now.fx[world, p]
        adj_new = ParticleAdj()
        adj_new.fx = adj_then.fx[world, p]
        adj_new.v = adj_then.v[world, p]
        adj_new.C = adj_then.C[world, p]
        adj_new.H = adj_then.H[world, p]
        adj = moved_adj(
            constants, inputs, world, p, now.H[world, p], then.C[world, p], adj_new, adj_inputs
        )  # (T3.adj)
        adj_now.H[world, p] = adj_now.H[world, p] + adj.H
        adj_fx = adj.fx
        w = weights(fx)
        slope = slopes(fx)
        for n in range(s.count):  # (T2.adj)
            o = offset(n)
            i = node_index(base, o, constants.shape)
            r = position(o) - fx
            v_i = velocity[world, i]
            adj_i = adj.v + adj.C * r
            share = weight(w, o)
            wp.atomic_add(adj_velocity, world, i, share * adj_i)
            adj_fx += wp.dot(v_i, adj_i) * weight_slope(w, slope, o) - share * (wp.transpose(adj.C) * v_i)
        adj_now.fx[world, p] = adj_now.fx[world, p] + adj_fx

    return g2p_adj
