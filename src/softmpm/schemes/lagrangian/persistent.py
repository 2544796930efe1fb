"""Launches of a chunk in which one kernel takes all substeps of a control step, see kernels/lagrangian/persistent.py."""

import itertools
from collections.abc import Iterator

import torch

from softmpm.kernels.lagrangian.lattice import layers
from softmpm.kernels.lagrangian.persistent import Cluster, arrays_type, march, march_adj
from softmpm.kernels.lagrangian.surface import surface_type
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import view
from softmpm.schemes.lagrangian.bricks import lattice_struct
from softmpm.schemes.lagrangian.buffers import ChunkAdjoint, ChunkBuffers
from softmpm.schemes.launch import KernelLauncher

BLOCKS = 16
"""Blocks of a cluster, the most that there are."""
TURNS = 2
"""Bricks that a group of threads has one after the other, at most."""
THREADS = 512
"""Of a block, at most."""
WORLDS = 8


def cluster_of(model: Model) -> Cluster | None:
    """The threads that have a world, or None if there are too many bricks, or nodes are held, or no clusters of blocks."""
    grid, spec = model.rest_grid, model.spec
    if spec.constrained or spec.moving or model.device.type != "cuda" or model.worlds > WORLDS:
        return None
    if torch.cuda.get_device_capability(model.device) < (9, 0):
        return None
    one = Cluster(grid.bricks, BLOCKS, 1)
    groups = 1
    while groups * BLOCKS < grid.brick_count and 2 * groups * one.threads <= THREADS:
        groups *= 2
    if one.threads % 32 or grid.brick_count > TURNS * groups * BLOCKS:
        return None
    return one._replace(groups=groups)


def segments(chunk: Chunk, longest: int) -> Iterator[tuple[int, int]]:
    """Substeps of a chunk, cut where a control step begins and after ``longest`` of them."""
    begins = sorted({*range(0, chunk.length, longest), *chunk.shape[1], chunk.length})
    yield from itertools.pairwise(begins)


def arrays(buffers: ChunkBuffers):
    dim, dtype = buffers.model.spec.dim, buffers.model.spec.dtype
    t, exact = types(dim, dtype), types(dim, "float64").vec
    struct = arrays_type(dim, dtype)[0]()
    struct.shift = view(buffers.shift, exact)
    struct.u, struct.v, struct.p = (view(one, t.vec) for one in (buffers.u, buffers.v, buffers.p))
    struct.mass, struct.partial, struct.words = (
        buffers.mass_array,
        buffers.partial_array,
        buffers.words_array,
    )
    contact = buffers.contact
    if contact is not None:
        struct.anchor, struct.force = view(buffers.anchor, t.vec), view(buffers.force, t.vec)
        struct.free, struct.impulse, struct.D = contact.free, contact.impulse, contact.D
        struct.rate = contact.rate_array
    return struct


def arrays_adj(adjoint: ChunkAdjoint):
    shared, spec = adjoint.shared, adjoint.model.spec
    struct = arrays_type(spec.dim, spec.dtype)[1]()
    struct.u, struct.v, struct.f, struct.mass = (
        shared.u_array,
        shared.v_array,
        shared.f_array,
        shared.mass_array,
    )
    struct.partial_u, struct.partial_v = shared.partial_arrays
    contact = adjoint.contact
    if contact is not None:
        struct.anchor, struct.force = contact.adj_anchor, contact.adj_force
        struct.shared, struct.x, struct.free, struct.D = (
            contact.shared,
            contact.adj_x,
            contact.adj_free,
            contact.adj_D,
        )
    return struct


def _given(buffers: ChunkBuffers):
    """Weights of a lattice, surface points, width, lanes."""
    model, contact = buffers.model, buffers.contact
    spec, bricks = model.spec, model.rest_grid.bricks
    weights = lattice_struct(model) if bricks.lattice else layers(spec.dim, spec.dtype, bricks).Lattice()
    if contact is None:
        return weights, surface_type(spec.dim, spec.dtype)(), 0.0, 1
    return weights, contact.struct, contact.width, contact.lanes


def launch_march(
    buffers: ChunkBuffers, cluster: Cluster, first: int, last: int, launch: KernelLauncher
) -> None:
    model, (weights, *surface) = buffers.model, _given(buffers)
    inputs = buffers.inputs.particle_struct(first, first), buffers.inputs.grid_struct(first)
    arguments = (model.constants, *inputs, buffers.rest, weights, buffers.frame, *surface)
    span = arrays(buffers), buffers.keep, first, last, buffers.chunk.anew(first)
    dim = model.worlds, cluster.blocks, cluster.threads
    launch(march(model.spec, cluster), dim, *arguments, *span, block_dim=cluster.threads)


def launch_march_adj(
    adjoint: ChunkAdjoint, cluster: Cluster, first: int, last: int, launch: KernelLauncher
) -> None:
    forward, model, (weights, *surface) = adjoint.forward, adjoint.model, _given(adjoint.forward)
    chunk, shared = forward.chunk, adjoint.shared
    row = chunk.row(first)
    inputs = forward.inputs.particle_struct(first, first), forward.inputs.grid_struct(first)
    found = adjoint.found.particle_struct(row, row), adjoint.found.grid_struct(row)
    arguments = (model.constants, *inputs, forward.rest, weights, *surface, shared.held)
    span = arrays(forward), arrays_adj(adjoint), *found, chunk.length, first, last, chunk.anew(first)
    dim = model.worlds, cluster.blocks, cluster.threads
    kernel = march_adj(model.spec, shared.wanted, cluster)
    launch(kernel, dim, *arguments, *span, block_dim=cluster.threads)
