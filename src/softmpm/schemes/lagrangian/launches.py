"""Launches of a chunk of the reference formulation, forward and adjoint, in their order."""

from typing import Any

import warp as wp

from softmpm.kernels.lagrangian.cells import cells, cells_adj
from softmpm.kernels.lagrangian.displacements import displacements
from softmpm.kernels.lagrangian.lattice import lattice_cells, lattice_cells_adj
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.projection import masses
from softmpm.kernels.lagrangian.record import stores_u
from softmpm.schemes.buffers import view
from softmpm.schemes.lagrangian.bricks import brick_launch, lattice_struct, node_launch
from softmpm.schemes.lagrangian.buffers import ChunkAdjoint, ChunkBuffers
from softmpm.schemes.lagrangian.driven import drive, drive_adj
from softmpm.schemes.lagrangian.persistent import cluster_of, launch_march, launch_march_adj, segments
from softmpm.schemes.lagrangian.projection import launch_masses
from softmpm.schemes.launch import KernelLauncher


def launch_chunk(buffers: ChunkBuffers, launch: KernelLauncher) -> None:
    """Advance the first state by all substeps of the chunk, then check the last one."""
    model = buffers.model
    masses = buffers.placed_mass, buffers.partial_array, buffers.mass_array
    launch_masses(model, launch, buffers.rest, *masses)
    if buffers.contact is not None:
        buffers.contact.begin(launch, buffers.struct)
    cluster = cluster_of(model)
    for first, last in segments(buffers.chunk):
        if cluster is not None:
            launch_march(buffers, cluster, first, last, launch)
        else:
            for s in range(first, last):
                _forces(buffers, s, launch)
                _advance(buffers, s, launch)
    _check_end(buffers, buffers.chunk.length - 1, launch)


def _check_end(buffers: ChunkBuffers, s: int, launch: KernelLauncher) -> None:
    """Check the state after the last substep ``s``, of which no forces are computed."""
    model, inputs = buffers.model, buffers.inputs.particle_struct(s, s)
    u, words = buffers.last_u, buffers.words_array
    limited = s > 0  # else the next substep is checked
    kernel, arguments = cells(model.spec, model.rest_grid.bricks).check_state, (s, limited, True, u, words)
    brick_launch(model, launch, kernel, model.constants, inputs, buffers.rest, *arguments)
    if buffers.contact is not None:
        shift = buffers.shift_arrays[buffers.index(s + 1)]
        buffers.contact.check_end(launch, buffers.inputs.grid_struct(s), s, shift, u, words)


def _forces(buffers: ChunkBuffers, s: int, launch: KernelLauncher) -> None:
    """Internal and external forces of substep ``s`` on the nodes of each brick."""
    model, bricks = buffers.model, buffers.model.rest_grid.bricks
    parameters = (model.constants, buffers.inputs.particle_struct(s, s), buffers.rest)
    out = (buffers.struct, s)
    if bricks.lattice:
        kernel, lattice = lattice_cells(model.spec, bricks).forces, lattice_struct(model)
        brick_launch(model, launch, kernel, *parameters, lattice, *out, layered=True)
    else:
        brick_launch(model, launch, cells(model.spec, bricks).forces, *parameters, *out)


def _advance(buffers: ChunkBuffers, s: int, launch: KernelLauncher) -> None:
    """Motion of the nodes in substep ``s``, with contact."""
    model, inputs, at = buffers.model, buffers.inputs.grid_struct(s), buffers.struct
    kernel, arguments = nodes(model.spec).advance, (inputs, buffers.rest, buffers.frame, at, s)
    node_launch(model, launch, kernel, model.constants, *arguments)
    new_v = buffers.v_arrays[buffers.index(s + 1)]
    if buffers.contact is None:
        _constrain(buffers, s, inputs, new_v, buffers.chunk.anew(s), launch)
    else:
        _constrain(buffers, s, inputs, buffers.contact.free, buffers.chunk.anew(s), launch)
        buffers.contact.advance(launch, inputs, at, s)
        _constrain(buffers, s, inputs, new_v, 0, launch)


