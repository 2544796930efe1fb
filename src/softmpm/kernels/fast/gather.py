"""Gather: sums over the 3^dim nodes of a particle, axis by axis. Derivation: docs/math/scatter.md.

Here g is the distance from the middle node in cells, -1/2 ≤ g < 1/2, and o in {-1, 0, 1} is the offset of a node from it, r = o − g:

    w₋₁ = ½ (½ − g)²,  w₀ = ¾ − g²,  w₊₁ = ½ (½ + g)²                                               (A2)

The weights are products, so the sums along z are taken first, then those along y, then along x: 3 + 9 + 27 terms with few
factors each. (T2) needs Σ w v rᵀ, which is Σ w v oᵀ − (Σ w v) gᵀ; since |g| ≤ ½, the subtraction loses no accuracy.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.fast.native import WARP, native
from softmpm.kernels.structs import types


@kernel_factory
def stencil(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, mat, ivec, node_vec = t.real, t.vec, t.mat, t.ivec, t.aligned
    triple = wp.types.vector(3, real)
    n = native(dim, dtype)

    @wp.struct
    class Sums:
        value: vec  # Σ w v
        mass: real  # Σ w m
        outer: mat  # Σ w v oᵀ
        slope: vec  # Σ (v·(b + A o) + m μ) ∇w

    @wp.func
    def weights(g: real) -> triple:
        square = (g * g + real(0.5)) - real(0.5)  # rounded as in spline.py
        outer = real(0.125) + real(0.5) * square
        return triple(outer - real(0.5) * g, real(0.75) - square, outer + real(0.5) * g)

    @wp.func
    def particle_of(thread: int, per_warp: int, total: int) -> int:
        """Place of a thread's particle. The first ``per_warp`` lanes of a warp have one; for other lanes it is ``total``."""
        lane = thread % WARP
        place = thread / WARP * per_warp + lane
        if lane >= per_warp or place > total:
            place = total
        return place

    @wp.func
    def world_of(place: int, count: int, total: int) -> int:
        """World of a particle, with ``count`` particles in each; a single world is a special case, since division is slow on a GPU."""
        if count == total:
            return 0
        return place / count

    if dim == 2:

        @wp.func
        def head(node: node_vec) -> vec:
            return vec(node[0], node[1])

        @wp.func
        def first_node(base: ivec, origin: ivec, shape: ivec) -> int:
            return (base[0] - origin[0]) * shape[1] + base[1] - origin[1]

        @wp.func
        def coordinates(n: int, shape: ivec) -> ivec:
            column = n / shape[1]
            return ivec(column, n - column * shape[1])

        @wp.func
        def pack_base(base: ivec) -> int:
            return base[0] | (base[1] << 16)

        @wp.func
        def unpack_base(packed: int) -> ivec:
            return ivec(packed & 65535, packed >> 16)

        @wp.func
        def aligned(v: vec, m: real) -> node_vec:
            return node_vec(v[0], v[1], m, real(0.0))
    else:

        @wp.func
        def head(node: node_vec) -> vec:
            return vec(node[0], node[1], node[2])

        @wp.func
        def first_node(base: ivec, origin: ivec, shape: ivec) -> int:
            return ((base[0] - origin[0]) * shape[1] + base[1] - origin[1]) * shape[2] + base[2] - origin[2]

        @wp.func
        def coordinates(n: int, shape: ivec) -> ivec:
            column = n / shape[2]
            plane = column / shape[1]
            return ivec(plane, column - plane * shape[1], n - column * shape[2])

        @wp.func
        def pack_base(base: ivec) -> int:
            return base[0] | (base[1] << 10) | (base[2] << 20)

        @wp.func
        def unpack_base(packed: int) -> ivec:
            return ivec(packed & 1023, (packed >> 10) & 1023, packed >> 20)

        @wp.func
        def aligned(v: vec, m: real) -> node_vec:
            return node_vec(v[0], v[1], v[2], m)

    def gather_by(load_node: wp.Function) -> wp.Function:
        """Σ w v and Σ w v oᵀ of nodes that this function loads."""
        if dim == 2:

            @wp.func
            def gather(node: wp.array(dtype=node_vec), first: int, shape: ivec, g: vec) -> Sums:
                wx = weights(g[0])
                wy = weights(g[1])
                value = vec()
                along_x = vec()
                along_y = vec()
                for i in range(3):
                    at = first + i * shape[1]
                    a = head(load_node(node, at))
                    b = head(load_node(node, at + 1))
                    c = head(load_node(node, at + 2))
                    row = wy[0] * a + wy[1] * b + wy[2] * c
                    value += wx[i] * row
                    along_y += wx[i] * (wy[2] * c - wy[0] * a)
                    if i == 0:
                        along_x -= wx[0] * row
                    if i == 2:
                        along_x += wx[2] * row
                sums = Sums()
                sums.value = value
                sums.outer = wp.matrix_from_cols(along_x, along_y)
                return sums
        else:

            @wp.func
            def gather(node: wp.array(dtype=node_vec), first: int, shape: ivec, g: vec) -> Sums:
                wx = weights(g[0])
                wy = weights(g[1])
                wz = weights(g[2])
                value = vec()
                along_x = vec()
                along_y = vec()
                along_z = vec()
                for i in range(3):
                    plane = vec()
                    plane_y = vec()
                    plane_z = vec()
                    for j in range(3):
                        at = first + (i * shape[1] + j) * shape[2]
                        a = head(load_node(node, at))
                        b = head(load_node(node, at + 1))
                        c = head(load_node(node, at + 2))
                        row = wz[0] * a + wz[1] * b + wz[2] * c
                        plane += wy[j] * row
                        plane_z += wy[j] * (wz[2] * c - wz[0] * a)
                        if j == 0:
                            plane_y -= wy[0] * row
                        if j == 2:
                            plane_y += wy[2] * row
                    value += wx[i] * plane
                    along_y += wx[i] * plane_y
                    along_z += wx[i] * plane_z
                    if i == 0:
                        along_x -= wx[0] * plane
                    if i == 2:
                        along_x += wx[2] * plane
                sums = Sums()
                sums.value = value
                sums.outer = wp.matrix_from_cols(along_x, along_y, along_z)
                return sums

        return gather

    return SimpleNamespace(
        particle_of=particle_of,
        world_of=world_of,
        first_node=first_node,
        coordinates=coordinates,
        pack_base=pack_base,
        unpack_base=unpack_base,
        aligned=aligned,
        head=head,
        gather=gather_by(n.load_node),
        gather_constant=gather_by(n.load_constant_node),
        weights=weights,
        Sums=Sums,
        triple=triple,
    )
