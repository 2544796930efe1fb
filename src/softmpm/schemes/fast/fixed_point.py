"""Buffers and launches of fixed-point sums, for chunk graphs of a deterministic model. Kernels: kernels/fast/fixed_point.py."""

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.fast.fixed_point import fixed
from softmpm.model import Model
from softmpm.schemes.buffers import clear, view
from softmpm.schemes.fast.sums import NodeSums
from softmpm.schemes.launch import KernelLauncher


class FixedPointSums(NodeSums):
    """Double-buffered fixed-point P2G sums; even and odd substeps have separate scale factors.

    Args:
        rows: Packed particles; the rows of v and C hold the contribution of a particle.
        nodes: Sums as floats, number k in ``nodes[k % len(nodes)]``.
    """

    def __init__(self, model: Model, rows: wp.array, nodes: Sequence[wp.array]):
        super().__init__(nodes)
        f, device = fixed(model.dim), model.device
        self.model = model
        self.fixed = torch.empty(len(nodes[0]), 4, dtype=torch.int64, device=device)
        self.largest = torch.zeros(2, model.worlds, 2, dtype=torch.float32, device=device)
        self._none = view(self.largest.new_empty(0, 0), wp.float32)
        largest = [view(part.view(-1), wp.float32) for part in self.largest]
        self._shares, self._sums = [], []
        for part in largest:
            shares = f.Shares()
            shares.rows, shares.largest = rows, part
            self._shares.append(shares)
        for k in range(max(len(nodes), 2)):
            sums = f.Sums()
            sums.nodes, sums.particles = len(self.fixed) // model.worlds, model.particle_count
            sums.fixed = view(self.fixed.view(-1), wp.int64)
            sums.largest, sums.other_largest = largest[k % 2], largest[(k + 1) % 2]
            sums.node = nodes[k % len(nodes)]
            self._sums.append(sums)
        self.bytes = self.fixed.nbytes + 4 * len(rows)

    def begin(self, mass: Tensor | None) -> None:
        """Prepare sum 0 with the masses (world, particle) that enter the sums, or None."""
        clear(self.fixed)  # reading a sum clears it, but a run may have been interrupted
        clear(self.largest)
        if mass is not None:
            self.largest[..., 1] = mass.amax(1)

    def sink(self, k: int):
        """Destination of the particles' contributions to sum ``k``."""
        return self._shares[k % 2]

    def source(self, k: int):
        """Struct of sum ``k`` for the kernels that read it."""
        return self._sums[k % len(self._sums)]

    def cleared(self, k: int) -> None:
        """None: reading a sum clears it."""

    def accumulate(
        self, buffers, k: int, states, mass: wp.array | None, launch: KernelLauncher, beside: bool = False
    ) -> None:
        """Accumulate the contributions of the particles of ``states`` in sum ``k``."""
        mass = self._none if mass is None else mass
        size = buffers.size
        arguments = (buffers.window, size.particles, states, self.sink(k), mass, self.source(k))
        launch(fixed(self.model.dim).push, size.threads, *arguments, block_dim=size.block)
