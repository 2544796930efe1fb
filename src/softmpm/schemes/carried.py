"""Contact of surface points in a chunk of the moving formulation, for every scheme: buffers and launches. Adjoint: carried_adj.py."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.carried.point import outline_type
from softmpm.kernels.carried.surface import start_depth, surface
from softmpm.kernels.physics.lanes import lanes_for
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import passing, view
from softmpm.schemes.inputs import Values, elapsed, grid_struct
from softmpm.schemes.launch import launcher
from softmpm.schemes.penetration import deepest
from softmpm.state import State, SurfaceState
from softmpm.surface_points import CarriedPoints

POINT_BLOCK = 64
"""Threads per block: two warps, so that few points are spread over many multiprocessors and many fill one."""
POINT_PART = 32
"""Points of a part of a launch on the CPU."""


class Nodes(NamedTuple):
    """Arrays (world, node) of the nodes in a substep."""

    node: wp.array
    """Momentum and mass."""
    free: wp.array
    """Velocity before contact."""
    velocity: wp.array
    """Velocity after contact; before :meth:`SurfaceContact.press` that before contact."""
    load: wp.array
    """Sum of the areas of the points, each with its share."""


def lanes_of(model: Model) -> int:
    """Threads that share the nodes of a point."""
    return lanes_for(model.dim, model.worlds * points_of(model).count, model.device)


def outline_struct(model: Model):
    """Struct of the constants of the surface points."""
    return model.workspace.get(outline_struct, lambda: _outline_struct(model))


def _outline_struct(model: Model):
    t, points = types(model.spec.dim, model.spec.dtype), points_of(model)
    struct = outline_type(model.spec.dim, model.spec.dtype)()
    struct.lanes = lanes_of(model)
    struct.arms = view(points.arms.to(model.dtype), t.vec)
    struct.areas = view(points.areas.to(model.dtype), t.real)
    struct.newtons = view(points.areas.to(model.dtype) * model.mass_unit, t.real)
    struct.deepest = view(deepest(model).to(model.dtype), t.real)
    struct.stiffness = view(points.stiffness.to(model.dtype) / model.mass_unit, t.real)  # as the masses
    return struct


def points_of(model: Model) -> CarriedPoints:
    """The surface points of a model of the moving formulation."""
    assert isinstance(model.surface, CarriedPoints)
    return model.surface


class SurfaceContact:
    """Contact of the surface points with the separating walls, between the grid stage and G2P.

    Args:
        window: Struct of the nodes in memory.
        chunk: Substeps that it takes part in.
        keep: Whether all states are stored, for an adjoint.
        packed: Whether particles are packed as in the fast scheme.

    Attributes:
        owner: Number of the particle of each point or, packed, its place in memory; shape (world, point), int32.
        anchor: Anchors of each stored state, shape (state, world, wall, point, dim); one, or one more than substeps.
        force: Mean forces in the control step so far [N], shape (world, wall, point, dim).
        impulse: Impulses of the walls on the points in each substep or, where an adjoint does not need them, in the last one,
            shape (substep, world, point, dim).
        rate: 1/T, T being the duration of a control step [1/s], shape (1,): calls whose chunks have one shape may differ in it.
    """

    def __init__(self, model: Model, window: Any, chunk: Chunk, keep: bool, packed: bool):
        self.model, self.window, self.chunk, self.keep, self.packed = model, window, chunk, keep, packed
        t, stored = types(model.spec.dim, model.spec.dtype), chunk.length + 1 if keep else 1
        self.kernels, self.outline = surface(model.spec, packed), outline_struct(model)
        self.width = model.contact_width * model.scene.grid.spacing
        self.points = (model.worlds, model.anchor_shape[2])
        self.threads = (*self.points, self.outline.lanes)

        def tensor(*size: int) -> Tensor:
            return torch.empty(size, dtype=model.dtype, device=model.device)

        pushes = chunk.length if keep and packed else 1
        self.impulse = tensor(pushes, *self.points, model.dim)
        self.impulses = [view(one, t.vec) for one in self.impulse]
        self.owner = points_of(model).nearest.int().expand(self.points).contiguous()
        self.anchor, self.force = tensor(stored, *model.anchor_shape), tensor(*model.anchor_shape)
        self.rate = tensor(1)
        self.anchors = [view(one, t.vec) for one in self.anchor]
        self.force_array, self.rate_array = view(self.force, t.vec), view(self.rate, t.real)
        self.owner_array = view(self.owner, wp.int32)

    @property
    def bytes(self) -> int:
        """Bytes of the stored states."""
        return self.anchor.nbytes + self.impulse.nbytes

    def reorder(self, order: Tensor) -> None:
        """Find the places of the points' particles in an order, shape (world, particle), int32."""
        worlds, count = order.shape
        here = torch.arange(worlds * count, dtype=order.dtype, device=order.device).view(worlds, count)
        places = torch.empty_like(order).scatter_(1, order.long(), here)
        self.owner.copy_(places[:, points_of(self.model).nearest])

    def load(self, chunk: Chunk, start: SurfaceState) -> None:
        """Copy the initial state of a chunk of this shape into the buffers."""
        self.anchor[0].copy_(start.anchor.detach())
        self.set_rate(chunk)
        if chunk.begins:
            self.force.zero_()
        else:
            self.force.copy_(start.force.detach())

    def set_rate(self, chunk: Chunk) -> None:
        """Set the duration of a control step, in which chunks of one shape may differ."""
        self.rate.fill_(1.0 / (chunk.substeps * self.model.scene.dt))

    @property
    def end(self) -> SurfaceState:
        """The final state, in the buffers."""
        return SurfaceState(self.anchor[-1], self.force)

    def stored(self, s: int) -> int:
        """Number of the stored state before substep ``s``."""
        return s if self.keep else 0

    def add_loads(self, now: Any, load: wp.array, launch: Callable[..., None]) -> None:
        """Add up the areas on the nodes, of points on the particles ``now``."""
        arguments = (self.model.constants, self.window, self.outline, self.owner_array, now, load)
        launch(self.kernels.add_loads, self.threads, *arguments, block_dim=POINT_BLOCK)

    def press(
        self,
        s: int,
        inputs: Any,
        now: Any,
        nodes: Nodes,
        words: wp.array,
        launch: Callable[..., None],
        out: tuple[wp.array, wp.array] | None = None,
        before: wp.array | None = None,
    ) -> None:
        """Add what the walls give to the velocity of the nodes. ``out`` receives forces and anchors instead of the state; ``before``
        has the words before this launch, if they are kept."""
        parameters = (self.model.constants, inputs, self.window, self.outline, self.width, s)
        before = words if before is None else before
        about = (
            self.rate_array,
            self.chunk.anew(s),
            self.owner_array,
            before,
            now,
            self.anchors[self.stored(s)],
        )
        force, anchor = (self.force_array, self.anchors[self.stored(s + 1)]) if out is None else out
        states = (words, force, anchor, self.impulses[s % len(self.impulses)], nodes.velocity)
        arguments = (*parameters, *about, nodes.node, nodes.free, nodes.load, *states)
        if self.packed and self.model.spec.slabs:
            launch(self.kernels.press, self.threads, *arguments, block_dim=POINT_BLOCK, part=POINT_PART)
            self.push(s, now, nodes.node, nodes.velocity, launch)
        else:
            launch(self.kernels.press, self.threads, *arguments, block_dim=POINT_BLOCK)

    def push(self, s: int, now: Any, node: wp.array, velocity: wp.array, launch: Callable[..., None]) -> None:
        """Add the impulses of substep ``s`` to the velocity of the nodes."""
        about = (self.model.constants, self.window, self.outline, self.owner_array, now)
        arguments = (*about, self.impulses[s % len(self.impulses)], node, velocity)
        launch(self.kernels.push_all, self.threads, *arguments, block_dim=POINT_BLOCK)

    def check_end(self, inputs: Any, now: Any, words: wp.array, launch: Callable[..., None]) -> None:
        """Check the depth of the points in the final state ``now``, with the inputs of the last substep."""
        about = (self.outline, self.model.scene.dt, self.chunk.length - 1, self.owner_array, now, words)
        arguments = (self.model.constants, inputs, self.window, *about)
        launch(self.kernels.check_end, self.points, *arguments, block_dim=POINT_BLOCK)


