"""Launches of a chunk in which one kernel takes all substeps of a control step, see kernels/lagrangian/persistent.py."""

import itertools
from collections.abc import Iterator
from typing import Any

from softmpm.kernels.compile import clusters_are_launchable
from softmpm.kernels.lagrangian.cluster import Cluster
from softmpm.kernels.lagrangian.layers import layers
from softmpm.kernels.lagrangian.persistent import march, march_adj
from softmpm.kernels.lagrangian.surface_sums import surface_type
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.lagrangian.bricks import lattice_struct
from softmpm.schemes.lagrangian.buffers import ChunkAdjoint, ChunkBuffers
from softmpm.schemes.launch import KernelLauncher
from softmpm.surface_grid import SurfaceGrid

BLOCKS = 16
"""Blocks of a cluster; a GPU of 132 multiprocessors has eight such clusters at a time."""
THREADS, BYTES = 512, 46 * 1024
"""Threads of a block, at most, and shared memory for their bricks: the compiler takes up to two kilobytes more."""
GROUP_THREADS = 32, 64
"""Threads of a group, whole warps; with larger bricks single launches are faster."""
WORLDS = 8
"""Worlds, at most: as many as there are clusters at a time."""


def cluster_of(model: Model) -> Cluster | None:
    """The threads that have a world if they suffice for all its bricks at once; None else, and if nodes or walls are prescribed."""
    return model.workspace.get(cluster_of, lambda: _cluster_of(model))


def _cluster_of(model: Model) -> Cluster | None:
    grid, spec = model.rest_grid, model.spec
    if model.device.type != "cuda" or model.worlds > WORLDS or spec.constrained or spec.moving:
        return None
    one = Cluster(grid.bricks, BLOCKS, 1)
    most = min(THREADS // one.threads, BYTES // grid.bricks.shared_bytes(model.dtype.itemsize))
    groups = next((n for n in (1, 2, 4, 8) if n * BLOCKS >= grid.brick_count), most + 1)
    if groups > most or one.threads not in GROUP_THREADS:
        return None
    cluster = one._replace(groups=groups)
    cluster = cluster._replace(alone=_threads_needed(model, cluster) <= cluster.blocks * cluster.threads)
    launchable = clusters_are_launchable(march(spec, cluster), model.wp_device, cluster.threads)
    return cluster if launchable else None


def _threads_needed(model: Model, cluster: Cluster) -> int:
    """Threads of a world if each has one node, surface point and touched node at most."""
    surface = model.surface
    touched = len(surface.nodes) * cluster.lanes if isinstance(surface, SurfaceGrid) else 0
    return max(model.rest_grid.count, model.anchor_shape[2], touched)


def segments(chunk: Chunk) -> Iterator[tuple[int, int]]:
    """Substeps of a chunk, cut where a control step begins."""
    begins = sorted({0, *chunk.shape[1], chunk.length})
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
    launch(kernel, dim, *arguments, adjoint.at, adjoint.struct, *out, *span, block_dim=cluster.threads)


def _constants(buffers: ChunkBuffers) -> tuple[Any, Any]:
    """Structs of the weights of a lattice and of the surface points; empty ones where there are none."""
    spec, bricks, contact = buffers.model.spec, buffers.model.rest_grid.bricks, buffers.contact
    weights = (
        lattice_struct(buffers.model) if bricks.lattice else layers(spec.dim, spec.dtype, bricks).Lattice()
    )
    return weights, surface_type(spec.dim, spec.dtype)() if contact is None else contact.struct
