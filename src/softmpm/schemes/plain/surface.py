"""Contact of surface points in a chunk of the plain scheme: its buffers and launches."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.plain.surface import outline_type, surface
from softmpm.kernels.plain.surface_adj import surface_adj
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import clear, view
from softmpm.schemes.device import stream_of
from softmpm.schemes.penetration import deepest
from softmpm.state import SurfaceState


def outline_struct(model: Model):
    """Struct of the constants of the surface points."""
    t, points = types(model.spec.dim, model.spec.dtype), model.surface
    assert points is not None
    struct = outline_type(model.spec.dim, model.spec.dtype)()
    struct.areas = view(points.areas.to(model.dtype), t.real)
    struct.newtons = view(points.areas.to(model.dtype) * model.mass_unit, t.real)
    struct.deepest = view(deepest(model).to(model.dtype), t.real)
    struct.stiffness = view(points.stiffness.to(model.dtype) / model.mass_unit, t.real)  # as the masses
    return struct


class SurfaceContact:
    """Contact of the surface points with the separating walls, between the grid stage and G2P.

    Args:
        chunk: Substeps that it takes part in.
        keep: Whether all states are stored, for an adjoint.
        launch: Launches a kernel with its size and its arguments.

    Attributes:
        x, anchor: Places and anchors of each stored state, shape (state, world, [wall,] point, dim).
        force: Mean forces in the control step so far [N], shape (world, wall, point, dim).
    """

    def __init__(
        self,
        model: Model,
        chunk: Chunk,
        keep: bool,
        ordered: bool,
        start: SurfaceState,
        launch: Callable[..., None],
    ):
        self.model, self.chunk, self.keep, self.ordered, self.launch = model, chunk, keep, ordered, launch
        self.stream = stream_of(model.device)
        t, dim, exact = types(model.spec.dim, model.spec.dtype), model.dim, torch.float64
        self.types, self.exact_vec = t, types(model.spec.dim, "float64").vec
        self.kernels, self.outline = surface(model.spec, ordered), outline_struct(model)
        self.width = model.contact_width * model.scene.grid.spacing
        self.rate = 1.0 / (chunk.substeps * model.scene.dt)
        self.points, stored = (model.worlds, model.anchor_shape[2]), chunk.length + 1 if keep else 2
        self.x = torch.empty(stored, *self.points, dim, dtype=exact, device=model.device)
        self.anchor = self.tensor(stored, *model.anchor_shape)
        self.x[0], self.anchor[0] = start.x.detach(), start.anchor.detach()
        begins = chunk.first % chunk.substeps == 0
        self.force = torch.zeros_like(self.anchor[0]) if begins else start.force.detach().clone()
        self.load = self.tensor(model.worlds, model.node_count)
        self.base = view(torch.empty(*self.points, dim, dtype=torch.int32, device=model.device), t.ivec)
        self.shares = view(self.tensor(*self.points, 3**dim), t.real)
        self.free = view(self.tensor(model.worlds, model.node_count, dim), t.vec)
        self.scratch = self.tensor(2, *model.anchor_shape)

    def tensor(self, *shape: int) -> Tensor:
        return torch.empty(shape, dtype=self.model.dtype, device=self.model.device)

    def index(self, s: int) -> int:
        """Number of the stored state before substep ``s``."""
        return s if self.keep else s % 2

    def places(self, s: int) -> wp.array:
        """Places before substep ``s``."""
        return view(self.x[self.index(s)], self.exact_vec)

    def anchors(self, s: int) -> wp.array:
        """Anchors before substep ``s``."""
        return view(self.anchor[self.index(s)], self.types.vec)

    def anew(self, s: int) -> int:
        """1 if a control step begins with substep ``s``, but the first one, where the mean forces are zero."""
        return int(s in self.chunk.shape[1])

    def respond(
        self, s: int, inputs: Any, node: wp.array, velocity: wp.array, words: wp.array, again: bool = False
    ) -> None:
        """Add what the walls give to the velocity of the nodes in substep ``s``; ``again`` changes neither anchors nor forces."""
        constants, vec = self.model.constants, self.types.vec
        load = view(self.load, self.types.real)
        clear(self.load)
        wp.copy(self.free, velocity, stream=self.stream)
        arguments = (self.places(s), node, words, self.base, self.shares, load)
        self.launch(self.kernels.share, self.points, constants, self.outline, s, *arguments)
        about = (self.width, s, self.rate, self.anew(s))
        arrays = (self.places(s), self.anchors(s), node, self.free, self.base, self.shares, load, words)
        out = [
            view(one, vec)
            for one in (self.scratch if again else (self.force, self.anchor[self.index(s + 1)]))
        ]
        self.launch(
            self.kernels.press, self.points, constants, inputs, self.outline, *about, *arrays, *out, velocity
        )

    def advance(self, s: int, node: wp.array, velocity: wp.array, words: wp.array) -> None:
        """Carry the points with the velocity of the nodes after contact."""
        arrays = (words, self.places(s), node, velocity, self.base, self.shares, self.places(s + 1))
        self.launch(self.kernels.advance, self.points, self.model.constants, *arrays)

    def check_end(self, inputs: Any, words: wp.array) -> None:
        """Check the depth of the points in the final state, with the inputs of the last substep."""
        length = self.chunk.length
        about = (self.model.scene.dt, length - 1, self.places(length), words)
        self.launch(self.kernels.check_depth, self.points, self.model.constants, inputs, self.outline, *about)

    def end(self) -> SurfaceState:
        """Copy of the final state."""
        last = self.index(self.chunk.length)
        return SurfaceState(self.x[last].clone(), self.anchor[last].clone(), self.force.clone())


def check_start(
    model: Model, ordered: bool, launch: Callable[..., None], inputs: Any, x: Tensor, words: wp.array
) -> None:
    """Check the depth of the points at ``x`` in the initial state of a call, with the inputs of its first substep."""
    places = view(x.detach().contiguous(), types(model.spec.dim, "float64").vec)
    arguments = (model.constants, inputs, outline_struct(model), 0.0, 0, places, words)
    launch(surface(model.spec, ordered).check_depth, tuple(x.shape[:2]), *arguments)


class SurfaceContactAdj:
    """Adjoint of :class:`SurfaceContact`.

    Attributes:
        x, anchor, force: Adjoint of the state.
        mass: Adjoint of the masses of the nodes in a substep, shape (world, node).
    """

    def __init__(self, forward: SurfaceContact, wanted: RequestedGrads, adj_end: SurfaceState):
        self.forward, model = forward, forward.model
        self.kernels = surface_adj(model.spec, wanted, forward.ordered)
        self.x, self.anchor, self.force = (one.to(model.dtype, copy=True) for one in adj_end)
        self.mass, self.load = (forward.tensor(model.worlds, model.node_count) for _ in range(2))
        self._free = view(forward.tensor(model.worlds, model.node_count, model.dim), forward.types.vec)
        self._shares = view(forward.tensor(*forward.points, 3**model.dim), forward.types.real)

    def respond(
        self, s: int, inputs: Any, adj_inputs: Any, node: wp.array, velocity: wp.array, adj_velocity: wp.array
    ) -> None:
        """Turn the adjoint of the velocity of the nodes after contact into that before; adds into the other adjoints."""
        one, model, t = self.forward, self.forward.model, self.forward.types
        load, adj_load, adj_mass = (view(a, t.real) for a in (one.load, self.load, self.mass))
        adj_x, adj_anchor, adj_force = (view(a, t.vec) for a in (self.x, self.anchor, self.force))
        clear(self.load)
        clear(self.mass)
        about, constants = (one.base, one.shares), model.constants
        arrays = (node, velocity, *about, adj_x, self._shares, adj_velocity, adj_mass)
        one.launch(self.kernels.advance_adj, one.points, constants, *arrays)
        wp.copy(self._free, adj_velocity, stream=one.stream)
        parameters = (inputs, one.outline, one.width, model.node_count, one.rate, one.anew(s))
        arrays = (one.places(s), one.anchors(s), node, one.free, *about, load, adj_velocity)
        out = (adj_force, adj_anchor, adj_x, self._shares, self._free, adj_load, adj_mass, adj_inputs)
        one.launch(self.kernels.press_adj, one.points, constants, *parameters, *arrays, *out)
        arrays = (one.places(s), node, one.shares, self._shares, adj_load, adj_x, adj_mass)
        one.launch(self.kernels.share_adj, one.points, constants, one.outline, *arrays)
        wp.copy(adj_velocity, self._free, stream=one.stream)

    def start(self) -> SurfaceState:
        """Adjoint of the initial state."""
        begins = self.forward.chunk.first % self.forward.chunk.substeps == 0
        force = torch.zeros_like(self.force) if begins else self.force
        return SurfaceState(self.x.double(), self.anchor, force)
