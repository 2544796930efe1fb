"""Launches of a chunk of the reference formulation, forward and adjoint, in their order."""

from softmpm.kernels.lagrangian.cells import cells, cells_adj
from softmpm.kernels.lagrangian.lattice import lattice_cells, lattice_cells_adj
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.projection import masses
from softmpm.schemes.lagrangian.bricks import brick_launch, lattice_struct, node_launch
from softmpm.schemes.lagrangian.buffers import ChunkAdjoint, ChunkBuffers
from softmpm.schemes.lagrangian.driven import drive, drive_adj
from softmpm.schemes.lagrangian.nodal import launch_masses
from softmpm.schemes.launch import KernelLauncher

CHECKED = 8
"""Substeps from one check of the step limit to the next: an instability takes several substeps to grow. A chunk that failed is run
again substep by substep, with a check at the beginning of each.
"""


def launch_chunk(buffers: ChunkBuffers, launch: KernelLauncher) -> None:
    """Advance the first state by all substeps of the chunk, then check the last one."""
    model = buffers.model
    masses = buffers.placed_mass, buffers.partial_array, buffers.mass_array
    launch_masses(model, launch, buffers.rest, *masses)
    if buffers.contact is not None:
        buffers.contact.begin(launch)
    for s in range(buffers.chunk.length):
        if s % CHECKED == 0 and model.alarms.step is not None:
            _check_step(buffers, s, buffers.index(s), launch)
        _forces(buffers, s, launch)
        _advance(buffers, s, launch)
    last = buffers.chunk.length
    if model.alarms.step is not None and last > 1:  # else the next substep is checked
        _check_step(buffers, last - 1, buffers.index(last), launch)
    kernel, u = cells(model.spec, model.rest_grid.bricks).check_end, buffers.u_arrays[buffers.index(last)]
    if buffers.contact is not None:
        inputs = buffers.inputs.grid_struct(last - 1)
        buffers.contact.check_end(launch, inputs, last - 1, buffers.index(last), u, buffers.words_array)
    brick_launch(model, launch, kernel, model.constants, buffers.rest, last - 1, u, buffers.words_array)
    if buffers.overlap is not None:
        buffers.overlap.check(launch, last - 1, u, buffers.words_array)


def _check_step(buffers: ChunkBuffers, s: int, state: int, launch: KernelLauncher) -> None:
    """Compare Δt with the limit of each particle in a stored state, with the inputs of substep ``s``."""
    model, inputs = buffers.model, buffers.inputs.particle_struct(s, s)
    arguments = (s, True, buffers.u_arrays[state], buffers.words_array)
    kernel = cells(model.spec, model.rest_grid.bricks).check_start
    brick_launch(model, launch, kernel, model.constants, inputs, buffers.rest, *arguments)


def _forces(buffers: ChunkBuffers, s: int, launch: KernelLauncher) -> None:
    """Internal and external forces of substep ``s`` on the nodes of each brick."""
    model, now = buffers.model, buffers.index(s)
    inputs, bricks = buffers.inputs.particle_struct(s, s), model.rest_grid.bricks
    state = buffers.u_arrays[now], buffers.v_arrays[now]
    arguments = (s, *state, buffers.words_array, buffers.partial_array)
    if bricks.lattice:
        parameters = (model.constants, inputs, buffers.rest, lattice_struct(model))
        kernel = lattice_cells(model.spec, bricks).forces
        brick_launch(model, launch, kernel, *parameters, *arguments, layered=True)
    else:
        kernel = cells(model.spec, bricks).forces
        brick_launch(model, launch, kernel, model.constants, inputs, buffers.rest, *arguments)


def _advance(buffers: ChunkBuffers, s: int, launch: KernelLauncher) -> None:
    """Motion of the nodes in substep ``s``, with contact."""
    model, now, then = buffers.model, buffers.index(s), buffers.index(s + 1)
    inputs, contact = buffers.inputs.grid_struct(s), buffers.contact
    state = buffers.u_arrays[now], buffers.v_arrays[now]
    new = buffers.u_arrays[then], buffers.v_arrays[then]
    p = buffers.p_arrays[s if buffers.keep else 0]
    velocity = new[1] if contact is None else contact.free
    sums = buffers.mass_array, buffers.partial_array, buffers.words_array
    shift, new_shift = buffers.shift_arrays[now], buffers.shift_arrays[then]
    parameters = (model.constants, inputs, buffers.rest, buffers.frame)
    arguments = (*parameters, *sums, shift, *state, p, velocity, new_shift, *new)
    node_launch(model, launch, nodes(model.spec).advance, *arguments)
    if buffers.reflection is not None:
        buffers.reflection.advance(
            launch, buffers.words_array, state[0], velocity, new[0], buffers.chunk.anew(s)
        )
    drive(model, launch, inputs, buffers.words_array, state[0], new[0], velocity)
    if contact is not None:
        contact.advance(launch, s, inputs, buffers.words_array, now, then, *state, *new)
        if buffers.reflection is not None:
            buffers.reflection.advance(launch, buffers.words_array, state[0], new[1], new[0])
        drive(model, launch, inputs, buffers.words_array, state[0], *new)


