"""Contact of surface points in a chunk of the reference formulation: its buffers and launches."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.lagrangian.portions import PORTION
from softmpm.kernels.lagrangian.surface import surface
from softmpm.kernels.lagrangian.surface_adj import surface_adj
from softmpm.kernels.lagrangian.surface_sums import LANES, surface_type
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import clear, view
from softmpm.schemes.lagrangian.bricks import NODE_PART, portions
from softmpm.schemes.lagrangian.driven import drive
from softmpm.schemes.lagrangian.frame import frame_struct
from softmpm.schemes.penetration import deepest
from softmpm.surface_grid import SurfaceGrid

POINT_PART = 64
"""Surface points in each of the parts into which a CPU divides a launch."""


def surface_struct(model: Model):
    """Struct on the surface points."""
    return model.workspace.get(surface_struct, lambda: _surface_struct(model))


def _surface_struct(model: Model):
    t, points = types(model.spec.dim, model.spec.dtype), model.surface
    assert isinstance(points, SurfaceGrid)
    struct = surface_type(model.spec.dim, model.spec.dtype)()
    struct.points = view(points.points, types(model.spec.dim, "float64").vec)
    areas, limit = points.areas, deepest(model)
    if model.driven_grid is not None:  # points of driven nodes only get no force, whatever their depth
        free = points.carried(~model.driven_grid.held)
        areas, limit = areas * free, torch.where(free, limit, torch.inf)
    struct.areas = view(areas.to(model.dtype), t.real)
    for name in ("loads", "shares"):
        setattr(struct, name, view(getattr(points, name).to(model.dtype), t.real))
    stencil, weights = points.stencil.contiguous().T, points.weights.to(model.dtype).contiguous().T
    if model.device.type == "cuda":
        stencil, weights = stencil.contiguous(), weights.contiguous()
    struct.stencil, struct.weights = view(stencil, wp.int32), view(weights, t.real)
    struct.width = model.contact_width * model.scene.grid.spacing
    struct.lanes = LANES if model.device.type == "cuda" else 1
    struct.stiffness = view(points.stiffness.to(model.dtype) / model.mass_unit, t.real)  # as the masses
    struct.newtons = view(areas.to(model.dtype) * model.mass_unit, t.real)
    struct.deepest = view(limit.to(model.dtype), t.real)
    for name in ("nodes", "first", "members"):
        setattr(struct, name, view(getattr(points, name), wp.int32))
    return struct


class SurfaceContact:
    """Contact of the surface points with the separating walls, from the velocity without it to the new state.

    Attributes:
        struct: Struct on the surface points.
        free: Nodal velocities without contact.
        rate: 1/T, T being the duration of a control step [1/s], shape (1,): calls whose chunks have one shape may differ in it.
        impulse, D: Impulse and mobility of each point.
    """

    def __init__(self, model: Model, chunk: Chunk):
        self.model, self.chunk, self._frame = model, chunk, frame_struct(model)
        assert isinstance(model.surface, SurfaceGrid)
        self.struct, self.nodes = surface_struct(model), (model.worlds, model.rest_grid.count)
        self.points = (model.worlds, model.anchor_shape[2])
        self.touched = (model.worlds, len(model.surface.nodes), self.struct.lanes)
        self.rate, D = self.tensor(1), self.tensor(*self.points)
        self.free, self.impulse = self.vectors(self.nodes), self.vectors(self.points)
        self.D, self.rate_array = (
            view(one, types(model.spec.dim, model.spec.dtype).real) for one in (D, self.rate)
        )

    def tensor(self, *shape: int) -> Tensor:
        return torch.empty(shape, dtype=self.model.dtype, device=self.model.device)

    def vectors(self, lead: tuple[int, ...]) -> wp.array:
        return view(self.tensor(*lead, self.model.dim), types(self.model.spec.dim, self.model.spec.dtype).vec)

    def add_to(self, at: Any) -> None:
        """Set the fields of contact in the struct of the chunk's memory."""
        at.rate, at.D, at.free, at.impulse = self.rate_array, self.D, self.free, self.impulse

    def begin(self, launch: Callable[..., None], at: Any) -> None:
        """Launch what depends on the masses only."""
        launch(surface(self.model.spec).delassus, self.points, self.struct, at.mass, at.D, part=POINT_PART)

    def advance(self, launch: Callable[..., None], inputs: Any, at: Any, s: int) -> None:
        """Substep ``s``, from the velocities without contact and the state before to that after."""
        constants, kernels = self.model.constants, surface(self.model.spec)
        arguments = (constants, inputs, self.struct, self._frame, at, s, self.chunk.anew(s))
        launch(kernels.press, self.in_portions(self.points), *arguments, part=POINT_PART // PORTION)
        arguments = (constants, self.struct, self._frame, at, s)
        launch(kernels.settle, self.in_portions(self.touched), *arguments, part=NODE_PART // PORTION)

    def in_portions(self, dim: tuple[int, ...]) -> tuple[int, ...]:
        """Dimensions of a launch whose threads have portions of the points or nodes."""
        return dim[0], portions(self.model, dim[1]), *dim[2:]

    def check_end(
        self, launch: Callable[..., None], inputs: Any, s: int, shift: wp.array, u: wp.array, words: wp.array
    ) -> None:
        """Check the depth of the points in the state after substep ``s``, whose inputs are given."""
        arguments = (inputs, self.struct, self.model.scene.dt, s, shift, u, words)
        launch(surface(self.model.spec).check_depth, self.points, *arguments, part=POINT_PART)


def check_start(
    model: Model, launch: Callable[..., None], inputs: Any, shift: wp.array, u: wp.array, words: wp.array
) -> None:
    """Check the depth of the points in the initial state of a call, with the inputs of its first substep."""
    points = (model.worlds, model.anchor_shape[2])
    arguments = (inputs, surface_struct(model), 0.0, 0, shift, u, words)
    launch(surface(model.spec).check_depth, points, *arguments, part=POINT_PART)


class SurfaceBuffersAdj:
    """Buffers of the adjoint of contact, which all chunks share.

    Attributes:
        scratch: Nodal velocities that nobody reads.
    """

    def __init__(self, forward: SurfaceContact):
        self._shared = forward.vectors(forward.nodes)
        self.scratch = forward.vectors(forward.nodes) if forward.model.driven_grid else self._shared
        self._x, self._free = forward.vectors(forward.points), forward.vectors(forward.points)
        self._D = forward.tensor(*forward.points)
        self._D_array = view(self._D, types(forward.model.spec.dim, forward.model.spec.dtype).real)

    def add_to(self, bar: Any) -> None:
        """Set the fields of contact in the struct of the adjoints, except for those of the state."""
        bar.shared, bar.x, bar.free, bar.D = self._shared, self._x, self._free, self._D_array

    def clear(self) -> None:
        """Set all sums to zero."""
        clear(self._D)


class SurfaceContactAdj:
    """Adjoint of :class:`SurfaceContact`."""

    def __init__(self, forward: SurfaceContact, buffers: SurfaceBuffersAdj, wanted: RequestedGrads):
        self.forward, self.buffers = forward, buffers
        self._kernels = surface_adj(forward.model.spec, wanted)

    def advance(
        self,
        launch: Callable[..., None],
        inputs: Any,
        rest: Any,
        at: Any,
        bar: Any,
        adj_inputs: Any,
        s: int,
        u: wp.array,
    ) -> None:
        """Adjoint of substep ``s``, from that of the new state to those of the forces and of the state before; with constraints of
        nodes to that of the velocity without contact, in v̄. ``u`` are the displacements before the substep."""
        one = self.forward
        constants, out = one.model.constants, (at, bar, adj_inputs, s)
        dim, part = one.in_portions(one.nodes), NODE_PART // PORTION
        launch(self._kernels.settle_adj, dim, constants, inputs, rest, *out, part=part)
        drive(one.model, launch, inputs, at.words, u, self.buffers.scratch, one.free)
        arguments = (constants, inputs, one.struct, *out, one.chunk.anew(s))
        dim = one.in_portions(one.points)
        launch(self._kernels.press_adj, dim, *arguments, part=POINT_PART // PORTION)
        arguments = (constants, inputs, rest, one.struct, *out)
        launch(self._kernels.spread_adj, one.in_portions(one.touched), *arguments, part=part)

    def finish(self, launch: Callable[..., None], at: Any, bar: Any) -> None:
        """Add what the mobility D of all substeps gives to the masses."""
        one = self.forward
        arguments = (one.struct, at.mass, bar.D, bar.mass)
        launch(self._kernels.delassus_adj, one.touched[:2], *arguments, part=NODE_PART)
