"""Sums of the contributions of particles to nodes: on a GPU particles add to them, a CPU has slabs of nodes for its threads.

A deterministic model has :class:`softmpm.schemes.fast.fixed_point.FixedPointSums` in their place.
"""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.fast.native import WARP
from softmpm.kernels.fast.slabs import LINE, WIDTH, slabs
from softmpm.model import Model
from softmpm.schemes.buffers import view
from softmpm.schemes.launch import KernelLauncher


class NodeSums:
    """Particles add to the nodes themselves.

    Args:
        nodes: Sum number k is in ``nodes[k % len(nodes)]``.
    """

    bytes = 0

    def __init__(self, nodes: Sequence[wp.array]):
        self._nodes = nodes

    def begin(self, mass: Tensor | None) -> None:
        """Prepare sum 0 with the masses (world, particle) that enter the sums, or None."""

    def sink(self, k: int) -> Any:
        """Destination of the particles' contributions to sum ``k``."""
        return self._nodes[k % len(self._nodes)]

    def source(self, k: int) -> Any:
        """Sum ``k`` for the kernels that read it."""
        return self._nodes[k % len(self._nodes)]

    def cleared(self, k: int) -> wp.array | None:
        """Nodes to be cleared before sum ``k``; None if that is done where they are read."""
        return self._nodes[k % len(self._nodes)]

    def accumulate(
        self, buffers, k: int, states, mass: wp.array | None, launch: KernelLauncher, beside: bool = False
    ) -> None:
        """Add up the contributions of the particles of ``states`` in sum ``k``, if possible beside the launch before."""


class SlabSums(NodeSums):
    """Particles store their contributions, which slabs of nodes add up.

    Args:
        rows: Packed particles; the rows of v and C hold the contribution of a particle.
    """

    def __init__(self, model: Model, rows: Tensor, nodes: Sequence[wp.array]):
        super().__init__(nodes)
        self.model = model
        self._kernels, real = slabs(model.dim, model.spec.dtype), wp.dtype_from_torch(rows.dtype)
        places = model.worlds * model.particle_count
        ends = torch.empty(LINE * -(-places // WARP), dtype=torch.int32, device=model.device)
        self._shares = self._kernels.Shares()
        self._shares.rows, self._shares.ends = view(rows, real), view(ends, wp.int32)
        self._none = view(rows.new_empty(0, 0), real)
        self.bytes = rows.nbytes + ends.nbytes

    def sink(self, k: int) -> Any:
        return self._shares

    def accumulate(
        self, buffers, k: int, states, mass: wp.array | None, launch: KernelLauncher, beside: bool = False
    ) -> None:
        model, window = self.model, buffers.window
        sizes = model.worlds, -(-buffers.layout.shape[0] // WIDTH)
        mass = self._none if mass is None else mass
        arguments = (window, model.particle_count, states, self._shares, mass, self.source(k))
        launch(self._kernels.collect, sizes, *arguments, part=1, beside=beside)
