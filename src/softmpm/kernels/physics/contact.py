"""Contact of one grid node with one wall, and its adjoint. Derivation: docs/math/grid.md.

With the outward normal n, vₙ = v·n, v_t = v − vₙ n and Coulomb's coefficient c:

    stick     v' = 0                                                                                 (C1)
    slip      v' = v_t                                                                               (C2)
    separate  v' = v_t max(0, 1 + c vₙ / |v_t|) if vₙ < 0, else v                                    (C3)

The adjoints differentiate the branch that was taken; a node held by friction has zero gradient.
Source: Stomakhin et al. 2013, "A material point method for snow simulation", section 8.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import Spec, solid_types, types


@kernel_factory
def contact(spec: Spec, k: int) -> SimpleNamespace:
    """Wall number ``k``."""
    t = types(spec.dim, spec.dtype)
    real, vec, ivec = t.real, t.vec, t.ivec
    Walls = solid_types(spec).Walls
    kind = spec.contacts[k]
    if kind not in ("stick", "slip", "separate"):
        raise ValueError(f"wall {k} has the contact {kind!r}, which has no response here; add its formula.")
    stick, slip = kind == "stick", kind == "slip"
    rough = spec.friction

    @wp.func
    def inside(walls: Walls, node: ivec, spacing: wp.float64) -> bool:
        """Decided in float64, so that both precisions put a node on the surface to the same side."""
        reach = wp.float64(0.0)
        for axis in range(spec.dim):
            reach += walls.normal[k, axis] * (wp.float64(node[axis]) * spacing)
        return reach <= walls.offset[k]

    @wp.func
    def normal(walls: Walls) -> vec:
        return vec(walls.normal[k])

    @wp.func
    def slide(walls: Walls, v_n: real, v_t: vec) -> vec:
        """Tangential velocity that friction leaves, for v_n < 0."""
        if wp.static(rough):
            limit = -walls.friction[k] * v_n
            if limit > real(0.0):
                speed = wp.length(v_t)
                if speed <= limit:
                    return vec()
                return v_t * (real(1.0) - limit / speed)
        return v_t

    @wp.func
    def slide_adj(walls: Walls, v_n: real, v_t: vec, adj: vec, n: vec) -> vec:
        """∂L/∂v through v_t and v_n (C3); ``adj`` lies in the tangent plane."""
        if wp.static(rough):
            c = walls.friction[k]
            limit = -c * v_n
            if limit > real(0.0):
                speed = wp.length(v_t)
                if speed <= limit:
                    return vec()
                along = wp.dot(adj, v_t) / speed
                return (
                    adj * (real(1.0) - limit / speed)
                    + (along * limit / (speed * speed)) * v_t
                    + (c * along) * n
                )
        return adj

    @wp.func
    def respond(walls: Walls, v: vec) -> vec:
        if wp.static(stick):
            return vec()  # (C1)
        n = normal(walls)
        v_n = wp.dot(v, n)
        if wp.static(slip):
            return v - v_n * n  # (C2)
        if v_n < real(0.0):
            return slide(walls, v_n, v - v_n * n)  # (C3)
        return v

    @wp.func
    def respond_adj(walls: Walls, v: vec, adj: vec) -> vec:
        if wp.static(stick):
            return vec()
        n = normal(walls)
        v_n = wp.dot(v, n)
        if wp.static(slip):
            return adj - wp.dot(adj, n) * n
        if v_n < real(0.0):
            return slide_adj(walls, v_n, v - v_n * n, adj - wp.dot(adj, n) * n, n)
        return adj

    return SimpleNamespace(inside=inside, respond=respond, respond_adj=respond_adj)
