"""Grid stage: nodal momentum to nodal velocity. Derivation: docs/math/grid.md.

    u = p / m                                                                                        (G1)
    v = W_k(... W_1(exp(−γ Δt) (u + Δt g)))   with the walls W_1 … W_k in the order of the scene     (G2)
    p̄ = exp(−γ Δt) v̄₀ / m,  m̄ = −p̄ · u        v̄₀ being v̄ pulled back through the walls              (G1.adj)

Empty nodes get zero, in both directions.
"""

import functools
from types import SimpleNamespace

import warp as wp

from softmpm.kernels.contact import contact
from softmpm.kernels.spline import spline
from softmpm.kernels.types import Spec, solid_types, types


@functools.lru_cache(maxsize=None)
def grid(spec: Spec) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, vec, node_vec, Scale = t.real, t.vec, t.node, t.Scale
    Walls = solid_types(spec).Walls
    nodes = spline(spec.dim, spec.dtype)
    node_coordinates, momentum, pack = nodes.node_coordinates, nodes.momentum, nodes.pack
    inside, respond, respond_adj = (
        getattr(contact(spec), name) for name in ("inside", "respond", "respond_adj")
    )
    dim, walled, gravity, damping = spec.dim, bool(spec.contacts), spec.gravity, spec.damping

    @wp.func
    def free_velocity(scale: Scale, u: vec) -> vec:
        v = u
        if wp.static(gravity):
            v += scale.dt * scale.gravity
        if wp.static(damping):
            v = scale.decay * v
        return v

    @wp.func
    def after_walls(scale: Scale, walls: Walls, n: int, count: int, v: vec) -> vec:
        """v after the first ``count`` walls (G2)."""
        here = node_coordinates(n, scale.shape)
        w = v
        for k in range(count):
            if inside(walls, k, here, scale.exact_spacing):
                w = respond(walls, k, w)
        return w

    @wp.kernel(module=spec.module, enable_backward=False)
    def grid_velocity(
        # Parameters:
        scale: Scale,
        walls: Walls,
        # In:
        node: wp.array2d(dtype=node_vec),
        # Out:
        velocity: wp.array2d(dtype=vec),
    ):
        world, n = wp.tid()
        here = node[world, n]
        m = here[dim]
        v = vec()
        if m > real(0.0):
            v = free_velocity(scale, momentum(here) / m)
            if wp.static(walled):
                v = after_walls(scale, walls, n, walls.count, v)
        velocity[world, n] = v

    @wp.kernel(module=spec.module + ".adj", enable_backward=False)
    def grid_velocity_adj(
        # Parameters:
        scale: Scale,
        walls: Walls,
        # In:
        node: wp.array2d(dtype=node_vec),
        adj_velocity: wp.array2d(dtype=vec),
        # Out:
        adj_node: wp.array2d(dtype=node_vec),
    ):
        world, n = wp.tid()
        here = node[world, n]
        m = here[dim]
        adj = node_vec()
        if m > real(0.0):
            u = momentum(here) / m
            adj_v = adj_velocity[world, n]
            if wp.static(walled):
                v = free_velocity(scale, u)
                coordinates = node_coordinates(n, scale.shape)
                for i in range(walls.count):
                    k = walls.count - 1 - i
                    if inside(walls, k, coordinates, scale.exact_spacing):
                        adj_v = respond_adj(walls, k, after_walls(scale, walls, n, k, v), adj_v)
            adj_p = adj_v / m
            if wp.static(damping):
                adj_p = scale.decay * adj_p
            adj = pack(adj_p, -wp.dot(adj_p, u))
        adj_node[world, n] = adj

    return SimpleNamespace(grid_velocity=grid_velocity, grid_velocity_adj=grid_velocity_adj)
