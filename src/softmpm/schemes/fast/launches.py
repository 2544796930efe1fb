"""Launches of a chunk of the fast scheme, in their order: P2G, then for each substep the grid and G2P with the next P2G."""

import math

import warp as wp

from softmpm.kernels.carried.grid_stage import contact_stage
from softmpm.kernels.fast.alarms import packed_alarms
from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.native import BLOCK, WARP
from softmpm.kernels.fast.sorting import sorting
from softmpm.schemes.alarm_check import armed
from softmpm.schemes.carried import SurfaceContact
from softmpm.schemes.fast.chunk_buffers import ChunkBuffers
from softmpm.schemes.launch import KernelLauncher

PARTICLE_PART, NODE_PART = WARP, 256
"""Particles and nodes of a part of a launch on the CPU. Particles are whole blocks of packed rows: no two threads write to one."""


def particle_part(buffers: ChunkBuffers) -> int | None:
    """Particles of a part; None in a deterministic model, whose particles all raise one number."""
    return PARTICLE_PART if buffers.model.spec.slabs else None


def launch_chunk(buffers: ChunkBuffers, launch: KernelLauncher) -> None:
    """Advance the first packed state by all substeps of the chunk, then check the last one."""
    spec = buffers.model.spec
    for nodes in [*buffers.velocity_arrays, buffers.sums.cleared(0)]:
        if nodes is not None:
            launch(fused(spec).clear, buffers.held, nodes, block_dim=BLOCK, part=NODE_PART)
    if buffers.contact is not None:
        launch(contact_stage(spec).clear, buffers.loads.shape[1:], *buffers.load_arrays, block_dim=BLOCK)
    _p2g_first(buffers, launch)
    for s in range(buffers.chunk.length):
        if buffers.contact is None:
            _grid(buffers, s, launch)
        else:
            _contact(buffers, buffers.contact, s, launch)
        _g2p2g(buffers, s, launch)
    _survey(buffers, launch)
    if armed(buffers.model):
        _check(buffers, launch)
    if buffers.contact is not None and buffers.model.alarms.depth is not None:
        inputs = buffers.inputs.grid_struct(buffers.chunk.length - 1)
        buffers.contact.check_end(inputs, buffers.packed[-1], buffers.words_array, launch)


def _p2g_first(buffers: ChunkBuffers, launch: KernelLauncher) -> None:
    """P2G of the first substep."""
    model, size, sums = buffers.model, buffers.size, buffers.sums
    sizes = (size.per_warp, model.particle_count, size.particles, buffers.order_flat)
    state = (buffers.packed[0], buffers.words_array)
    inputs = buffers.inputs.particle_struct(0, 0)
    kernel = fused(model.spec).p2g_first
    arguments = (model.constants, inputs, buffers.window, *sizes, *state, sums.sink(0))
    launch(kernel, size.threads, *arguments, block_dim=size.block, part=particle_part(buffers))
    _accumulate(buffers, 0, buffers.packed[0], launch)


def _accumulate(buffers: ChunkBuffers, s: int, now, launch: KernelLauncher) -> None:
    """Complete the sums over the particles ``now`` at the nodes of substep ``s``."""
    beside = add_loads(buffers, s, now, launch)
    buffers.sums.accumulate(buffers, s, now, buffers.mass, launch, beside)


def add_loads(buffers: ChunkBuffers, s: int, now, launch: KernelLauncher) -> bool:
    """On a CPU, add up the loads of the points on the particles ``now`` at the nodes of substep ``s``; a GPU does so in its grid stage.

    True if the next launch may begin beside this one.
    """
    if buffers.contact is None or not buffers.model.spec.slabs:
        return False
    buffers.contact.add_loads(now, buffers.load_arrays[s % 2], launch)
    return True


def _grid(buffers: ChunkBuffers, s: int, launch: KernelLauncher) -> None:
    """Nodal velocities of substep ``s``; clears the nodes that the next P2G adds to."""
    model, inputs = buffers.model, buffers.inputs.grid_struct(s)
    arguments = (model.constants, inputs, buffers.window, buffers.sums.source(s), buffers.velocity_array)
    kernel, then = fused(model.spec).grid_velocity, _cleared(buffers, s)
    launch(kernel, buffers.held, *arguments, then, block_dim=BLOCK, part=NODE_PART)
    _remember(buffers, launch)


