"""Adjoint launches of a chunk of the fast scheme, from the last substep to the first."""

import warp as wp

from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.g2p2g_adj import fused_adj
from softmpm.kernels.fast.native import BLOCK
from softmpm.schemes.carried import Nodes
from softmpm.schemes.fast.adjoint_buffers import ChunkAdjoint
from softmpm.schemes.fast.contact_views import contact_nodes, vector_and_number
from softmpm.schemes.launch import KernelLauncher


def launch_chunk_adj(adjoint: ChunkAdjoint, launch: KernelLauncher) -> None:
    """Turn the packed adjoint of the final state into that of the initial state, and accumulate the adjoints of the inputs."""
    shared, chunk = adjoint.shared, adjoint.forward.chunk
    launch(fused(adjoint.model.spec).clear, len(shared.velocity), shared.velocity_array, block_dim=BLOCK)
    for s in range(chunk.length, -1, -1):
        _grid(adjoint, s, launch)
        if s > 0:
            _contact_again(adjoint, s - 1, launch)
        _particles(adjoint, s, launch)
        if s > 0:
            _contact(adjoint, s - 1, launch)
        if s == 0 or (s < chunk.length and chunk.row(s - 1) != chunk.row(s)):
            adjoint.found.collect(chunk.row(s), adjoint.forward.inputs.values, launch)


def _grid(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of the grid stage of substep ``s``, and the nodal velocities of substep ``s - 1`` once more."""
    forward, shared, (here, before) = adjoint.forward, adjoint.shared, _adj_nodes(adjoint, s)
    model, nodes, nothing = forward.model, forward.node_arrays, forward.nothing
    if shared.exact is not None:
        here, before = shared.exact.sums(s), nothing
    last, first = s == forward.chunk.length, s == 0
    now, then = nothing if last else nodes[s], nothing if first else nodes[s - 1]
    kernel = fused_adj(model.spec, adjoint.wanted).grid_velocity_adj
    stages = [(max(s - 1, 0) if last else s, now, then)]
    if model.spec.moving and not (last or first):  # the walls have another pose in each
        stages = [(s, now, nothing), (s - 1, nothing, then)]
    for k, now, then in stages:
        inputs, adj_inputs = (
            forward.inputs.grid_struct(k),
            adjoint.found.grid_struct(forward.chunk.row(k)),
        )
        grids = (now, then, here, shared.velocity_array, before)
        arguments = (model.constants, inputs, forward.window, *grids, adj_inputs)
        launch(kernel, len(shared.velocity), *arguments, block_dim=BLOCK)


def _contact_again(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Contact at surface points in substep ``s`` once more, and the adjoint of how it carries them."""
    forward, back = adjoint.forward, adjoint.shared.contact
    if forward.contact is not None and back is not None:
        inputs, nodes = forward.inputs.grid_struct(s), _contact_nodes(adjoint, s)
        adj_velocity, _ = _adj_contact_nodes(adjoint, s)
        back.again(forward.contact, s, inputs, nodes, adj_velocity, forward.words_array, launch)


def _contact(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of contact at surface points in substep ``s``."""
    forward, back = adjoint.forward, adjoint.shared.contact
    if forward.contact is not None and back is not None:
        inputs, adj_inputs = forward.inputs.grid_struct(s), adjoint.found.grid_struct(forward.chunk.row(s))
        nodes, adj_nodes = _contact_nodes(adjoint, s), _adj_contact_nodes(adjoint, s)
        back.respond(forward.contact, s, inputs, adj_inputs, nodes, *adj_nodes, launch)


def _contact_nodes(adjoint: ChunkAdjoint, s: int) -> Nodes:
    """Nodes of substep ``s`` as contact takes them."""
    return contact_nodes(adjoint.model, adjoint.forward.nodes[s], adjoint.shared.velocity)


def _adj_contact_nodes(adjoint: ChunkAdjoint, s: int) -> tuple[wp.array, wp.array]:
    """Adjoints of the nodes' velocities in substep ``s``, and what contact adds to those of the masses."""
    return vector_and_number(adjoint.model, adjoint.shared.nodes[s % 2])


def _adj_nodes(adjoint: ChunkAdjoint, s: int) -> tuple[wp.array, wp.array]:
    """Adjoint grids of substep ``s`` and of the previous substep."""
    nodes = adjoint.shared.node_arrays
    return nodes[s % 2], nodes[(s + 1) % 2]


def _particles(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of P2G of substep ``s``, then that of G2P of the previous substep."""
    forward, shared, (here, before) = adjoint.forward, adjoint.shared, _adj_nodes(adjoint, s)
    model, chunk, size, exact = forward.model, forward.chunk, forward.size, shared.exact
    sink = before if exact is None else exact.shares(s - 1)
    first, last = s == 0, s == chunk.length
    rows = [chunk.row(min(max(k, 0), chunk.length - 1)) for k in (s, s - 1)]
    inputs = forward.inputs.particle_struct(s, s - 1)
    parameters = (model.constants, inputs, forward.window, chunk.length - 1 - s, first, last)
    sizes = (size.per_warp_adj, model.particle_count, size.particles, forward.order_flat)
    states = (forward.packed[max(s - 1, 0)], forward.packed[s])
    grids = (shared.velocity_array, here, shared.adj_array)
    out = (forward.words_array, adjoint.found.particle_struct(*rows), sink)
    kernel = fused_adj(model.spec, adjoint.wanted).g2p2g_adj[size.few]
    launch(kernel, size.threads_adj, *parameters, *sizes, *states, *grids, *out, block_dim=size.block)
    if exact is not None and not first:
        exact.accumulate(forward, s - 1, states[0], None, launch)
