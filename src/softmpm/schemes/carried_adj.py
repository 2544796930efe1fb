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
from softmpm.schemes.carried import POINT_BLOCK, Nodes, SurfaceContact, stencils_struct
from softmpm.state import SurfaceState


class SurfaceContactAdj:
    """Adjoint buffers of contact, for all chunks on a window, one after the other.

    Args:
        count: Nodes of one world in memory.

    Attributes:
        x, anchor, force: Adjoint of the state.
    """

    def __init__(self, model: Model, wanted: RequestedGrads, count: int):
        t, nodes = types(model.spec.dim, model.spec.dtype), (model.worlds, count)
        self.kernels = surface_adj(model.spec, wanted)

        def tensor(*size: int) -> Tensor:
            return torch.empty(size, dtype=model.dtype, device=model.device)

        self.x, self.anchor = tensor(model.worlds, model.anchor_shape[2], t.dim), tensor(*model.anchor_shape)
        self.force = torch.empty_like(self.anchor)
        self._x, self._anchor, self._force = (view(one, t.vec) for one in (self.x, self.anchor, self.force))
        self._free, self._load = view(tensor(*nodes, t.dim), t.vec), view(tensor(*nodes), t.real)
        self._stencils, scratch = stencils_struct(model), tensor(2, *model.anchor_shape)
        self._scratch = view(scratch[0], t.vec), view(scratch[1], t.vec)

    def load(self, adj_end: SurfaceState) -> None:
        """Copy the adjoint of the final state of a chunk into the buffers."""
        for own, given in zip((self.x, self.anchor, self.force), adj_end, strict=True):
            own.copy_(given)

    def again(
        self,
        forward: SurfaceContact,
        s: int,
        inputs: Any,
        nodes: Nodes,
        adj_velocity: wp.array,
        words: wp.array,
        launch: Callable[..., None],
    ) -> None:
        """Recompute the nodal velocities of substep ``s`` from those without contact; add what moves the points to their adjoint."""
        one, place = forward, forward.places[forward.stored(s)]
        parameters = (one.model.constants, one.window, one.outline, s, place, nodes.node, nodes.velocity)
        out = (self._x, words, one.stencils, self._free, self._load, nodes.load, adj_velocity)
        launch(self.kernels.share_again, one.points, *parameters, *out, block_dim=POINT_BLOCK)
        one.press(s, inputs, nodes, words, launch, self._scratch)

    def respond(
        self,
        forward: SurfaceContact,
        s: int,
        inputs: Any,
        adj_inputs: Any,
        nodes: Nodes,
        adj_velocity: wp.array,
        adj_mass: wp.array,
        launch: Callable[..., None],
    ) -> None:
        """Turn the adjoint of the nodal velocities after contact, now complete, into that before; adds into the other adjoints."""
        one, constants, k = forward, forward.model.constants, forward.stored(s)
        parameters = (inputs, one.window, one.outline, one.width, one.rate_array, one.chunk.anew(s))
        arrays = (one.places[k], one.anchors[k], nodes.node, nodes.velocity, self._free, nodes.load)
        state = (one.stencils, adj_velocity, self._force, self._anchor, self._x, self._stencils)
        arguments = (*parameters, *arrays, *state, self._load, adj_mass, adj_inputs)
        launch(self.kernels.press_adj, one.points, constants, *arguments, block_dim=POINT_BLOCK)
        arrays = (one.places[k], nodes.node, one.stencils, self._stencils, self._load)
        arguments = (one.window, one.outline, *arrays, self._x, adj_velocity, adj_mass)
        launch(self.kernels.share_adj, one.points, constants, *arguments, block_dim=POINT_BLOCK)

    def start(self, chunk: Chunk) -> SurfaceState:
        """Adjoint of the initial state of a chunk, in new tensors: the forces before a control step have none."""
        force = torch.zeros_like(self.force) if chunk.begins else self.force.clone()
        return SurfaceState(self.x.to(torch.float64, copy=True), self.anchor.clone(), force)
