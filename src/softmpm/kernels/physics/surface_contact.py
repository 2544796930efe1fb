"""Contact of one surface point with one wall, and its adjoint. Derivation: docs/math/contact.md.

With y the height over the wall, v_n and v_t the velocity along and across its normal n, x_t the position across it, D (K1):

    d = −(y + Δt v_n),  P = H(d) / (Δt D)                                                            (K3)
    e = x_t + Δt v_t − a,  T = −c e,  c = k Δt / (1 + D k Δt²)                                        (K4)
    |T| > μ P:  T ← μ P T/|T|,  a' = x_t + Δt (v_t + D T) + T/(k Δt);   else a' = a
    P = 0:  T = 0,  a' = x_t + Δt v_t;   J = P n + T
    y > dx: P = 0,  a' = x_t, whatever D and v are

    slip:   T̄ += (Δt D + 1/(k Δt)) ā',  x̄_t += ā',  v̄_t += Δt ā',  D̄ += Δt T·ā'                      (K4.adj)
            μ̄ += P τ·T̄,  P̄ += μ τ·T̄,  ē = −c (μ P/|T₀|) (T̄ − τ (τ·T̄)),  τ = T₀/|T₀|
    stick:  ā += ā',  ē = −c T̄,  D̄ += c² Δt e·T̄
    both:   x̄_t += ē,  v̄_t += Δt ē,  ā −= ē;   y > dx: x̄_t += ā' only
    d̄ = P̄ H'(d) / (Δt D),  D̄ −= P̄ P / D,  ȳ −= d̄,  v̄_n −= Δt d̄                                     (K3.adj)
    n̄ = ȳ x + (v̄_n − n·v̄_t) v − v_n v̄_t − (n·x) x̄_t − (n·x̄_t) x + P J̄

with y = n·x − o. H is max(d, 0), or smooth over 2s: d²/(4s) up to 2s and d − s beyond. P and T are impulses per area; the stick
spring k only remembers where a point adhered.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


@kernel_factory
def surface_contact(dim: int, dtype: str) -> SimpleNamespace:
    real, vec = types(dim, dtype).real, types(dim, dtype).vec

    @wp.struct
    class Touch:
        J: vec
        anchor: vec

    @wp.struct
    class TouchAdj:
        x: vec
        v: vec
        anchor: vec
        D: real
        friction: real
        n: vec
        y: real

    @wp.func
    def across(n: vec, a: vec) -> vec:
        return a - wp.dot(n, a) * n

    @wp.func
    def hinge(d: real, s: real) -> real:
        if d <= real(0.0):
            return real(0.0)
        if d < real(2.0) * s:
            return d * d / (real(4.0) * s)
        return d - s

    @wp.func
    def hinge_slope(d: real, s: real) -> real:
        if d <= real(0.0):
            return real(0.0)
        if d < real(2.0) * s:
            return d / (real(2.0) * s)
        return real(1.0)

    @wp.func
    def touch(
        n: vec,
        y: real,
        x: vec,
        v: vec,
        anchor: vec,
        D: real,
        friction: real,
        k: real,
        dt: real,
        s: real,
        reach: real,
    ) -> Touch:
        x_t = across(n, x)
        out = Touch()
        if y > reach:
            out.anchor = x_t
            return out
        v_t = across(n, v)
        out.anchor = x_t + dt * v_t
        pressed = hinge(-(y + dt * wp.dot(n, v)), s)
        if pressed > real(0.0):  # no division for the many points that are not
            P = pressed / (dt * D)  # (K3)
            T = (-k * dt / (real(1.0) + D * k * dt * dt)) * (x_t + dt * v_t - anchor)  # (K4)
            out.anchor = anchor
            size = wp.length(T)
            if size > friction * P:
                T = (friction * P / size) * T
                out.anchor = x_t + dt * (v_t + D * T) + (real(1.0) / (k * dt)) * T
            out.J = P * n + T
        return out

    @wp.func
    def touch_adj(
        n: vec,
        y: real,
        x: vec,
        v: vec,
        anchor: vec,
        D: real,
        friction: real,
        k: real,
        dt: real,
        s: real,
        reach: real,
        adj_J: vec,
        adj_next: vec,
    ) -> TouchAdj:
        x_t = across(n, x)
        v_t = across(n, v)
        adj = TouchAdj()
        adj_x = adj_next
        adj_v = dt * adj_next
        d = -(y + dt * wp.dot(n, v))
        pressed = hinge(d, s)
        if y > reach:
            pressed = real(0.0)
            adj_v = vec()
        P = real(0.0)
        adj_y = real(0.0)
        if pressed > real(0.0):
            P = pressed / (dt * D)
            c = k * dt / (real(1.0) + D * k * dt * dt)
            e = x_t + dt * v_t - anchor
            T = -c * e
            adj_T = adj_J
            adj_P = wp.dot(n, adj_J)
            adj_e = vec()
            size = wp.length(T)
            if size > friction * P:  # (K4.adj)
                way = T / size
                adj_T += (dt * D + real(1.0) / (k * dt)) * adj_next
                adj.D = dt * friction * P * wp.dot(way, adj_next)
                along = wp.dot(way, adj_T)
                adj.friction = P * along
                adj_P += friction * along
                adj_e = (-c * friction * P / size) * (adj_T - along * way)
            elif friction > real(0.0):  # a smooth wall holds no point
                adj_x = vec()
                adj_v = vec()
                adj.anchor = adj_next
                adj_e = -c * adj_T
                adj.D = c * c * dt * wp.dot(e, adj_T)
            adj_x += adj_e
            adj_v += dt * adj_e
            adj.anchor -= adj_e
            adj_d = adj_P * hinge_slope(d, s) / (dt * D)  # (K3.adj)
            adj.D -= adj_P * P / D
            adj_y = -adj_d
        adj.y = adj_y
        adj.n = adj_y * x + (dt * adj_y - wp.dot(n, adj_v)) * v - wp.dot(n, v) * adj_v
        adj.n += P * adj_J - wp.dot(n, x) * adj_x - wp.dot(n, adj_x) * x
        adj.x = across(n, adj_x) + adj_y * n
        adj.v = across(n, adj_v) + (dt * adj_y) * n
        return adj

    return SimpleNamespace(Touch=Touch, TouchAdj=TouchAdj, across=across, touch=touch, touch_adj=touch_adj)
