"""Mass and momentum on the grid as an observer sees them: P2G without any force, and its twin. Derivation: docs/math/transfer.md.

(p, m)_i += w m (v + C r, 1)                                                                     (O1)
g = p̄_i·(v + C r) + m̄_i,  x̄ += m Σ g ∇w − w Cᵀ p̄_i,  v̄ += m Σ w p̄_i,  C̄ += m Σ w p̄_i rᵀ        (O1.adj)
"""

import functools
from types import SimpleNamespace

import warp as wp

from softmpm.kernels.spline import spline
from softmpm.kernels.types import types


@functools.lru_cache(maxsize=None)
def raster(dim: int, dtype: str) -> SimpleNamespace:
    t, s = types(dim, dtype), spline(dim, dtype)
    real, vec, mat, node_vec, Scale, Motion, MotionAdj = (
        t.real,
        t.vec,
        t.mat,
        t.node,
        t.Scale,
        t.Motion,
        t.MotionAdj,
    )
    weights, slopes, offset, position = s.weights, s.slopes, s.offset, s.position
    weight, weight_slope, node_index, pack, momentum = (
        s.weight,
        s.weight_slope,
        s.node_index,
        s.pack,
        s.momentum,
    )
    module = f"softmpm.raster.d{dim}.{dtype}"

    @wp.kernel(module=module, enable_backward=False)
    def splat(
        # Parameters:
        scale: Scale,
        mass: wp.array(dtype=real),
        # In:
        now: Motion,
        # Out, added into:
        node: wp.array2d(dtype=node_vec),
    ):
        world, p = wp.tid()
        base = now.base[world, p]
        fx = now.fx[world, p]
        v = now.v[world, p]
        C = scale.spacing * now.C[world, p]
        m = mass[p]
        w = weights(fx)
        for n in range(s.count):
            o = offset(n)
            share = m * weight(w, o)
            wp.atomic_add(
                node,
                world,
                node_index(base, o, scale.shape),
                share * pack(v + C * (position(o) - fx), real(1.0)),
            )

    @wp.kernel(module=module, enable_backward=False)
    def splat_fixed(
        # Parameters:
        scale: Scale,
        mass: wp.array(dtype=real),
        unit: wp.array2d(dtype=wp.float64),  # of momentum and mass, (world, 2)
        # In:
        now: Motion,
        # Out, added into:
        node: wp.array3d(dtype=wp.int64),  # (world, node, dim + 1), in these units
    ):
        """As ``splat``, into integers, whose sum does not depend on the order."""
        world, p = wp.tid()
        base = now.base[world, p]
        fx = now.fx[world, p]
        v = now.v[world, p]
        C = scale.spacing * now.C[world, p]
        m = mass[p]
        w = weights(fx)
        for n in range(s.count):
            o = offset(n)
            i = node_index(base, o, scale.shape)
            share = m * weight(w, o)
            value = share * (v + C * (position(o) - fx))
            for axis in range(dim):
                whole = wp.rint(wp.float64(value[axis]) / unit[world, 0])
                wp.atomic_add(node, world, i, axis, wp.int64(whole))
            wp.atomic_add(node, world, i, dim, wp.int64(wp.rint(wp.float64(share) / unit[world, 1])))

    @wp.kernel(module=module, enable_backward=False)
    def splat_adj(
        # Parameters:
        scale: Scale,
        mass: wp.array(dtype=real),
        # In:
        now: Motion,
        adj_node: wp.array2d(dtype=node_vec),
        # Out, added into:
        adj_now: MotionAdj,
    ):
        world, p = wp.tid()
        base = now.base[world, p]
        fx = now.fx[world, p]
        v = now.v[world, p]
        C = scale.spacing * now.C[world, p]
        m = mass[p]
        w = weights(fx)
        slope = slopes(fx)
        adj_fx = vec()
        adj_v = vec()
        B = mat()
        for n in range(s.count):
            o = offset(n)
            r = position(o) - fx
            adj_i = adj_node[world, node_index(base, o, scale.shape)]
            adj_p = momentum(adj_i)
            share = weight(w, o)
            adj_fx += (wp.dot(adj_p, v + C * r) + adj_i[dim]) * weight_slope(w, slope, o) - share * (
                wp.transpose(C) * adj_p
            )
            adj_v += share * adj_p
            B += wp.outer(share * adj_p, r)
        adj_now.fx[world, p] = adj_now.fx[world, p] + m * adj_fx
        adj_now.v[world, p] = adj_now.v[world, p] + m * adj_v
        adj_now.C[world, p] = adj_now.C[world, p] + (m * scale.spacing) * B

    return SimpleNamespace(splat=splat, splat_fixed=splat_fixed, splat_adj=splat_adj)
