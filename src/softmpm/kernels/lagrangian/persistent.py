"""One kernel for all substeps of a control step, for small scenes on a GPU.

A cluster of blocks has a world. Where the launches of launches.py follow each other, its multiprocessors wait for each other at a
barrier of the hardware. The stages are the functions of the kernels that are launched one by one, and the results are theirs up to
rounding, see docs/decisions/0010-reference-formulation.md. On the CPU, for tests, one thread does everything.
"""

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.lagrangian.bricks import brick_options, meet_cluster, meet_cluster_adj
from softmpm.kernels.lagrangian.cells import cells, cells_adj
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.cluster import Cluster, holdings, numbering
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.lattice import lattice_cells, lattice_cells_adj
from softmpm.kernels.lagrangian.layers import layers
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.lagrangian.surface import surface
from softmpm.kernels.lagrangian.surface_adj import surface_adj
from softmpm.kernels.lagrangian.surface_sums import surface_type
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def march(spec: Spec, cluster: Cluster) -> wp.Kernel:
    """Kernel of the substeps from ``first`` to before ``last``."""
    bricks, given, memory = cluster.bricks, input_types(spec), chunk(spec.dim, spec.dtype)
    ParticleInputs, GridInputs, Chunk = given.ParticleInputs, given.GridInputs, memory.Chunk
    Constants, Rest = types(spec.dim, spec.dtype).Constants, rest(spec.dim, spec.dtype).Rest
    Frame, Surface = frame(spec.dim, spec.dtype).Frame, surface_type(spec.dim, spec.dtype)
    Lattice, lattice = layers(spec.dim, spec.dtype, bricks).Lattice, bricks.lattice
    forces_at = lattice_cells(spec, bricks).forces_at if lattice else cells(spec, bricks).forces_at
    advance_at, contact, of_thread = nodes(spec).advance_at, bool(spec.surface_walls), holdings(spec, cluster)
    held_by, seat_at, node_at = of_thread.held_by, of_thread.seat_at, of_thread.node_at
    if contact:
        press_at, settle_at = surface(spec).press_at, surface(spec).settle_at
        point_at, entry_at = of_thread.point_at, of_thread.entry_at
    size, groups, lanes, number = cluster.group_threads, cluster.groups, cluster.lanes, numbering(cluster)
    rounded, following = number.rounded, number.following
    all_groups, all_threads = cluster.blocks * groups, cluster.blocks * cluster.threads
    options = brick_options(groups)

    @kernel(options, **cluster.settings)
    def march(
        constants: Constants,
        inputs: ParticleInputs,
        grid_inputs: GridInputs,
        inside: Rest,
        weights: Lattice,
        moving: Frame,
        body: Surface,
        at: Chunk,
        first: int,
        last: int,
        anew: int,  # 1 if a control step begins with the first substep, but not with the chunk
    ):
        world, block, thread = wp.tid()
        lane = thread % size
        held = held_by(block, thread, constants, inputs, inside, body, at.mass, world)
        for s in range(first, last):
            brick = held.brick
            while brick < inside.corners.shape[0]:
                seat = seat_at(held, inputs, inside, world, brick, lane)
                if wp.static(lattice):
                    forces_at(world, brick, lane, seat, constants, inputs, inside, weights, at, s)
                else:
                    forces_at(world, brick, lane, seat, constants, inputs, inside, at, s)
                brick = following(brick, all_groups, inside.corners.shape[0])
            meet_cluster()
            i = held.number
            while i < inside.nodes.shape[0]:
                node = node_at(held, constants, inside, at.mass, world, i)
                advance_at(world, i, node, constants, grid_inputs, moving, at, s)
                i = following(i, all_threads, inside.nodes.shape[0])
            meet_cluster()
            if wp.static(contact):
                begins = wp.where(s == first, anew, 0)
                p = held.number
                while p < body.points.shape[0]:
                    point = point_at(held, body, p)
                    press_at(world, p, point, constants, grid_inputs, body, moving, at, s, begins)
                    p = following(p, all_threads, body.points.shape[0])
                meet_cluster()
                count = body.nodes.shape[0]
                k = held.number
                while k < rounded(count * lanes):
                    n = wp.min(k / lanes, count - 1)
                    entry = entry_at(held, body, k, n)
                    settle_at(world, k - n * lanes, entry, constants, body, moving, at, s)
                    k = following(k, all_threads, rounded(count * lanes))
                meet_cluster()

    return march


