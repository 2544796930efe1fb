"""Grid stage of the fast scheme with contact: further threads have the surface points. Derivation: docs/math/contact.md.

    grid      nodes: V ← (G1), (G2) of M, twice,  next M ← 0;   points: L of (K9)
    press     points: impulses into one of the V (kernels/carried/surface.py)
    backward
    grid_adj  nodes: M̄ ← (G1.adj) of V̄ and of what the points gave;  one V ← (G1), (G2) of the M before, the other +=;
              points: the part of L̄ in their adjoints (K9.adj), L of the substep before, its stored impulses into that other V (K10)
    g2p2g_adj, press_adj

Sums of two successive substeps have two buffers: one is added to while the other is cleared. On a CPU these launches have no threads of
points, whose parts are launches of their own: ``add_loads``, ``add_loads_adj`` and ``push_all``.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.carried.point import outline_type, surface_point
from softmpm.kernels.carried.surface import surface
from softmpm.kernels.carried.surface_adj import loads_adj
from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.dependent import await_previous
from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import NATIVE, native
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.grid_adj import grid_adj
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def contact_stage(spec: Spec) -> SimpleNamespace:
    """``grid`` of the table above, and a kernel that clears sums."""
    dim, t, s = spec.dim, types(spec.dim, spec.dtype), stencil(spec.dim, spec.dtype)
    real, node_vec, Constants, Window = t.real, t.aligned, t.Constants, t.Window
    exact_vec = types(dim, "float64").vec
    Outline, GridInputs = outline_type(dim, spec.dtype), input_types(spec).GridInputs
    point, add_load = surface_point(dim, spec.dtype, True), surface(spec, True).add_load
    Particles, point_of = point.Particles, point.point_of
    place_of, node_velocity = fused(spec).place_of, grid(spec).node_velocity
    aligned, head, world_of = s.aligned, s.head, s.world_of
    load_node, store_node = native(dim, spec.dtype).load_node, native(dim, spec.dtype).store_node

    @kernel(NATIVE, grid_stride=False)
    def clear(one: wp.array2d(dtype=real), other: wp.array2d(dtype=real)):
        world, i = wp.tid()
        one[world, i] = real(0.0)
        other[world, i] = real(0.0)

    @kernel(NATIVE, grid_stride=False)
    def grid_and_loads(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        outline: Outline,
        first: int,  # thread of the first point
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        node: wp.array(dtype=node_vec),
        # Out:
        free: wp.array(dtype=node_vec),
        velocity: wp.array(dtype=node_vec),
        cleared: wp.array(dtype=node_vec),
        cleared_load: wp.array2d(dtype=real),
        # Out, added into:
        load: wp.array2d(dtype=real),
    ):
        i = wp.tid()
        world = int(0)
        p = int(0)
        lane = int(0)
        particle = int(0)
        place = exact_vec()
        if i < node.shape[0]:
            world = world_of(i, window.count, node.shape[0])
            place = place_of(constants, window, world, i)
        elif i >= first:
            k = (i - first) / outline.lanes
            world = k / owner.shape[1]
            p = k - world * owner.shape[1]
            lane = i - first - k * outline.lanes
            particle = owner[world, p]
        await_previous()  # the particles and their sums
        if i < node.shape[0]:
            here = load_node(node, i)
            if here[dim] > real(0.0):
                v = aligned(node_velocity(constants, inputs, world, place, head(here), here[dim]), real(0.0))
                store_node(free, i, v)
                store_node(velocity, i, v)
            if i < cleared.shape[0]:
                store_node(cleared, i, node_vec())
            cleared_load[world, i - world * window.count] = real(0.0)
        elif i >= first:
            at = point_of(constants, window, outline, now, world, p, particle)
            add_load(window, outline, at, world, p, lane, load)

    return SimpleNamespace(clear=clear, grid_and_loads=grid_and_loads)


@kernel_factory
def contact_stage_adj(spec: Spec, wanted: RequestedGrads) -> wp.Kernel:
    """``grid_adj`` of the table above."""
    dim, t, s = spec.dim, types(spec.dim, spec.dtype), stencil(spec.dim, spec.dtype)
    real, vec, node_vec, Constants, Window = t.real, t.vec, t.aligned, t.Constants, t.Window
    exact_vec = types(dim, "float64").vec
    Outline, point = outline_type(dim, spec.dtype), surface_point(dim, spec.dtype, True)
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj
    Point, Particles, ParticlesAdj = point.Point, point.Particles, point.ParticlesAdj
    point_of, add_load, push = point.point_of, surface(spec, True).add_load, surface(spec, True).push
    place_of, node_velocity = fused(spec).place_of, grid(spec).node_velocity
    node_velocity_adj = grid_adj(spec, wanted).node_velocity_adj
    add_load_adj = loads_adj(dim, spec.dtype, True)
    aligned, head, world_of = s.aligned, s.head, s.world_of
    load_node, store_node = native(dim, spec.dtype).load_node, native(dim, spec.dtype).store_node

    @kernel(NATIVE, grid_stride=False)
    def grid_and_loads_adj(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        outline: Outline,
        first: int,  # thread of the first point
        owner: wp.array2d(dtype=wp.int32),
        # In:
        node: wp.array(dtype=node_vec),  # of this substep; empty after the last
        node_before: wp.array(dtype=node_vec),  # of the substep before; empty in the first
        masses_before: wp.array2d(dtype=t.node),  # the same by worlds
        impulse: wp.array2d(dtype=vec),  # of the substep before
        now: Particles,  # of this substep
        before: Particles,  # of the substep before
        adj_load: wp.array2d(dtype=real),
        # In and out:
        adj_node: wp.array(dtype=node_vec),  # adjoint of the velocity, then of momentum and mass
        gained: wp.array(dtype=node_vec),  # added to it, then cleared
        # Out:
        free: wp.array(dtype=node_vec),  # of the substep before
        cleared: wp.array(dtype=node_vec),
        cleared_velocity: wp.array(dtype=node_vec),
        cleared_load: wp.array2d(dtype=real),
        cleared_adj_load: wp.array2d(dtype=real),
        # Out, added into:
        velocity: wp.array(dtype=node_vec),  # of the substep before
        pushed: wp.array2d(dtype=vec),  # the same by worlds
        load: wp.array2d(dtype=real),
        adj: ParticlesAdj,  # of the particles of this substep
        adj_inputs: GridInputsAdj,
    ):
        i = wp.tid()
        world = int(0)
        p = int(0)
        lane = int(0)
        particle = int(0)
        place = exact_vec()
        here = node_vec()
        there = node_vec()
        at_now = Point()
        at_before = Point()
        J = vec()
        if i < velocity.shape[0]:
            world = world_of(i, window.count, velocity.shape[0])
            place = place_of(constants, window, world, i)
            if i < node.shape[0]:
                here = load_node(node, i)
            if i < node_before.shape[0]:
                there = load_node(node_before, i)
        elif i >= first:
            k = (i - first) / outline.lanes
            world = k / owner.shape[1]
            p = k - world * owner.shape[1]
            lane = i - first - k * outline.lanes
            particle = owner[world, p]
            if node.shape[0] > 0:
                at_now = point_of(constants, window, outline, now, world, p, particle)
            if node_before.shape[0] > 0:
                at_before = point_of(constants, window, outline, before, world, p, particle)
                J = impulse[world, p]
        await_previous()  # the adjoints
        if i < velocity.shape[0]:
            if i < node.shape[0]:
                more = load_node(gained, i)
                adj_v = head(load_node(adj_node, i)) + head(more)
                if here[dim] > real(0.0):
                    back = node_velocity_adj(
                        constants, inputs, world, place, head(here), here[dim], adj_v, i, adj_inputs
                    )
                    store_node(adj_node, i, aligned(back.p, back.m + more[dim]))
                store_node(gained, i, node_vec())
            if i < node_before.shape[0]:
                if there[dim] > real(0.0):
                    v = aligned(
                        node_velocity(constants, inputs, world, place, head(there), there[dim]), real(0.0)
                    )
                    store_node(free, i, v)
                    wp.atomic_add(velocity, i, v)
                store_node(cleared, i, node_vec())
                store_node(cleared_velocity, i, node_vec())
                cleared_load[world, i - world * window.count] = real(0.0)
                cleared_adj_load[world, i - world * window.count] = real(0.0)
        elif i >= first:
            if node.shape[0] > 0:
                add_load_adj(constants, window, outline, at_now, world, p, lane, particle, adj_load, adj)
            if node_before.shape[0] > 0:
                add_load(window, outline, at_before, world, p, lane, load)
                if wp.dot(J, J) != real(0.0):
                    push(window, at_before, J, world, lane, outline.lanes, masses_before, pushed)

    return grid_and_loads_adj
