"""Quadratic B-spline weights of the 3^dim nodes around a particle, and the packed node. Derivation: docs/math/transfer.md.

With f the distance from the base node in cells, 0.5 ≤ f < 1.5, along each axis:

    w₀ = ½ (3/2 − f)²,  w₁ = ¾ − (f − 1)²,  w₂ = ½ (f − ½)²      (S1)
    w₀' = f − 3/2,      w₁' = 2 − 2f,       w₂' = f − ½           (S2)

Of g = f − 1 only the square is rounded: Σ w = 1 and Σ w (o − f) = 0 hold to the last bit. Otherwise a body whose particles keep their
place along an axis, as one that turns about it, would gain or lose momentum in every substep alike.

Source: Steffen, Kirby, Berzins 2008; Hu et al. 2018, "MLS-MPM".
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


@kernel_factory
def spline(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, ivec, node_vec = t.real, t.vec, t.ivec, t.node
    table = wp.types.matrix((3, dim), real)  # [offset, axis]

    @wp.func
    def weights(fx: vec) -> table:
        w = table()
        for axis in range(dim):
            g = fx[axis] - real(1.0)
            # A multiple of the precision at 1/2, in which the weights are exact:
            square = (g * g + real(0.5)) - real(0.5)
            outer = real(0.125) + real(0.5) * square
            w[0, axis] = outer - real(0.5) * g
            w[1, axis] = real(0.75) - square
            w[2, axis] = outer + real(0.5) * g
        return w

    @wp.func
    def line_weight(f: real, o: int) -> real:
        """That of :func:`weights` for the node at offset ``o`` along one axis, without a table."""
        g = f - real(1.0)
        square = (g * g + real(0.5)) - real(0.5)
        outer = real(0.125) + real(0.5) * square
        return wp.where(o == 1, real(0.75) - square, outer + real(0.5) * real(o - 1) * g)

    @wp.func
    def line_slope(f: real, o: int) -> real:
        """That of :func:`slopes` for the node at offset ``o``."""
        return wp.where(o == 1, real(2.0) - real(2.0) * f, f - wp.where(o == 0, real(1.5), real(0.5)))

    @wp.func
    def slopes(fx: vec) -> table:
        s = table()
        for axis in range(dim):
            f = fx[axis]
            s[0, axis] = f - real(1.5)
            s[1, axis] = real(2.0) - real(2.0) * f
            s[2, axis] = f - real(0.5)
        return s

    if dim == 2:

        @wp.func
        def offset(n: int) -> ivec:
            return ivec(n / 3, n % 3)

        @wp.func
        def position(o: ivec) -> vec:
            return vec(real(o[0]), real(o[1]))

        @wp.func
        def weight(w: table, o: ivec) -> real:
            return w[o[0], 0] * w[o[1], 1]

        @wp.func
        def weight_slope(w: table, s: table, o: ivec) -> vec:
            return vec(s[o[0], 0] * w[o[1], 1], w[o[0], 0] * s[o[1], 1])

        @wp.func
        def weight_at(fx: vec, o: ivec) -> real:
            return line_weight(fx[0], o[0]) * line_weight(fx[1], o[1])

        @wp.func
        def slope_at(fx: vec, o: ivec) -> vec:
            a = line_weight(fx[0], o[0])
            b = line_weight(fx[1], o[1])
            return vec(line_slope(fx[0], o[0]) * b, a * line_slope(fx[1], o[1]))

        @wp.func
        def node_index(base: ivec, o: ivec, shape: ivec) -> int:
            return (base[0] + o[0]) * shape[1] + base[1] + o[1]

        @wp.func
        def node_coordinates(n: int, shape: ivec) -> ivec:
            return ivec(n / shape[1], n % shape[1])
    else:

        @wp.func
        def offset(n: int) -> ivec:
            return ivec(n / 9, (n / 3) % 3, n % 3)

        @wp.func
        def position(o: ivec) -> vec:
            return vec(real(o[0]), real(o[1]), real(o[2]))

        @wp.func
        def weight(w: table, o: ivec) -> real:
            return w[o[0], 0] * w[o[1], 1] * w[o[2], 2]

        @wp.func
        def weight_slope(w: table, s: table, o: ivec) -> vec:
            a = w[o[0], 0]
            b = w[o[1], 1]
            c = w[o[2], 2]
            return vec(s[o[0], 0] * b * c, a * s[o[1], 1] * c, a * b * s[o[2], 2])

        @wp.func
        def weight_at(fx: vec, o: ivec) -> real:
            return line_weight(fx[0], o[0]) * line_weight(fx[1], o[1]) * line_weight(fx[2], o[2])

        @wp.func
        def slope_at(fx: vec, o: ivec) -> vec:
            a = line_weight(fx[0], o[0])
            b = line_weight(fx[1], o[1])
            c = line_weight(fx[2], o[2])
            return vec(
                line_slope(fx[0], o[0]) * b * c,
                a * line_slope(fx[1], o[1]) * c,
                a * b * line_slope(fx[2], o[2]),
            )

        @wp.func
        def node_index(base: ivec, o: ivec, shape: ivec) -> int:
            return ((base[0] + o[0]) * shape[1] + base[1] + o[1]) * shape[2] + base[2] + o[2]

        @wp.func
        def node_coordinates(n: int, shape: ivec) -> ivec:
            return ivec(n / (shape[1] * shape[2]), (n / shape[2]) % shape[1], n % shape[2])

    @wp.func
    def momentum(node: node_vec) -> vec:
        p = vec()
        for axis in range(dim):
            p[axis] = node[axis]
        return p

    @wp.func
    def pack(p: vec, m: real) -> node_vec:
        node = node_vec()
        for axis in range(dim):
            node[axis] = p[axis]
        node[dim] = m
        return node

    return SimpleNamespace(
        momentum=momentum,
        pack=pack,
        count=3**dim,
        weights=weights,
        offset=offset,
        position=position,
        weight=weight,
        weight_slope=weight_slope,
        weight_at=weight_at,
        slopes=slopes,
        slope_at=slope_at,
        node_index=node_index,
        node_coordinates=node_coordinates,
    )