def _constrain(
    buffers: ChunkBuffers, s: int, inputs: Any, velocity: wp.array, anew: int, launch: KernelLauncher
) -> None:
    """Constraints of nodes in substep ``s``, for the new velocity or for that without contact."""
    u, new_u = buffers.u_arrays[buffers.index_u(s)], buffers.u_arrays[buffers.index_u(s + 1)]
    if buffers.reflection is not None:
        buffers.reflection.advance(launch, buffers.words_array, u, velocity, new_u, anew)
    drive(buffers.model, launch, inputs, buffers.words_array, u, new_u, velocity)


def launch_chunk_adj(adjoint: ChunkAdjoint, launch: KernelLauncher) -> None:
    """Turn the adjoint of the final state into that of the initial state, and accumulate those of the inputs."""
    forward, shared = adjoint.forward, adjoint.shared
    model, chunk = forward.model, forward.chunk
    cluster = cluster_of(model)
    if not stores_u(model.spec) and chunk.length > 1:
        kernel, low = displacements(model.spec.dim, model.spec.dtype), view(shared.low, forward.types.vec)
        node_launch(model, launch, kernel, model.constants, low, adjoint.at)
    for first, last in reversed(list(segments(chunk))):
        if cluster is not None:
            launch_march_adj(adjoint, cluster, first, last, launch)
            if first == 0:
                _gather_adj(adjoint, launch)
        else:
            for s in reversed(range(first, last)):
                _advance_adj(adjoint, s, launch)
                _forces_adj(adjoint, s, launch)
        adjoint.found.collect(chunk.row(first), forward.inputs.values, launch)
    if adjoint.contact is not None:
        adjoint.contact.finish(launch, adjoint.at, adjoint.struct)
    if adjoint.adj_placed_mass is not None:
        kernel = masses(model.spec.dim, model.spec.dtype, model.rest_grid.bricks).masses_adj
        brick_launch(model, launch, kernel, forward.rest, shared.mass_array, adjoint.adj_placed_mass)


def _advance_adj(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of the motion of the nodes in substep ``s``."""
    forward, shared = adjoint.forward, adjoint.shared
    model, reflection = forward.model, adjoint.reflection
    inputs, adj_inputs = forward.inputs.grid_struct(s), adjoint.found.grid_struct(forward.chunk.row(s))
    given, out = (inputs, forward.rest), (adjoint.at, adjoint.struct, adj_inputs, s)
    state = shared.u_array, shared.v_array
    drive_adj(model, launch, shared.wanted, model.scene.dt, *state, adj_inputs)
    if reflection is not None:
        stored = adjoint.u_arrays[s], forward.w_arrays[s], forward.v_arrays[s + 1]
        reflection.begin(launch, *given, *stored, *state)
    if adjoint.contact is not None:
        adjoint.contact.advance(launch, *given, *out, adjoint.u_arrays[s])
        drive_adj(model, launch, shared.wanted, 0.0, *state, adj_inputs)
    if reflection is not None:
        reflection.finish(launch, forward.chunk.anew(s), *state)
    if adjoint.contact is None or model.spec.constrained:
        kernel = nodes_adj(model.spec, shared.wanted).advance_adj
        node_launch(model, launch, kernel, model.constants, *given, *out)


def _forces_adj(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of the forces of substep ``s``."""
    forward, wanted, row = adjoint.forward, adjoint.shared.wanted, adjoint.forward.chunk.row(s)
    model, bricks = forward.model, forward.model.rest_grid.bricks
    parameters = (model.constants, forward.inputs.particle_struct(s, s), forward.rest)
    out = (adjoint.at, adjoint.struct, adjoint.found.particle_struct(row, row), s)
    if bricks.lattice:
        kernel, lattice = lattice_cells_adj(model.spec, wanted, bricks).forces_adj, lattice_struct(model)
        brick_launch(model, launch, kernel, *parameters, lattice, *out, layered=True)
    else:
        brick_launch(model, launch, cells_adj(model.spec, wanted, bricks).forces_adj, *parameters, *out)
    if s == 0 or model.spec.constrained:  # else the substep before adds the sums
        _gather_adj(adjoint, launch)


def _gather_adj(adjoint: ChunkAdjoint, launch: KernelLauncher) -> None:
    """Add the sums of the bricks to the adjoint of the state."""
    kernel = nodes_adj(adjoint.model.spec, adjoint.shared.wanted).gather_adj
    node_launch(adjoint.model, launch, kernel, adjoint.forward.rest, adjoint.struct)
