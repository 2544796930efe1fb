"""Contact of surface points in a chunk of the reference formulation: its buffers and launches."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.lagrangian.surface import LANES, surface, surface_type
from softmpm.kernels.lagrangian.surface_adj import surface_adj
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import clear, view
from softmpm.schemes.lagrangian.bricks import NODE_PART
from softmpm.schemes.lagrangian.driven import drive
from softmpm.schemes.lagrangian.frame import frame_struct
from softmpm.schemes.penetration import deepest
from softmpm.surface_grid import SurfaceGrid

POINT_PART = 64
"""Surface points in each of the parts into which a CPU divides a launch."""


def surface_struct(model: Model):
    """Struct on the surface points."""
    t, points = types(model.spec.dim, model.spec.dtype), model.surface
    assert isinstance(points, SurfaceGrid)
    struct = surface_type(model.spec.dim, model.spec.dtype)()
    struct.points = view(points.points, types(model.spec.dim, "float64").vec)
    areas, limit = points.areas, deepest(model)
    if model.driven_grid is not None:  # points of driven nodes only get no force, whatever their depth
        free = points.carried(~model.driven_grid.held)
        areas, limit = areas * free, torch.where(free, limit, torch.inf)
    struct.areas = view(areas.to(model.dtype), t.real)
    for name in ("loads", "weights", "shares"):
        setattr(struct, name, view(getattr(points, name).to(model.dtype), t.real))
    struct.stiffness = view(points.stiffness.to(model.dtype) / model.mass_unit, t.real)  # as the masses
    struct.newtons = view(areas.to(model.dtype) * model.mass_unit, t.real)
    struct.deepest = view(limit.to(model.dtype), t.real)
    for name in ("stencil", "nodes", "first", "members"):
        setattr(struct, name, view(getattr(points, name), wp.int32))
    return struct


class SurfaceContact:
    """Contact of the surface points with the separating walls, from the velocity without it to the new state.

    Args:
        chunk: Substeps that it takes part in.
        mass: Masses of the nodes, shape (world, node).
        anchors: Anchors of each stored state, shape (state, world, wall, point, dim).
        shifts: Translation of each stored state, shape (state, world, dim).
        force: Mean forces in the control step so far [N], shape (world, wall, point, dim); updated in place.

    Attributes:
        free: Nodal velocities without contact.
        rate: 1/T, T being the duration of a control step [1/s], shape (1,): calls whose chunks have one shape may differ in it.
    """

    def __init__(
        self,
        model: Model,
        chunk: Chunk,
        mass: Tensor,
        anchors: Tensor,
        shifts: Tensor,
        force: Tensor,
    ):
        self.model, self.chunk, self.anchors = model, chunk, anchors
        self._frame, exact = frame_struct(model), types(model.spec.dim, "float64").vec
        self.shifts = [view(one, exact) for one in shifts]
        self.rate = torch.empty(1, dtype=model.dtype, device=model.device)
        self.nodes, self.points = tuple(mass.shape), (model.worlds, anchors.shape[3])
        assert isinstance(model.surface, SurfaceGrid)
        self.lanes = LANES[model.dim] if model.device.type == "cuda" else 1
        self.touched = (model.worlds, len(model.surface.nodes), self.lanes)
        self._vec, self._real = (
            getattr(types(model.spec.dim, model.spec.dtype), name) for name in ("vec", "real")
        )
        self.struct, self._mass = surface_struct(model), view(mass, self._real)
        self._force, self.rate_array = view(force, self._vec), view(self.rate, self._real)
        self.width = model.contact_width * model.scene.grid.spacing
        self.free = self._vectors(self.nodes)
        self.impulse = self._vectors(self.points)
        self.D = view(torch.empty(self.points, dtype=model.dtype, device=model.device), self._real)

    def _vectors(self, lead: tuple[int, ...]) -> wp.array:
        model = self.model
        return view(torch.empty(*lead, model.dim, dtype=model.dtype, device=model.device), self._vec)

    def begin(self, launch: Callable[..., None]) -> None:
        """Launch what depends on the masses only."""
        launch(
            surface(self.model.spec).delassus, self.points, self.struct, self._mass, self.D, part=POINT_PART
        )

    def advance(
        self,
        launch: Callable[..., None],
        s: int,
        inputs: Any,
        words: wp.array,
        now: int,
        then: int,
        u: wp.array,
        v: wp.array,
        new_u: wp.array,
        new_v: wp.array,
    ) -> None:
        """Substep ``s``, from :attr:`free` and the state before to that after; ``now`` and ``then`` count their anchors."""
        model, kernels = self.model, surface(self.model.spec)
        anchors = [view(self.anchors[k], self._vec) for k in (now, then)]
        about = (s, self.rate_array, self.chunk.anew(s))
        parameters = (model.constants, inputs, self.struct, self._frame, self.width, self.D, *about)
        arguments = (
            self.shifts[now],
            u,
            self.free,
            anchors[0],
            words,
            self._force,
            self.impulse,
            anchors[1],
        )
        launch(kernels.press, self.points, *parameters, *arguments, part=POINT_PART)
        about = (self.struct, self._frame, self._mass, self.lanes, self.impulse, words)
        arguments = (u, v, self.free, new_u, new_v)
        launch(kernels.settle, self.touched, model.constants, *about, *arguments, part=NODE_PART)

    def check_end(
        self, launch: Callable[..., None], inputs: Any, s: int, end: int, u: wp.array, words: wp.array
    ) -> None:
        """Check the depth of the points in state ``end`` after substep ``s``, whose inputs are given."""
        kernel, about = surface(self.model.spec).check_depth, (self.model.scene.dt, s)
        parameters = (self.model.constants, inputs, self.struct, *about)
        launch(kernel, self.points, *parameters, self.shifts[end], u, words, part=POINT_PART)


def check_start(
    model: Model, launch: Callable[..., None], inputs: Any, shift: wp.array, u: wp.array, words: wp.array
) -> None:
    """Check the depth of the points in the initial state of a call, with the inputs of its first substep."""
    points = (model.worlds, model.anchor_shape[2])
    arguments = (model.constants, inputs, surface_struct(model), 0.0, 0, shift, u, words)
    launch(surface(model.spec).check_depth, points, *arguments, part=POINT_PART)


class SurfaceContactAdj:
    """Adjoint of :class:`SurfaceContact`.

    Args:
        held: Accumulators of one world in the structs of the inputs' adjoints.
        adj_anchor, adj_force: Adjoints of the anchors and of the mean forces, updated in place.
        adj_mass: Adjoint of the masses of the nodes, added into.
        words: Status words, all of them of worlds that run.
    """

    def __init__(
        self,
        forward: SurfaceContact,
        wanted: RequestedGrads,
        held: int,
        adj_anchor: Tensor,
        adj_force: Tensor,
        adj_mass: wp.array,
        words: wp.array,
    ):
        self.forward, self.held, self._adj_mass = forward, held, adj_mass
        self._kernels = surface_adj(forward.model.spec, wanted)
        self.adj_anchor, self.adj_force = view(adj_anchor, forward._vec), view(adj_force, forward._vec)
        self.shared, self._words = forward._vectors(forward.nodes), words
        self._scratch = forward._vectors(forward.nodes) if forward.model.driven_grid else self.shared
        self.adj_x, self.adj_free = forward._vectors(forward.points), forward._vectors(forward.points)
        model = forward.model
        self._total_D = torch.empty(forward.points, dtype=model.dtype, device=model.device)
        self.adj_D = view(self._total_D, forward._real)

    def clear(self) -> None:
        """Set all sums to zero."""
        clear(self._total_D)

    def advance(
        self,
        launch: Callable[..., None],
        s: int,
        inputs: Any,
        adj_inputs: Any,
        rest: Any,
        stored: tuple[wp.array, ...],
        new_v: wp.array,
        pending: tuple[bool, wp.array, wp.array],
        adj_u: wp.array,
        adj_v: wp.array,
        adj_f: wp.array,
    ) -> None:
        """Adjoint of substep ``s``, from that of the new state to those of the forces and of the state before; with constraints of
        nodes to that of the velocity without contact, in ``adj_v``.

        Args:
            stored: Displacements, velocities and momenta of the nodes.
            pending: See :mod:`softmpm.kernels.lagrangian.nodes`.
        """
        one, shift = self.forward, self.forward.shifts[s]
        constants, adj_points = one.model.constants, (self.adj_x, self.adj_free)
        out = (self._adj_mass, adj_inputs)
        parameters = (constants, inputs, rest, one._mass, self.held, shift, *stored, new_v, *pending)
        arguments = (adj_u, adj_v, one.free, self.shared, adj_f, *out)
        launch(self._kernels.settle_adj, one.nodes, *parameters, *arguments, part=NODE_PART)
        drive(one.model, launch, inputs, self._words, stored[0], self._scratch, one.free)
        about = (self.held, one.rate_array, one.chunk.anew(s))
        parameters = (constants, inputs, one.struct, one.width, one.D, *about)
        anchors = view(one.anchors[s], one._vec)
        arguments = (shift, stored[0], one.free, anchors, self.shared, self.adj_force, self.adj_anchor)
        arguments = (*arguments, *adj_points, self.adj_D, adj_inputs)
        launch(self._kernels.press_adj, one.points, *parameters, *arguments, part=POINT_PART)
        parameters = (constants, inputs, rest, one.struct, one._mass, self.held, one.lanes, shift, *stored)
        arguments = (*adj_points, adj_u, adj_v, adj_f, *out)
        launch(self._kernels.spread_adj, one.touched, *parameters, *arguments, part=NODE_PART)

    def finish(self, launch: Callable[..., None]) -> None:
        """Add what the mobility D of all substeps gives to the masses."""
        one = self.forward
        arguments = (one.struct, one._mass, self.adj_D, self._adj_mass)
        launch(self._kernels.delassus_adj, one.touched[:2], *arguments, part=NODE_PART)
