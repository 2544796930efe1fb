"""Adjoint launches of a chunk of the fast scheme, from the last substep to the first."""

import warp as wp

from softmpm.kernels.carried.grid_stage import contact_stage, contact_stage_adj
from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.g2p2g_adj import fused_adj
from softmpm.kernels.fast.native import BLOCK
from softmpm.schemes.fast.adjoint_buffers import ChunkAdjoint
from softmpm.schemes.fast.launches import NODE_PART, add_loads, particle_part, point_threads
from softmpm.schemes.launch import KernelLauncher


def launch_chunk_adj(adjoint: ChunkAdjoint, launch: KernelLauncher) -> None:
    """Turn the packed adjoint of the final state into that of the initial state, and accumulate the adjoints of the inputs."""
    forward, shared, chunk = adjoint.forward, adjoint.shared, adjoint.forward.chunk
    contact = forward.contact is not None
    for nodes in [*shared.velocity_arrays, *([shared.gained_array] if contact else [])]:
        launch(fused(adjoint.model.spec).clear, forward.held, nodes, block_dim=BLOCK, part=NODE_PART)
    if contact:
        for loads in (forward.load_arrays, shared.adj_load_arrays):
            launch(contact_stage(adjoint.model.spec).clear, forward.loads.shape[1:], *loads, block_dim=BLOCK)
    for s in range(chunk.length, -1, -1):
        if contact:
            _grid_with_contact(adjoint, s, launch)
        else:
            _grid(adjoint, s, launch)
        _particles(adjoint, s, launch)
        if contact and s > 0:
            _contact(adjoint, s - 1, launch)
        if s == 0 or (s < chunk.length and chunk.row(s - 1) != chunk.row(s)):
            adjoint.found.collect(chunk.row(s), adjoint.forward.inputs.values, launch)


