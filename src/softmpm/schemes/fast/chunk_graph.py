"""Chunk graphs: the launches of a chunk, forward (launches.py) or adjoint (launches_adj.py), captured once on fixed buffers.

A chunk graph is leased to one call: until its backward pass has run if it stores states that are not copied, otherwise until no later
chunk reads its final state.
"""

import warp as wp

from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.fast.adjoint_buffers import ChunkAdjoint, SharedAdjoint
from softmpm.schemes.fast.chunk_buffers import ChunkBuffers
from softmpm.schemes.fast.launches import launch_chunk
from softmpm.schemes.fast.launches_adj import launch_chunk_adj
from softmpm.schemes.fast.particle_order import ParticleLayout
from softmpm.schemes.launch import LaunchReplay


class ChunkGraph:
    """Captured launches of the chunks of one shape on one particle layout.

    Args:
        keep: Whether to store the intermediate states, which :class:`ChunkGraphAdj` needs.
    """

    def __init__(self, model: Model, layout: ParticleLayout, chunk: Chunk, keep: bool):
        self.buffers = ChunkBuffers(model, layout, chunk, keep)
        self._replay = LaunchReplay(model)

    def run(self, stream: wp.Stream | None) -> None:
        """Launch all substeps on what the buffers hold."""
        self._replay.run(stream, lambda launch: launch_chunk(self.buffers, launch))


class ChunkGraphAdj:
    """Captured adjoint launches of the chunks whose states a chunk graph stores."""

    def __init__(self, graph: ChunkGraph, shared: SharedAdjoint):
        self.buffers = ChunkAdjoint(graph.buffers, shared)
        self._replay = LaunchReplay(graph.buffers.model)

    def run(self, stream: wp.Stream | None) -> None:
        """Turn the adjoint of the final state in the buffers into that of the initial state."""
        self._replay.run(stream, lambda launch: launch_chunk_adj(self.buffers, launch))