def launch_chunk_adj(adjoint: ChunkAdjoint, launch: KernelLauncher) -> None:
    """Turn the adjoint of the final state into that of the initial state, and accumulate those of the inputs."""
    forward, shared = adjoint.forward, adjoint.shared
    model, chunk = forward.model, forward.chunk
    for s in reversed(range(chunk.length)):
        _advance_adj(adjoint, s, launch)
        _forces_adj(adjoint, s, launch)
        if s == 0 or chunk.row(s) != chunk.row(s - 1):
            adjoint.found.collect(chunk.row(s), forward.inputs.values, launch)
    if adjoint.contact is not None:
        adjoint.contact.finish(launch)
    if adjoint.adj_placed_mass is not None:
        kernel = masses(model.spec.dim, model.spec.dtype, model.rest_grid.bricks).masses_adj
        brick_launch(model, launch, kernel, forward.rest, shared.mass_array, adjoint.adj_placed_mass)


def _advance_adj(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of the motion of the nodes in substep ``s``."""
    forward, shared = adjoint.forward, adjoint.shared
    model, row = forward.model, forward.chunk.row(s)
    inputs, adj_inputs = forward.inputs.grid_struct(s), adjoint.found.grid_struct(row)
    stored, new_v = (forward.u_arrays[s], forward.v_arrays[s], forward.p_arrays[s]), forward.v_arrays[s + 1]
    shift, out, sums = (
        forward.shift_arrays[s],
        (shared.u_array, shared.v_array),
        (shared.f_array, shared.mass_array),
    )
    last, reflection, constrained = s == forward.chunk.length - 1, adjoint.reflection, model.spec.constrained
    pending = (not last and not constrained, shared.partial_arrays[0], shared.partial_arrays[1])
    drive_adj(model, launch, shared.wanted, model.scene.dt, *out, adj_inputs)
    if reflection is not None:
        reflection.begin(launch, inputs, forward.rest, stored[0], stored[2], new_v, *out)
    if adjoint.contact is not None:
        given = inputs, adj_inputs, forward.rest, stored, new_v, pending
        adjoint.contact.advance(launch, s, *given, *out, shared.f_array)
        drive_adj(model, launch, shared.wanted, 0.0, *out, adj_inputs)
    if reflection is not None:
        reflection.finish(launch, forward.chunk.anew(s), *out)
    if adjoint.contact is None or constrained:
        parameters = (model.constants, inputs, forward.rest, forward.mass_array, shared.held, shift)
        kernel = nodes_adj(model.spec, shared.wanted).advance_adj
        node_launch(model, launch, kernel, *parameters, *stored, *pending, *out, *sums, adj_inputs)


def _forces_adj(adjoint: ChunkAdjoint, s: int, launch: KernelLauncher) -> None:
    """Adjoint of the forces of substep ``s``."""
    forward, shared = adjoint.forward, adjoint.shared
    model, row = forward.model, forward.chunk.row(s)
    inputs, adj_inputs = forward.inputs.particle_struct(s, s), adjoint.found.particle_struct(row, row)
    parameters, bricks = (model.constants, inputs, forward.rest), model.rest_grid.bricks
    state = (forward.u_arrays[s], forward.v_arrays[s], shared.f_array)
    arguments = (
        forward.chunk.length - 1 - s,
        *state,
        forward.words_array,
        adj_inputs,
        *shared.partial_arrays,
    )
    if bricks.lattice:
        kernel, lattice = (
            lattice_cells_adj(model.spec, shared.wanted, bricks).forces_adj,
            lattice_struct(model),
        )
        brick_launch(model, launch, kernel, *parameters, lattice, *arguments, layered=True)
    else:
        kernel = cells_adj(model.spec, shared.wanted, bricks).forces_adj
        brick_launch(model, launch, kernel, *parameters, *arguments)
    if s == 0 or model.spec.constrained:  # else the substep before adds the sums
        kernel, out = nodes_adj(model.spec, shared.wanted).gather_adj, (shared.u_array, shared.v_array)
        node_launch(model, launch, kernel, forward.rest, *shared.partial_arrays, *out)
