"""Contact of surface points in a chunk of the reference formulation: its buffers and launches."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.lagrangian.surface import surface, surface_type
from softmpm.kernels.lagrangian.surface_adj import surface_adj
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import view
from softmpm.schemes.penetration import deepest


def surface_struct(model: Model):
    """Struct on the surface points."""
    t, points = types(model.spec.dim, model.spec.dtype), model.surface
    assert points is not None
    struct = surface_type(model.spec.dim, model.spec.dtype)()
    struct.points = view(points.points, types(model.spec.dim, "float64").vec)
    for name in ("areas", "loads", "weights"):
        setattr(struct, name, view(getattr(points, name).to(model.dtype), t.real))
    struct.stiffness = view(points.stiffness.to(model.dtype) / model.mass_unit, t.real)  # as the masses
    struct.newtons = view(points.areas.to(model.dtype) * model.mass_unit, t.real)
    struct.deepest = view(deepest(model).to(model.dtype), t.real)
    for name in ("stencil", "first", "members"):
        setattr(struct, name, view(getattr(points, name), wp.int32))
    return struct


class SurfaceContact:
    """Contact of the surface points with the separating walls, from the velocity without it to the new state.

    Args:
        chunk: Substeps that it takes part in.
        mass: Masses of the nodes, shape (world, node).
        anchors: Anchors of each stored state, shape (state, world, wall, point, dim).
        force: Mean forces in the control step so far [N], shape (world, wall, point, dim); updated in place.
        launch: Launches a kernel.

    Attributes:
        free: Nodal velocities without contact.
        rate: 1/T, T being the duration of a control step [1/s].
    """

    def __init__(
        self,
        model: Model,
        chunk: Chunk,
        mass: Tensor,
        anchors: Tensor,
        force: Tensor,
        launch: Callable[..., None],
    ):
        self.model, self.chunk, self._launch, self.anchors = model, chunk, launch, anchors
        self.rate = 1.0 / (chunk.substeps * model.scene.dt)
        self.nodes, self.points = tuple(mass.shape), (model.worlds, anchors.shape[3])
        self._vec, self._real = (
            getattr(types(model.spec.dim, model.spec.dtype), name) for name in ("vec", "real")
        )
        self._struct, self._mass = surface_struct(model), view(mass, self._real)
        self._force = view(force, self._vec)
        self._width = model.contact_width * model.scene.grid.spacing
        self.free = self._vectors(self.nodes)
        self._impulse = self._vectors(self.points)
        self._D = view(torch.empty(self.points, dtype=model.dtype, device=model.device), self._real)
        launch(surface(model.spec).delassus, self.points, self._struct, self._mass, self._D)

    def _vectors(self, lead: tuple[int, ...]) -> wp.array:
        model = self.model
        return view(torch.empty(*lead, model.dim, dtype=model.dtype, device=model.device), self._vec)

    def begins(self, s: int) -> bool:
        """True if a control step begins with substep ``s`` of the chunk."""
        return (self.chunk.first + s) % self.chunk.substeps == 0

    def advance(self, s: int, inputs: Any, words: wp.array, now: int, then: int, u, v, new_u, new_v) -> None:
        """Substep ``s``, from :attr:`free` and the state before to that after; ``now`` and ``then`` count their anchors."""
        model, kernels = self.model, surface(self.model.spec)
        anchors = [view(self.anchors[k], self._vec) for k in (now, then)]
        about = (s, self.rate, int(self.begins(s)))
        parameters = (model.constants, inputs, self._struct, self._width, self._D, *about)
        arguments = (u, self.free, anchors[0], words, self._force, self._impulse, anchors[1])
        self._launch(kernels.press, self.points, *parameters, *arguments)
        parameters = (model.constants, self._struct, self._mass, self._impulse, words)
        self._launch(kernels.settle, self.nodes, *parameters, u, v, self.free, new_u, new_v)

    def check_end(self, inputs: Any, u: wp.array, words: wp.array) -> None:
        """Check the depth of the points in the state after the last substep, whose inputs are given."""
        kernel, about = surface(self.model.spec).check_depth, (self.model.scene.dt, self.chunk.length - 1)
        parameters = (self.model.constants, inputs, self._struct, *about)
        self._launch(kernel, self.points, *parameters, u, words)


def check_start(model: Model, inputs: Any, u: wp.array, words: wp.array, launch: Callable[..., None]) -> None:
    """Check the depth of the points in the initial state of a call, with the inputs of its first substep."""
    points = (model.worlds, model.anchor_shape[2])
    arguments = (model.constants, inputs, surface_struct(model), 0.0, 0, u, words)
    launch(surface(model.spec).check_depth, points, *arguments)


class SurfaceContactAdj:
    """Adjoint of :class:`SurfaceContact`.

    Args:
        held: Accumulators of one world in the structs of the inputs' adjoints.
        adj_anchor, adj_force: Adjoints of the anchors and of the mean forces, updated in place.
        adj_mass: Adjoint of the masses of the nodes, added into.
    """

    def __init__(
        self,
        forward: SurfaceContact,
        wanted: RequestedGrads,
        held: int,
        adj_anchor: Tensor,
        adj_force: Tensor,
        adj_mass: wp.array,
    ):
        self.forward, self.held, self._adj_mass = forward, held, adj_mass
        self._kernels = surface_adj(forward.model.spec, wanted)
        self._adj_anchor, self._adj_force = view(adj_anchor, forward._vec), adj_force
        self._shared = forward._vectors(forward.nodes)
        self._adj_x, self._adj_free = forward._vectors(forward.points), forward._vectors(forward.points)
        model = forward.model
        zeros = torch.zeros(forward.points, dtype=model.dtype, device=model.device)
        self._adj_D = view(zeros, forward._real)

    def advance(self, s: int, inputs: Any, adj_inputs: Any, rest: Any, u, p, new_v, adj_u, adj_v) -> None:
        """Adjoint of substep ``s``, from that of the new state to that of the velocity without contact, in ``adj_v``."""
        one, launch = self.forward, self.forward._launch
        constants, adj_points = one.model.constants, (self._adj_x, self._adj_free)
        arguments = (u, p, new_v, adj_u, adj_v, one.free, self._shared, self._adj_mass)
        launch(self._kernels.settle_adj, one.nodes, constants, inputs, rest, one._mass, *arguments)
        parameters = (constants, inputs, one._struct, one._width, one._D, self.held, one.rate)
        anchors, adj_force = view(one.anchors[s], one._vec), view(self._adj_force, one._vec)
        arguments = (u, one.free, anchors, self._shared, adj_force, self._adj_anchor)
        out = (*adj_points, self._adj_D, adj_inputs)
        launch(self._kernels.press_adj, one.points, *parameters, *arguments, *out)
        launch(self._kernels.spread_adj, one.nodes, one._struct, *adj_points, adj_u, adj_v)
        if one.begins(s):  # the mean is taken anew
            self._adj_force.zero_()

    def finish(self) -> None:
        """Add what the mobility D of all substeps gives to the masses."""
        one = self.forward
        arguments = (one._struct, one._mass, self._adj_D, self._adj_mass)
        one._launch(self._kernels.delassus_adj, one.nodes, *arguments)