def contact_on_grid(model: Model, chunk: Chunk, keep: bool) -> SurfaceContact:
    """Contact of points on particles in the user's order, whose nodes are those of the whole grid."""
    t = types(model.spec.dim, model.spec.dtype)
    window = t.Window()
    window.shape, window.count = t.ivec(*model.scene.grid.shape), model.node_count
    origin = torch.zeros(model.worlds, model.dim, dtype=torch.int32, device=model.device)
    window.origin = view(origin, t.ivec)
    return SurfaceContact(model, window, chunk, keep, packed=False)


def check_start(model: Model, start: State, values: Values, words: Tensor) -> None:
    """Check the depth of the points in the initial state of a call, with the inputs of its first substep."""
    known, points = model.fixed | values, points_of(model)
    if model.spec.moving:
        known["elapsed"] = elapsed(model, 0, 1, 1)
    t, exact_vec = types(model.dim, model.spec.dtype), types(model.dim, "float64").vec
    low = start.low or (start.x.new_empty(0, 0, model.dim), start.x.new_empty(0, 0, model.dim, model.dim))
    given = [tensor.contiguous() for tensor in (start.x, start.F, *low)]
    where = passing(points.nearest, wp.int64), passing(points.arms, exact_vec)
    fields = (passing(one, kind) for one, kind in zip(given, (t.vec, t.mat) * 2, strict=True))
    arguments = (grid_struct(model, known), outline_struct(model), *where, *fields, passing(words, wp.int64))
    launch, kernel = launcher(model), start_depth(model.spec)
    launch(kernel, (model.worlds, points.count), *arguments, block_dim=POINT_BLOCK)