def _grid(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of the grid stage of substep ``s``, and the nodal velocities of substep ``s - 1`` once more."""
    forward, shared, sums = adjoint.forward, adjoint.shared, adjoint.shared.sums
    model, nodes, nothing = forward.model, forward.node_arrays, forward.nothing
    here, before = sums.source(s), sums.cleared(s - 1)
    before = nothing if before is None else before
    last, first = s == forward.chunk.length, s == 0
    now, then = nothing if last else nodes[s], nothing if first else nodes[s - 1]
    kernel = fused_adj(model.spec, adjoint.wanted).grid_velocity_adj
    stages = [(max(s - 1, 0) if last else s, now, then)]
    if model.spec.moving and not (last or first):  # the walls have another pose in each
        stages = [(s, now, nothing), (s - 1, nothing, then)]
    for k, now, then in stages:
        inputs = forward.inputs.grid_struct(k)
        adj_inputs = adjoint.found.grid_struct(forward.chunk.row(k))
        grids = (now, then, here, shared.velocity_at(s - 1), before)
        arguments = (model.constants, inputs, forward.window, *grids, adj_inputs)
        launch(kernel, forward.held, *arguments, block_dim=BLOCK, part=NODE_PART)


def _grid_with_contact(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """The same with contact at surface points: the adjoint of its loads, and what it gave to the nodes in substep ``s - 1``."""
    forward, shared, (here, before) = adjoint.forward, adjoint.shared, _adj_nodes(adjoint, s)
    model, nodes, nothing, contact = forward.model, forward.node_arrays, forward.nothing, forward.contact
    assert contact is not None and shared.contact is not None
    last, first = s == forward.chunk.length, s == 0
    stages = [
        (max(s - 1, 0) if last else s, nothing if last else nodes[s], nothing if first else nodes[s - 1])
    ]
    if model.spec.moving and not (last or first):  # the walls have another pose in each
        stages = [(s, nodes[s], nothing), (s - 1, nothing, nodes[s - 1])]
    free, velocity, cleared = shared.velocity_arrays[-1], shared.velocity_at(s - 1), shared.velocity_at(s)
    pushed, earlier = shared.velocity_vectors[(s - 1) % 2], max(s - 1, 0)
    about = forward.masses(earlier), contact.impulses[earlier]
    loads, adj_loads = forward.load_arrays, shared.adj_load_arrays
    point, threads = point_threads(forward)
    beside = model.spec.slabs and not last
    if beside:  # beside the nodes; the loads of the substep before follow beside the particles
        of_loads = forward.packed[s], adj_loads[s % 2], shared.adj_array
        shared.contact.add_loads_adj(contact, *of_loads, launch)
    for k, now, then in stages:
        inputs = forward.inputs.grid_struct(k)
        parameters = (model.constants, inputs, forward.window, contact.outline, point, contact.owner_array)
        states = (now, then, *about, forward.packed[s], forward.packed[earlier], adj_loads[s % 2])
        out = (here, shared.gained_array, free, before, cleared, loads[s % 2], adj_loads[(s + 1) % 2])
        added = (velocity, pushed, loads[(s + 1) % 2], shared.adj_array)
        adj_inputs = adjoint.found.grid_struct(forward.chunk.row(k))
        kernel = contact_stage_adj(model.spec, adjoint.wanted)
        arguments = (*parameters, *states, *out, *added, adj_inputs)
        launch(kernel, threads, *arguments, block_dim=BLOCK, part=NODE_PART, beside=beside)
        beside = False
    if model.spec.slabs and not first:
        contact.push(s - 1, forward.packed[s - 1], forward.masses(s - 1), pushed, launch)


def _contact(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of contact at surface points in substep ``s``, but for that of its loads."""
    forward, shared = adjoint.forward, adjoint.shared
    assert forward.contact is not None and shared.contact is not None
    inputs, adj_inputs = forward.inputs.grid_struct(s), adjoint.found.grid_struct(forward.chunk.row(s))
    velocity, free = shared.velocity_vectors[s % 2], shared.velocity_vectors[-1]
    states = (inputs, adj_inputs, forward.packed[s], forward.contact_nodes(s, velocity, free))
    adj_nodes = (shared.node_vectors[s % 2], shared.adj_load_arrays[s % 2], shared.gained_view)
    shared.contact.press_adj(forward.contact, s, *states, *adj_nodes, shared.adj_array, launch)


def _adj_nodes(adjoint: ChunkAdjoint, s: int) -> tuple[wp.array, wp.array]:
    """Adjoint grids of substep ``s`` and of the previous substep."""
    nodes = adjoint.shared.node_arrays
    return nodes[s % 2], nodes[(s + 1) % 2]


def _particles(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of P2G of substep ``s``, then that of G2P of the previous substep."""
    forward, shared, (here, _) = adjoint.forward, adjoint.shared, _adj_nodes(adjoint, s)
    model, chunk, size, sums = forward.model, forward.chunk, forward.size, shared.sums
    first, last = s == 0, s == chunk.length
    rows = [chunk.row(min(max(k, 0), chunk.length - 1)) for k in (s, s - 1)]
    inputs = forward.inputs.particle_struct(s, s - 1)
    parameters = (model.constants, inputs, forward.window, chunk.length - 1 - s, first, last)
    sizes = (size.per_warp_adj, model.particle_count, size.particles, forward.order_flat)
    states = (forward.packed[max(s - 1, 0)], forward.packed[s])
    grids = (shared.velocity_at(s - 1), here, shared.adj_array)
    out = (forward.words_array, adjoint.found.particle_struct(*rows), sums.sink(s - 1))
    kernel = fused_adj(model.spec, adjoint.wanted).g2p2g_adj[size.few]
    arguments = (*parameters, *sizes, *states, *grids, *out)
    beside, part = False, particle_part(forward)
    if not first:
        beside = add_loads(forward, s - 1, states[0], launch)
    launch(kernel, size.threads_adj, *arguments, block_dim=size.block, part=part, beside=beside)
    if not first:
        sums.accumulate(forward, s - 1, states[0], None, launch)
