"""Adjoint of the gather, axis by axis as well. Derivation: docs/math/scatter.md.

The weights of a particle are multiplied by a number s at each of its nodes, so their adjoint is a sum over the slopes of the weights:

    Σ s ∇w,   w₋₁' = g − ½,  w₀' = −2g,  w₊₁' = g + ½                                                (A2), (A5)
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import native
from softmpm.kernels.structs import types


@kernel_factory
def stencil_adj(dim: int, dtype: str) -> SimpleNamespace:
    t, one = types(dim, dtype), stencil(dim, dtype)
    real, vec, mat, ivec, node_vec = t.real, t.vec, t.mat, t.ivec, t.aligned
    triple, Sums, head = one.triple, one.Sums, one.head
    load_node = native(dim, dtype).load_node

    @wp.func
    def slopes(g: real) -> triple:
        return triple(g - real(0.5), real(-2.0) * g, g + real(0.5))

    @wp.func
    def weights(g: real) -> triple:
        """Weights from the same terms as the slopes, which avoids register spills; in an adjoint they need not sum to exactly one."""
        low = real(0.5) - g
        high = real(0.5) + g
        return triple(real(0.5) * low * low, real(0.75) - g * g, real(0.5) * high * high)

    def gather_adj(everything: bool):
        """Function that sums ``slope`` (A5), and the other three sums if ``everything`` is requested."""
        last = dim - 1  # the axis that is summed first; nodes are consecutive along it

        @wp.func
        def node_term(node: node_vec, b: vec, mu: real) -> real:
            term = wp.dot(head(node), b)
            if wp.static(everything):
                term += node[dim] * mu
            return term

        if dim == 2:

            @wp.func
            def sums_adj(
                node: wp.array(dtype=node_vec), first: int, shape: ivec, g: vec, b: vec, A: mat, mu: real
            ) -> Sums:
                wx = weights(g[0])
                wy = weights(g[1])
                sx = slopes(g[0])
                sy = slopes(g[1])
                column = wp.transpose(A)[last]
                sums = Sums()
                along_x = vec()
                along_y = vec()
                for i in range(3):
                    at = first + i * shape[1]
                    here = b
                    if i == 0:
                        here -= wp.transpose(A)[0]
                    if i == 2:
                        here += wp.transpose(A)[0]
                    p = load_node(node, at)
                    q = load_node(node, at + 1)
                    r = load_node(node, at + 2)
                    tp = node_term(p, here - column, mu)
                    tq = node_term(q, here, mu)
                    tr = node_term(r, here + column, mu)
                    sums.slope += vec(
                        sx[i] * (wy[0] * tp + wy[1] * tq + wy[2] * tr),
                        wx[i] * (sy[0] * tp + sy[1] * tq + sy[2] * tr),
                    )
                    if wp.static(everything):
                        row = wy[0] * p + wy[1] * q + wy[2] * r
                        sums.value += wx[i] * head(row)
                        sums.mass += wx[i] * row[dim]
                        along_y += wx[i] * (wy[2] * head(r) - wy[0] * head(p))
                        if i == 0:
                            along_x -= wx[0] * head(row)
                        if i == 2:
                            along_x += wx[2] * head(row)
                sums.outer = wp.matrix_from_cols(along_x, along_y)
                return sums
        else:

            @wp.func
            def sums_adj(
                node: wp.array(dtype=node_vec), first: int, shape: ivec, g: vec, b: vec, A: mat, mu: real
            ) -> Sums:
                wx = weights(g[0])
                wy = weights(g[1])
                wz = weights(g[2])
                sx = slopes(g[0])
                sy = slopes(g[1])
                sz = slopes(g[2])
                columns = wp.transpose(A)
                column = columns[last]
                sums = Sums()
                along_x = vec()
                along_y = vec()
                along_z = vec()
                for i in range(3):
                    plane = node_vec()
                    plane_y = vec()
                    plane_z = vec()
                    term = vec()
                    for j in range(3):
                        at = first + (i * shape[1] + j) * shape[2]
                        here = b
                        if i == 0:
                            here -= columns[0]
                        if i == 2:
                            here += columns[0]
                        if j == 0:
                            here -= columns[1]
                        if j == 2:
                            here += columns[1]
                        p = load_node(node, at)
                        q = load_node(node, at + 1)
                        r = load_node(node, at + 2)
                        tp = node_term(p, here - column, mu)
                        tq = node_term(q, here, mu)
                        tr = node_term(r, here + column, mu)
                        across = wz[0] * tp + wz[1] * tq + wz[2] * tr
                        term += vec(
                            wy[j] * across, sy[j] * across, wy[j] * (sz[0] * tp + sz[1] * tq + sz[2] * tr)
                        )
                        if wp.static(everything):
                            row = wz[0] * p + wz[1] * q + wz[2] * r
                            plane += wy[j] * row
                            plane_z += wy[j] * (wz[2] * head(r) - wz[0] * head(p))
                            if j == 0:
                                plane_y -= wy[0] * head(row)
                            if j == 2:
                                plane_y += wy[2] * head(row)
                    sums.slope += vec(sx[i] * term[0], wx[i] * term[1], wx[i] * term[2])
                    if wp.static(everything):
                        sums.value += wx[i] * head(plane)
                        sums.mass += wx[i] * plane[dim]
                        along_y += wx[i] * plane_y
                        along_z += wx[i] * plane_z
                        if i == 0:
                            along_x -= wx[0] * head(plane)
                        if i == 2:
                            along_x += wx[2] * head(plane)
                sums.outer = wp.matrix_from_cols(along_x, along_y, along_z)
                return sums

        return sums_adj

    return SimpleNamespace(gather_adj=gather_adj(everything=True), slope_adj=gather_adj(everything=False))