def _remember(buffers: ChunkBuffers, launch: KernelLauncher) -> None:
    """On a CPU, keep the status words for the next launch, beside the one before."""
    if buffers.model.spec.slabs:
        arguments = (buffers.model.worlds, buffers.words_array, buffers.before_array)
        launch(fused(buffers.model.spec).remember, *arguments, beside=True)


def _cleared(buffers: ChunkBuffers, s: int) -> wp.array:
    """Nodes to be cleared in substep ``s``, for the next P2G."""
    cleared = None if s + 1 == buffers.chunk.length else buffers.sums.cleared(s + 1)
    return buffers.nothing if cleared is None else cleared


def _contact(buffers: ChunkBuffers, contact: SurfaceContact, s: int, launch: KernelLauncher) -> None:
    """Nodal velocities of substep ``s``, with contact at surface points."""
    model, now, then = buffers.model, buffers.sums.source(s), _cleared(buffers, s)
    inputs, packed, loads = buffers.inputs.grid_struct(s), buffers.packed_at(s), buffers.load_arrays
    velocity, free = buffers.velocity_arrays
    first, threads = point_threads(buffers)
    parameters = (model.constants, inputs, buffers.window, contact.outline, first, contact.owner_array)
    out = (free, velocity, then, loads[(s + 1) % 2], loads[s % 2])
    kernel = contact_stage(model.spec).grid_and_loads
    launch(kernel, threads, *parameters, packed, now, *out, block_dim=BLOCK, part=NODE_PART)
    _remember(buffers, launch)
    nodes = buffers.contact_nodes(s, *buffers.velocity_vectors)
    contact.press(s, inputs, packed, nodes, buffers.words_array, launch, before=buffers.before_array)
    _remember(buffers, launch)


def point_threads(buffers: ChunkBuffers) -> tuple[int, int]:
    """Number of the first lane of a point, in a block of its own after those of the nodes, and of all threads.

    On a CPU points have launches of their own, since nodes are divided and points are not.
    """
    assert buffers.contact is not None
    first = -(-buffers.held // BLOCK) * BLOCK
    return first, buffers.held if buffers.model.spec.slabs else first + math.prod(buffers.contact.threads)


def _g2p2g(buffers: ChunkBuffers, s: int, launch: KernelLauncher) -> None:
    """G2P of substep ``s`` and P2G of the next."""
    model, size, sums, last = buffers.model, buffers.size, buffers.sums, s + 1 == buffers.chunk.length
    now, then = (buffers.packed[s], buffers.packed[s + 1]) if buffers.keep else 2 * (buffers.packed[0],)
    parameters = (
        model.constants,
        buffers.inputs.particle_struct(s + 1, s),
        buffers.window,
        s,
        last,
        size.per_warp,
    )
    sizes = (model.particle_count, size.particles, buffers.order_flat)
    arguments = (*sizes, buffers.before_array, buffers.velocity_array, now, buffers.words_array, then)
    kernel, part = fused(model.spec).g2p2g[size.size_class], particle_part(buffers)
    launch(kernel, size.threads, *parameters, *arguments, sums.sink(s + 1), block_dim=size.block, part=part)
    if not last:
        _accumulate(buffers, s + 1, then, launch)


def _survey(buffers: ChunkBuffers, launch: KernelLauncher) -> None:
    """Count the changes of cell along the order, and find particles near the window's edge."""
    model, total = buffers.model, buffers.size.particles
    kernel = sorting(model.dim, model.spec.dtype).survey
    arguments = (model.constants, buffers.window, model.particle_count, buffers.packed[-1].base)
    launch(kernel, total, *arguments, buffers.survey_array)


def _check(buffers: ChunkBuffers, launch: KernelLauncher) -> None:
    """Check the alarms on the final state."""
    model, total, last = buffers.model, buffers.size.particles, buffers.chunk.length - 1
    sizes = (last, model.particle_count, total, buffers.order_flat)
    inputs = buffers.inputs.particle_struct(last, last)
    arguments = (model.constants, inputs, buffers.layout.neighbours, *sizes)
    kernel = packed_alarms(model.spec).check
    launch(kernel, total, *arguments, buffers.packed[-1], buffers.words_array)
