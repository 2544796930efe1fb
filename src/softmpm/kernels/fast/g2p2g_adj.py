"""Adjoint kernels of the fast scheme, with the same sums over warps. Derivation: docs/math/scatter.md.

From the last substep to the first, with M the momentum and mass of the nodes, V their velocity and a bar for adjoints:

    grid_adj      M̄ ← (G1.adj) of V̄, in place;  V ← (G1), (G2) of the M before;  the V̄ before ← 0
    g2p2g_adj   particles: M̄ → (T1.adj) → adjoint of the state → (T3.adj), (T2.adj) → the V̄ before

Nodes without mass retain their V and their V̄, as in g2p2g.py.

An additional launch between g2p2g_adj and grid_adj adds up the contributions in a deterministic model and on a CPU, as in g2p2g.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.fast.fixed_point import fixed
from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.gather_adj import stencil_adj
from softmpm.kernels.fast.native import BLOCK, NATIVE, native
from softmpm.kernels.fast.slabs import slabs
from softmpm.kernels.physics import status
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.grid_adj import grid_adj
from softmpm.kernels.physics.particle import particle, particle_adj
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def fused_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, one, adjoint = types(spec.dim, spec.dtype), particle(spec), particle_adj(spec, wanted)
    real, vec, mat, node_vec = t.real, t.vec, t.mat, t.aligned
    Constants, Packed, Window, ParticleAdj = t.Constants, t.Packed, t.Window, adjoint.ParticleAdj
    ParticleInputs, GridInputs = input_types(spec).ParticleInputs, input_types(spec).GridInputs
    adj_types = input_adj_types(spec, wanted)
    ParticleInputsAdj, GridInputsAdj = adj_types.ParticleInputsAdj, adj_types.GridInputsAdj
    s, n, dim = stencil(spec.dim, spec.dtype), native(spec.dim, spec.dtype), spec.dim
    sums_adj, first_node, unpack_base = stencil_adj(spec.dim, spec.dtype), s.first_node, s.unpack_base
    gather_adj, slope_adj = sums_adj.gather_adj, sums_adj.slope_adj
    aligned, head = s.aligned, s.head
    centre, place_of = fused(spec).centre, fused(spec).place_of
    particle_of, world_of = s.particle_of, s.world_of
    store_vec, store_mat = n.store_vec, n.store_mat
    scatter, load_node, store_node = n.scatter, n.load_node, n.store_node
    rotation, linear_momentum, affine_momentum = one.rotation, one.linear_momentum, one.affine_momentum
    gather, driven = s.gather, spec.driven
    momentum_adj, moved_adj = adjoint.momentum_adj, adjoint.moved_adj
    node_velocity, node_velocity_adj = grid(spec).node_velocity, grid_adj(spec, wanted).node_velocity_adj
    report, bad_gradient = status.report(spec.dim, spec.dtype).report, int(Kind.GRADIENT)
    row_fx, row_v, row_H, row_C = t.row_fx, t.row_v, t.row_h, t.row_c
    exact, give = spec.deterministic, fixed(dim).give
    take, leave = (fixed(dim).take, fixed(dim).leave) if exact else (load_node, store_node)
    Sums, Shares = (fixed(dim).Sums, fixed(dim).Shares) if exact else 2 * (wp.array(dtype=node_vec),)
    by_slabs, give_to_slabs = spec.slabs, slabs(dim, spec.dtype).give
    if by_slabs:
        Shares = slabs(dim, spec.dtype).Shares

    @kernel(NATIVE, grid_stride=False)
    def grid_velocity_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        # In:
        node: wp.array(dtype=node_vec),  # of this substep; empty after the last
        node_before: wp.array(dtype=node_vec),  # of the substep before; empty in the first
        # In and out:
        adj: Sums,  # adjoint of the velocity, then of momentum and mass
        # Out:
        velocity: wp.array(dtype=node_vec),  # of the substep before
        cleared: wp.array(dtype=node_vec),
        # Out, added into:
        adj_inputs: GridInputsAdj,
    ):
        i = wp.tid()
        world = world_of(i, window.count, velocity.shape[0])
        place = place_of(constants, window, world, i)
        here = node_vec()
        there = node_vec()
        if i < node.shape[0]:
            here = load_node(node, i)
        if i < node_before.shape[0]:
            there = load_node(node_before, i)
        await_previous()  # adj
        if i < node.shape[0]:
            adj_v = take(adj, i)
            if here[dim] > real(0.0):
                back = node_velocity_adj(
                    constants, inputs, world, place, head(here), here[dim], head(adj_v), i, adj_inputs
                )
                leave(adj, i, aligned(back.p, back.m))
        if i < node_before.shape[0]:
            if there[dim] > real(0.0):
                v = node_velocity(constants, inputs, world, place, head(there), there[dim])
                store_node(velocity, i, aligned(v, real(0.0)))
            if wp.static(not exact):
                store_node(cleared, i, node_vec())

    @wp.struct
    class Contribution:
        first: int  # node of a particle
        m: real
        g: vec
        b: vec
        A: mat
        H: mat
        Q: mat

    def of_particles(few: bool) -> wp.Kernel:
        """``g2p2g_adj`` for few particles or for more; registers are limited so that ``blocks`` blocks fit. Few do early what more have
        no registers for; these load after the wait, by plain loads, which are faster."""
        blocks = 2 if few else 3
        load = n.early if few else n.plain
        vector, matrix = load.vector, load.matrix
        base_of = n.early.base  # n.plain.base spills registers

        @wp.func
        def contribution(
            constants: Constants,
            inputs: ParticleInputs,
            window: Window,
            now: Packed,
            world: int,
            p: int,
            i: int,
            v: vec,
            C: mat,
        ) -> Contribution:
            """Contribution of a particle to its nodes (T1)."""
            out = Contribution()
            out.H = matrix(now.rows, i, row_H)
            out.g = centre(vector(now.rows, i, row_fx))
            base = unpack_base(base_of(now.base, i))
            out.first = world * window.count + first_node(base, window.origin[world], window.shape)
            out.m = inputs.mass[world, p]
            out.Q = rotation(inputs, world, p, out.H)
            out.A = affine_momentum(constants, inputs, world, p, C, out.H, out.Q)
            out.b = linear_momentum(constants, inputs, world, p, v) - out.A * out.g
            return out

        @kernel(NATIVE, grid_stride=False, launch_bounds=(BLOCK, blocks))
        def g2p2g_adj(
            # Parameters:
            constants: Constants,
            inputs: ParticleInputs,
            window: Window,
            back: int,  # substeps from the end
            start: bool,  # nothing before
            end: bool,  # nothing after
            per_warp: int,
            count: int,
            total: int,
            order: wp.array(dtype=wp.int32),
            # In:
            before: Packed,
            now: Packed,
            velocity: wp.array(dtype=node_vec),  # of the substep before
            adj_node: wp.array(dtype=node_vec),  # of this substep
            # In and out:
            adj_now: wp.array(dtype=real),
            # Out:
            words: wp.array(dtype=wp.int64),
            # Out, added into:
            adj_inputs: ParticleInputsAdj,
            adj_velocity: Shares,  # of the substep before
        ):
            i = particle_of(wp.tid(), per_warp, total)
            at = Contribution()
            world = int(0)
            first = int(-1)
            plane = int(0)
            v = vec()
            C = mat()
            if i < total:
                world = world_of(i, count, total)
                if wp.static(few):
                    v = vector(now.rows, i, row_v)
                    C = matrix(now.rows, i, row_C)
                    if not end:
                        at = contribution(constants, inputs, window, now, world, i - world * count, i, v, C)
            await_previous()  # the adjoints and the velocity
            g = vec()
            b = vec()
            B = mat()
            if i < total:
                p = i - world * count
                origin = window.origin[world]
                held = world * window.count
                old_fx = vector(before.rows, i, row_fx)
                adj = ParticleAdj()
                adj.fx = vector(adj_now, i, row_fx)
                adj.H = matrix(adj_now, i, row_H)
                if wp.static(not few):
                    v = vector(now.rows, i, row_v)
                    C = matrix(now.rows, i, row_C)
                if end:
                    adj.v = vector(adj_now, i, row_v)
                    adj.C = matrix(adj_now, i, row_C)
                else:
                    if wp.static(not few):
                        at = contribution(constants, inputs, window, now, world, p, i, v, C)
                    sums = gather_adj(adj_node, at.first, window.shape, at.g, at.b, at.A, at.m)
                    B = sums.outer - wp.outer(sums.value, at.g)
                    # (T1.adj)
                    more = momentum_adj(
                        constants, inputs, world, p, v, C, at.H, at.Q, sums.value, sums.mass, B, adj_inputs
                    )
                    adj.fx += sums.slope - wp.transpose(at.A) * sums.value  # (A6)
                    adj.v = more.v
                    adj.C = more.C
                    adj.H += more.H
                    size = (
                        wp.dot(adj.fx, adj.fx)
                        + wp.dot(adj.v, adj.v)
                        + wp.ddot(adj.C, adj.C)
                        + wp.ddot(adj.H, adj.H)
                    )
                    if not wp.isfinite(size):
                        report(words, world, back, bad_gradient, order[i])
                if start:
                    store_vec(adj_now, i, row_v, adj.v)
                    store_mat(adj_now, i, row_C, adj.C)
                else:
                    base = unpack_base(before.base[i])
                    first = held + first_node(base, origin, window.shape)
                    plane = base[0] - origin[0]
                    g = centre(old_fx)
                    adj = moved_adj(
                        constants, inputs, world, p, matrix(before.rows, i, row_H), C, adj, adj_inputs
                    )  # (T3.adj)
                    if wp.static(driven):
                        # The velocity of a driven particle is not that of the nodes around it.
                        v = gather(velocity, first, window.shape, g).value
                    B = adj.C
                    b = adj.v - B * g
                    sums = slope_adj(velocity, first, window.shape, g, b, B, real(0.0))
                    adj.fx += sums.slope - wp.transpose(B) * v  # (T2.adj)
                store_vec(adj_now, i, row_fx, adj.fx)
                store_mat(adj_now, i, row_H, adj.H)
            if not start:
                if wp.static(exact):
                    give(adj_velocity, i, count, total, b, B)
                if wp.static(by_slabs):
                    give_to_slabs(adj_velocity, i, plane, b, B)
                if wp.static(not (exact or by_slabs)):
                    scatter(adj_velocity, window.shape, first, g, b, B, real(0.0))

        return g2p2g_adj

    return SimpleNamespace(
        grid_velocity_adj=grid_velocity_adj, g2p2g_adj={few: of_particles(few) for few in (False, True)}
    )
