"""Contact of surface points in a chunk of the moving formulation, for every scheme: buffers and launches. Adjoint: carried_adj.py."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.carried.surface import point_types, surface
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import view
from softmpm.schemes.device import stream_of
from softmpm.schemes.inputs import Values, elapsed, grid_struct
from softmpm.schemes.launch import KernelLauncher
from softmpm.schemes.penetration import deepest
from softmpm.state import SurfaceState

POINT_BLOCK = 32
"""Threads per block: few points are spread over as many multiprocessors as possible."""


class Nodes(NamedTuple):
    """Arrays (world, node) of the nodes in a substep."""

    node: wp.array
    """Momentum and mass."""
    velocity: wp.array
    """Velocity, before and after contact."""
    load: wp.array
    """Sum of the areas of the points, each with its share; zero before :meth:`SurfaceContact.share`."""


def outline_struct(model: Model):
    """Struct of the constants of the surface points."""
    return model.workspace.get(outline_struct, lambda: _outline_struct(model))


def _outline_struct(model: Model):
    t, points = types(model.spec.dim, model.spec.dtype), model.surface
    assert points is not None
    struct = point_types(model.spec.dim, model.spec.dtype).Outline()
    struct.areas = view(points.areas.to(model.dtype), t.real)
    struct.newtons = view(points.areas.to(model.dtype) * model.mass_unit, t.real)
    struct.deepest = view(deepest(model).to(model.dtype), t.real)
    struct.stiffness = view(points.stiffness.to(model.dtype) / model.mass_unit, t.real)  # as the masses
    return struct


def stencils_struct(model: Model):
    """Struct on new buffers of what the nodes around each point are to it."""
    t, points = types(model.spec.dim, model.spec.dtype), (model.worlds, model.anchor_shape[2])

    def tensor(*size: int, dtype=model.dtype) -> Tensor:
        return torch.empty(*points, *size, dtype=dtype, device=model.device)

    struct = point_types(model.spec.dim, model.spec.dtype).Stencils()
    struct.base = view(tensor(t.dim, dtype=torch.int32), t.ivec)
    struct.shares, struct.weights = (view(tensor(3**t.dim), t.real) for _ in range(2))
    struct.velocity = view(tensor(t.dim), t.vec)
    return struct


class SurfaceContact:
    """Contact of the surface points with the separating walls, between the grid stage and G2P.

    Args:
        window: Struct of the nodes in memory.
        chunk: Substeps that it takes part in.
        keep: Whether all states are stored, for an adjoint.

    Attributes:
        x, anchor: Places and anchors of each stored state, shape (state, world, [wall,] point, dim); one, or one more than substeps.
        force: Mean forces in the control step so far [N], shape (world, wall, point, dim).
        rate: 1/T, T being the duration of a control step [1/s], shape (1,): calls whose chunks have one shape may differ in it.
    """

    def __init__(self, model: Model, window: Any, chunk: Chunk, keep: bool):
        self.model, self.window, self.chunk, self.keep = model, window, chunk, keep
        t, stored = types(model.spec.dim, model.spec.dtype), chunk.length + 1 if keep else 1
        self.kernels, self.outline, self.stencils = (
            surface(model.spec),
            outline_struct(model),
            stencils_struct(model),
        )
        self.width = model.contact_width * model.scene.grid.spacing
        self.points = (model.worlds, model.anchor_shape[2])

        def tensor(*size: int, dtype=model.dtype) -> Tensor:
            return torch.empty(size, dtype=dtype, device=model.device)

        self.x, self.anchor = (
            tensor(stored, *self.points, t.dim, dtype=torch.float64),
            tensor(stored, *model.anchor_shape),
        )
        self.force, self.rate = tensor(*model.anchor_shape), tensor(1)
        self.places = [view(one, types(t.dim, "float64").vec) for one in self.x]
        self.anchors = [view(one, t.vec) for one in self.anchor]
        self.force_array, self.rate_array = view(self.force, t.vec), view(self.rate, t.real)

    @property
    def bytes(self) -> int:
        """Bytes of the stored states."""
        return self.x.nbytes + self.anchor.nbytes

    def load(self, chunk: Chunk, start: SurfaceState) -> None:
        """Copy the initial state of a chunk of this shape into the buffers."""
        self.x[0].copy_(start.x.detach())
        self.anchor[0].copy_(start.anchor.detach())
        self.rate.fill_(1.0 / (chunk.substeps * self.model.scene.dt))
        if chunk.begins:
            self.force.zero_()
        else:
            self.force.copy_(start.force.detach())

    @property
    def end(self) -> SurfaceState:
        """The final state, in the buffers."""
        return SurfaceState(self.x[-1], self.anchor[-1], self.force)

    def stored(self, s: int) -> int:
        """Number of the stored state before substep ``s``."""
        return s if self.keep else 0

    def share(
        self,
        s: int,
        nodes: Nodes,
        last: wp.array | None,
        words: wp.array,
        launch: Callable[..., None],
    ) -> None:
        """Shares of the points in the nodes of substep ``s``.

        Args:
            last: Nodal velocities of the substep before, with which the points are carried first; None if they have been.
        """
        before, there = self.places[self.stored(s if last is None else s - 1)], self.places[self.stored(s)]
        parameters = (self.model.constants, self.window, self.outline, s, int(last is None), before)
        velocities = (nodes.velocity if last is None else last, nodes.node, nodes.velocity)
        arguments = (*parameters, *velocities, words, self.stencils, there, nodes.load)
        launch(self.kernels.share, self.points, *arguments, block_dim=POINT_BLOCK)

    def press(
        self,
        s: int,
        inputs: Any,
        nodes: Nodes,
        words: wp.array,
        launch: Callable[..., None],
        out: tuple[wp.array, wp.array] | None = None,
    ) -> None:
        """Add what the walls give to the velocity of the nodes; ``out`` receives forces and anchors instead of the state."""
        parameters = (self.model.constants, inputs, self.window, self.outline, self.width, s)
        about = (
            self.rate_array,
            self.chunk.anew(s),
            self.places[self.stored(s)],
            self.anchors[self.stored(s)],
        )
        force, anchor = (self.force_array, self.anchors[self.stored(s + 1)]) if out is None else out
        arguments = (*parameters, *about, nodes.load, words, self.stencils, force, anchor, nodes.velocity)
        launch(self.kernels.press, self.points, *arguments, block_dim=POINT_BLOCK)

    def carry(self, s: int, velocity: wp.array, launch: Callable[..., None]) -> None:
        """Carry the points with the velocity of the nodes after contact."""
        places = [self.places[self.stored(k)] for k in (s, s + 1)]
        arguments = (self.model.constants, self.window, places[0], velocity, self.stencils, places[1])
        launch(self.kernels.carry, self.points, *arguments, block_dim=POINT_BLOCK)

    def check_end(self, inputs: Any, words: wp.array, launch: Callable[..., None]) -> None:
        """Check the depth of the points in the final state, with the inputs of the last substep."""
        about = (self.model.scene.dt, self.chunk.length - 1, self.places[-1], words)
        arguments = (self.model.constants, inputs, self.outline, *about)
        launch(self.kernels.check_depth, self.points, *arguments, block_dim=POINT_BLOCK)


def check_start(model: Model, x: Tensor, values: Values, words: Tensor) -> None:
    """Check the depth of the points at ``x`` in the initial state of a call, with the inputs of its first substep."""
    known = model.fixed | values
    if model.spec.moving:
        known["elapsed"] = elapsed(model, 0, 1, 1)
    places = view(x.detach().contiguous(), types(model.spec.dim, "float64").vec)
    arguments = (model.constants, grid_struct(model, known), outline_struct(model), 0.0, 0, places)
    launch, kernel = KernelLauncher(model, stream_of(model.device)), surface(model.spec).check_depth
    launch(kernel, tuple(x.shape[:2]), *arguments, view(words, wp.int64), block_dim=POINT_BLOCK)
