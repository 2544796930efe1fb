"""Adjoint of the contact of surface points in the moving formulation (carried.py)."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.carried.surface_adj import surface_adj
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import view
from softmpm.schemes.carried import POINT_BLOCK, Nodes, SurfaceContact, lanes_of
from softmpm.state import SurfaceState


class SurfaceContactAdj:
    """Adjoint buffers of contact, for all chunks on a window, one after the other.

    Attributes:
        anchor, force: Adjoint of the state.
    """

    def __init__(self, model: Model, wanted: RequestedGrads, packed: bool):
        t = types(model.spec.dim, model.spec.dtype)
        single = lanes_of(model) >= 3**model.dim
        self.kernels = surface_adj(model.spec, wanted, packed, single)

        def tensor(*size: int) -> Tensor:
            return torch.empty(*size, dtype=model.dtype, device=model.device)

        self.anchor, self.force = tensor(*model.anchor_shape), tensor(*model.anchor_shape)
        self._anchor, self._force = view(self.anchor, t.vec), view(self.force, t.vec)
        self._scratch = None
        if not packed:  # the fast scheme has stored the impulses
            self._scratch = view(tensor(*model.anchor_shape), t.vec), view(tensor(*model.anchor_shape), t.vec)

    def load(self, adj_end: SurfaceState) -> None:
        """Copy the adjoint of the final state of a chunk into the buffers."""
        for own, given in zip((self.anchor, self.force), adj_end, strict=True):
            own.copy_(given)

    def press_again(
        self,
        forward: SurfaceContact,
        s: int,
        inputs: Any,
        now: Any,
        nodes: Nodes,
        words: wp.array,
        launch: Callable[..., None],
    ) -> None:
        """Recompute the nodal velocities of substep ``s`` from those without contact."""
        assert self._scratch is not None, "else forces and anchors of the forward pass would be overwritten"
        forward.press(s, inputs, now, nodes, words, launch, self._scratch)

    def press_adj(
        self,
        forward: SurfaceContact,
        s: int,
        inputs: Any,
        adj_inputs: Any,
        now: Any,
        nodes: Nodes,
        adj_velocity: wp.array,
        adj_load: wp.array,
        gained: wp.array,
        adj_now: Any,
        launch: Callable[..., None],
    ) -> None:
        """Adjoint of all but the loads, from that of the nodal velocities after contact; adds into the last three and ``adj_load``."""
        one = forward
        parameters = (one.model.constants, inputs, one.window, one.outline, one.width, one.rate_array)
        about = (one.chunk.anew(s), one.owner_array, now, one.anchors[one.stored(s)])
        arrays = (nodes.node, nodes.free, nodes.load, adj_velocity, self._force, self._anchor)
        arguments = (*parameters, *about, *arrays, adj_load, gained, adj_now, adj_inputs)
        launch(self.kernels.press_adj, one.threads, *arguments, block_dim=POINT_BLOCK)

    def add_loads_adj(
        self, forward: SurfaceContact, now: Any, adj_load: wp.array, adj_now: Any, launch: Callable[..., None]
    ) -> None:
        """Adjoint of the loads; adds into that of the particles."""
        one = forward
        arguments = (one.model.constants, one.window, one.outline, one.owner_array, now, adj_load, adj_now)
        launch(self.kernels.add_loads_adj, one.threads, *arguments, block_dim=POINT_BLOCK)

    def start(self, chunk: Chunk) -> SurfaceState:
        """Adjoint of the initial state of a chunk, in new tensors: the forces before a control step have none."""
        force = torch.zeros_like(self.force) if chunk.begins else self.force.clone()
        return SurfaceState(self.anchor.clone(), force)
