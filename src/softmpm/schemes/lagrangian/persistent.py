"""Launches of a chunk in which one kernel takes all substeps of a control step, see kernels/lagrangian/persistent.py."""

import itertools
from collections.abc import Iterator
from typing import Any

import torch

from softmpm.kernels.lagrangian.lattice import layers
from softmpm.kernels.lagrangian.persistent import Cluster, march, march_adj
from softmpm.kernels.lagrangian.surface import surface_type
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
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


def launch_march(
    buffers: ChunkBuffers, cluster: Cluster, first: int, last: int, launch: KernelLauncher
) -> None:
    """Substeps from ``first`` to before ``last``, all in one control step."""
    model, (weights, body) = buffers.model, _constants(buffers)
    inputs = buffers.inputs.particle_struct(first, first), buffers.inputs.grid_struct(first)
    arguments = (model.constants, *inputs, buffers.rest, weights, buffers.frame, body, buffers.struct)
    kernel, dim = march(model.spec, cluster), (model.worlds, cluster.blocks, cluster.threads)
    span = first, last, buffers.chunk.anew(first)
    launch(kernel, dim, *arguments, *span, block_dim=cluster.threads)


def launch_march_adj(
    adjoint: ChunkAdjoint, cluster: Cluster, first: int, last: int, launch: KernelLauncher
) -> None:
    """Adjoint of :func:`launch_march`."""
    forward, model, (weights, body) = adjoint.forward, adjoint.model, _constants(adjoint.forward)
    inputs, row = forward.inputs.particle_struct(first, first), forward.chunk.row(first)
    out = adjoint.found.particle_struct(row, row), adjoint.found.grid_struct(row)
    arguments = (model.constants, inputs, forward.inputs.grid_struct(first), forward.rest, weights, body)
    kernel = march_adj(model.spec, adjoint.shared.wanted, cluster)
    span, dim = (first, last, forward.chunk.anew(first)), (model.worlds, cluster.blocks, cluster.threads)
    launch(kernel, dim, *arguments, forward.struct, adjoint.struct, *out, *span, block_dim=cluster.threads)


def _constants(buffers: ChunkBuffers) -> tuple[Any, Any]:
    """Structs of the weights of a lattice and of the surface points; empty ones where there are none."""
    spec, bricks, contact = buffers.model.spec, buffers.model.rest_grid.bricks, buffers.contact
    weights = (
        lattice_struct(buffers.model) if bricks.lattice else layers(spec.dim, spec.dtype, bricks).Lattice()
    )
    return weights, surface_type(spec.dim, spec.dtype)() if contact is None else contact.struct