@kernel_factory
def march_adj(spec: Spec, wanted: RequestedGrads, cluster: Cluster) -> wp.Kernel:
    """Adjoint of :func:`march`; the sums of the bricks in substep ``first`` are still to be added to the adjoint of the state."""
    bricks, given, memory = cluster.bricks, input_types(spec), chunk(spec.dim, spec.dtype)
    ParticleInputs, GridInputs = given.ParticleInputs, given.GridInputs
    Chunk, Adjoint, adjoints = memory.Chunk, memory.Adjoint, input_adj_types(spec, wanted)
    ParticleInputsAdj, GridInputsAdj = adjoints.ParticleInputsAdj, adjoints.GridInputsAdj
    Constants, Rest = types(spec.dim, spec.dtype).Constants, rest(spec.dim, spec.dtype).Rest
    Surface, contact = surface_type(spec.dim, spec.dtype), bool(spec.surface_walls)
    Lattice, lattice = layers(spec.dim, spec.dtype, bricks).Lattice, bricks.lattice
    of_cells = lattice_cells_adj(spec, wanted, bricks) if lattice else cells_adj(spec, wanted, bricks)
    forces_adj_at, advance_adj_at = of_cells.forces_adj_at, nodes_adj(spec, wanted).advance_adj_at
    of_thread = holdings(spec, cluster)
    held_by, seat_at, node_at = of_thread.held_by, of_thread.seat_at, of_thread.node_at
    if contact:
        one = surface_adj(spec, wanted)
        settle_adj_at, press_adj_at, spread_adj_at = one.settle_adj_at, one.press_adj_at, one.spread_adj_at
        point_at, entry_at, touched_at = of_thread.point_at, of_thread.entry_at, of_thread.touched_at
    size, groups, lanes, number = cluster.group_threads, cluster.groups, cluster.lanes, numbering(cluster)
    rounded, following = number.rounded, number.following
    all_groups, all_threads = cluster.blocks * groups, cluster.blocks * cluster.threads
    options = brick_options(groups)

    @kernel(options, **cluster.settings)
    def march_adj(
        constants: Constants,
        inputs: ParticleInputs,
        grid_inputs: GridInputs,
        inside: Rest,
        weights: Lattice,
        body: Surface,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: ParticleInputsAdj,
        adj_grid_inputs: GridInputsAdj,
        first: int,
        last: int,
        anew: int,
    ):
        world, block, thread = wp.tid()
        lane = thread % size
        held = held_by(block, thread, constants, inputs, inside, body, at.mass, world)
        for back in range(last - first):
            s = last - 1 - back
            i = held.number
            while i < inside.nodes.shape[0]:
                node = node_at(held, constants, inside, at.mass, world, i)
                if wp.static(contact):
                    settle_adj_at(world, i, node, constants, grid_inputs, at, bar, adj_grid_inputs, s)
                else:
                    advance_adj_at(world, i, node, constants, grid_inputs, at, bar, adj_grid_inputs, s)
                i = following(i, all_threads, inside.nodes.shape[0])
            meet_cluster_adj()
            if wp.static(contact):
                begins = wp.where(s == first, anew, 0)
                p = held.number
                while p < body.points.shape[0]:
                    point = point_at(held, body, p)
                    press_adj_at(
                        world, p, point, constants, grid_inputs, body, at, bar, adj_grid_inputs, s, begins
                    )
                    p = following(p, all_threads, body.points.shape[0])
                meet_cluster_adj()
                count = body.nodes.shape[0]
                k = held.number
                while k < rounded(count * lanes):
                    n = wp.min(k / lanes, count - 1)
                    entry = entry_at(held, body, k, n)
                    node = touched_at(held, constants, inside, at.mass, world, k, entry.i)
                    turn = k - n * lanes
                    spread_adj_at(
                        world, turn, entry, node, constants, grid_inputs, body, at, bar, adj_grid_inputs, s
                    )
                    k = following(k, all_threads, rounded(count * lanes))
                meet_cluster_adj()
            brick = held.brick
            while brick < inside.corners.shape[0]:
                seat = seat_at(held, inputs, inside, world, brick, lane)
                if wp.static(lattice):
                    forces_adj_at(
                        world, brick, lane, seat, constants, inputs, inside, weights, at, bar, adj_inputs, s
                    )
                else:
                    forces_adj_at(world, brick, lane, seat, constants, inputs, inside, at, bar, adj_inputs, s)
                brick = following(brick, all_groups, inside.corners.shape[0])
            meet_cluster_adj()

    return march_adj
