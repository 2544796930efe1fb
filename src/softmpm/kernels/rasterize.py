"""Mass and velocity on the grid for observers: P2G without any force, and its adjoint. Derivation: docs/math/transfer.md.

(p, m)_i += w m (v + C r, 1),   v_i = p_i / m_i where m_i > 0, else 0                   (O1)
p̄_i = v̄_i / m_i,   m̄_i −= p̄_i·v_i
g = p̄_i·(v + C r) + m̄_i
x̄ = m Σ g ∇w − w Cᵀ p̄_i,   v̄ = m Σ w p̄_i,   C̄ = m Σ w p̄_i rᵀ                          (O1.adj)
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel, kernel_factory, kernel_in_order
from softmpm.kernels.convert import conversion
from softmpm.kernels.physics import status
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import types


@kernel_factory
def raster(dim: int, dtype: str) -> SimpleNamespace:
    t, s = types(dim, dtype), spline(dim, dtype)
    real, vec, mat, node_vec, Constants = t.real, t.vec, t.mat, t.node, t.Constants
    Entered, entered = conversion(dim, dtype).Entered, conversion(dim, dtype).entered
    weights, slopes, offset, position = s.weights, s.slopes, s.offset, s.position
    weight, weight_slope, node_index = s.weight, s.weight_slope, s.node_index
    pack, momentum, report = s.pack, s.momentum, status.report(dim, dtype).report
    bad_start, bad_gradient = int(Kind.START), int(Kind.GRADIENT)

    @wp.func
    def placed(constants: Constants, x: vec, v: vec, C: mat) -> Entered:
        """A particle as the kernels hold it; F does not enter and is taken as I."""
        return entered(constants, x, v, C, wp.identity(n=dim, dtype=real), vec(), mat())

    def splat(
        # Parameters:
        constants: Constants,
        mass: wp.array(dtype=real),
        # In:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        # Out, lowered:
        words: wp.array(dtype=wp.int64),
        # Out, added into:
        node: wp.array2d(dtype=node_vec),
    ):
        world, p = wp.tid()
        speed = v[world, p]
        at = placed(constants, x[world, p], speed, C[world, p])
        if not at.valid:
            report(words, world, 0, bad_start, p)
        affine = constants.spacing * C[world, p]
        m = mass[p]
        w = weights(at.fx)
        for n in range(s.count):
            o = offset(n)
            share = m * weight(w, o)
            wp.atomic_add(
                node,
                world,
                node_index(at.base, o, constants.shape),
                share * pack(speed + affine * (position(o) - at.fx), real(1.0)),
            )

    @kernel()
    def splat_fixed(
        # Parameters:
        constants: Constants,
        mass: wp.array(dtype=real),
        unit: wp.array2d(dtype=wp.float64),  # of momentum and mass, (world, 2)
        # In:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        # Out, lowered:
        words: wp.array(dtype=wp.int64),
        # Out, added into:
        node: wp.array3d(dtype=wp.int64),  # (world, node, dim + 1), in these units
    ):
        """As ``splat``, into integers, whose sum does not depend on the order.

        A CUDA graph may hold it, unlike ``splat_in_order``; the digits do for float32.
        """
        world, p = wp.tid()
        speed = v[world, p]
        at = placed(constants, x[world, p], speed, C[world, p])
        if not at.valid:
            report(words, world, 0, bad_start, p)
        affine = constants.spacing * C[world, p]
        m = mass[p]
        w = weights(at.fx)
        for n in range(s.count):
            o = offset(n)
            i = node_index(at.base, o, constants.shape)
            share = m * weight(w, o)
            value = share * (speed + affine * (position(o) - at.fx))
            for axis in range(dim):
                whole = wp.rint(wp.float64(value[axis]) / unit[world, 0])
                wp.atomic_add(node, world, i, axis, wp.int64(whole))
            wp.atomic_add(node, world, i, dim, wp.int64(wp.rint(wp.float64(share) / unit[world, 1])))

    @kernel()
    def splat_adj(
        # Parameters:
        constants: Constants,
        mass: wp.array(dtype=real),
        # In:
        x: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        C: wp.array2d(dtype=mat),
        adj_node: wp.array2d(dtype=node_vec),
        # Out, lowered:
        words: wp.array(dtype=wp.int64),
        # Out:
        adj_x: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        adj_C: wp.array2d(dtype=mat),
    ):
        world, p = wp.tid()
        speed = v[world, p]
        at = placed(constants, x[world, p], speed, C[world, p])
        affine = constants.spacing * C[world, p]
        m = mass[p]
        w = weights(at.fx)
        slope = slopes(at.fx)
        sum_fx = vec()
        sum_v = vec()
        sum_C = mat()
        for n in range(s.count):
            o = offset(n)
            r = position(o) - at.fx
            adj_i = adj_node[world, node_index(at.base, o, constants.shape)]
            adj_p = momentum(adj_i)
            share = weight(w, o)
            sum_fx += (wp.dot(adj_p, speed + affine * r) + adj_i[dim]) * weight_slope(w, slope, o)
            sum_fx -= share * (wp.transpose(affine) * adj_p)
            sum_v += share * adj_p
            sum_C += wp.outer(share * adj_p, r)
        sum_fx *= m / constants.spacing
        sum_v *= m
        sum_C *= m * constants.spacing
        if not (wp.isfinite(sum_fx) and wp.isfinite(sum_v) and wp.isfinite(sum_C)):
            report(words, world, 0, bad_gradient, p)
        adj_x[world, p] = sum_fx
        adj_v[world, p] = sum_v
        adj_C[world, p] = sum_C

    @kernel()
    def divide(
        # In:
        node: wp.array2d(dtype=node_vec),
        # Out:
        mass: wp.array2d(dtype=real),
        velocity: wp.array3d(dtype=real),  # (world, node, dim)
    ):
        world, i = wp.tid()
        m = node[world, i][dim]
        mass[world, i] = m
        for axis in range(dim):
            velocity[world, i, axis] = wp.where(m > real(0.0), node[world, i][axis] / m, real(0.0))

    @kernel()
    def divide_adj(
        # In:
        mass: wp.array2d(dtype=real),
        velocity: wp.array3d(dtype=real),
        adj_mass: wp.array2d(dtype=real),
        adj_velocity: wp.array3d(dtype=real),
        # Out:
        adj_node: wp.array2d(dtype=node_vec),
    ):
        world, i = wp.tid()
        m = mass[world, i]
        adj_p = vec()
        adj_m = adj_mass[world, i]
        if m > real(0.0):
            for axis in range(dim):
                adj_p[axis] = adj_velocity[world, i, axis] / m  # never 1/m², which overflows
                adj_m -= adj_p[axis] * velocity[world, i, axis]
        adj_node[world, i] = pack(adj_p, adj_m)

    return SimpleNamespace(
        splat=kernel()(splat),
        splat_in_order=kernel_in_order(s.count)(splat),
        splat_fixed=splat_fixed,
        splat_adj=splat_adj,
        divide=divide,
        divide_adj=divide_adj,
    )
