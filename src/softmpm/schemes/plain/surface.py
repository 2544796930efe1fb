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
        self, model: Model, chunk: Chunk, keep: bool, start: SurfaceState, launch: Callable[..., None]
    ):
        self.model, self.chunk, self.keep, self.launch = model, chunk, keep, launch
        self.stream = stream_of(model.device)
        t, dim, exact = types(model.spec.dim, model.spec.dtype), model.dim, torch.float64
        self.types, self.kernels, self.outline = t, surface(model.spec), outline_struct(model)
        self.width = model.contact_width * model.scene.grid.spacing
        self.rate = 1.0 / (chunk.substeps * model.scene.dt)
        self.points, stored = (model.worlds, model.anchor_shape[2]), chunk.length + 1 if keep else 2
        self.x = torch.empty(stored, *self.points, dim, dtype=exact, device=model.device)
        self.anchor, self.force = self.tensor(stored, *model.anchor_shape), self.tensor(*model.anchor_shape)
        self.x[0], self.anchor[0] = start.x.detach(), start.anchor.detach()
        self.force.copy_(torch.zeros_like(self.force) if chunk.begins else start.force.detach())
        self.places = [view(one, types(model.spec.dim, "float64").vec) for one in self.x]
        self.anchors = [view(one, t.vec) for one in self.anchor]
        self.force_array = view(self.force, t.vec)
        nodes = (model.worlds, model.node_count)
        base = torch.empty(*self.points, dim, dtype=torch.int32, device=model.device)
        self.base, self.shares = view(base, t.ivec), view(self.tensor(*self.points, 3**dim), t.real)
        self.load, self.free = self.tensor(*nodes), view(self.tensor(*nodes, dim), t.vec)
        self.load_array = view(self.load, t.real)
        self._scratch = [view(one, t.vec) for one in self.tensor(2, *model.anchor_shape)]

    def tensor(self, *shape: int) -> Tensor:
        return torch.empty(shape, dtype=self.model.dtype, device=self.model.device)

    def index(self, s: int) -> int:
        """Number of the stored state before substep ``s``."""
        return s if self.keep else s % 2

    def respond(
        self, s: int, inputs: Any, node: wp.array, velocity: wp.array, words: wp.array, again: bool = False
    ) -> None:
        """Add what the walls give to the velocity of the nodes in substep ``s``; ``again`` changes neither anchors nor forces."""
        x, anchor = self.places[self.index(s)], self.anchors[self.index(s)]
        out = self._scratch if again else (self.force_array, self.anchors[self.index(s + 1)])
        parameters = (
            self.model.constants,
            inputs,
            self.outline,
            self.width,
            s,
            self.rate,
            self.chunk.anew(s),
        )
        about = (self.base, self.shares, self.load_array)
        clear(self.load)
        wp.copy(self.free, velocity, stream=self.stream)
        arguments = (self.model.constants, self.outline, s, x, node, words, *about)
        self.launch(self.kernels.share, self.points, *arguments)
        arguments = (*parameters, x, anchor, node, self.free, *about, words, *out, velocity)
        self.launch(self.kernels.press, self.points, *arguments)

    def advance(self, s: int, node: wp.array, velocity: wp.array, words: wp.array) -> None:
        """Carry the points with the velocity of the nodes after contact."""
        x, new_x = self.places[self.index(s)], self.places[self.index(s + 1)]
        arguments = (self.model.constants, words, x, node, velocity, self.base, self.shares, new_x)
        self.launch(self.kernels.advance, self.points, *arguments)

    def check_end(self, inputs: Any, words: wp.array) -> None:
        """Check the depth of the points in the final state, with the inputs of the last substep."""
        length, model = self.chunk.length, self.model
        about = (model.scene.dt, length - 1, self.places[self.index(length)], words)
        self.launch(self.kernels.check_depth, self.points, model.constants, inputs, self.outline, *about)

    def end(self) -> SurfaceState:
        """Copy of the final state."""
        last = self.index(self.chunk.length)
        return SurfaceState(self.x[last].clone(), self.anchor[last].clone(), self.force.clone())


def check_start(model: Model, launch: Callable[..., None], inputs: Any, x: Tensor, words: wp.array) -> None:
    """Check the depth of the points at ``x`` in the initial state of a call, with the inputs of its first substep."""
    places = view(x.detach().contiguous(), types(model.spec.dim, "float64").vec)
    arguments = (model.constants, inputs, outline_struct(model), 0.0, 0, places, words)
    launch(surface(model.spec).check_depth, tuple(x.shape[:2]), *arguments)


class SurfaceContactAdj:
    """Adjoint of :class:`SurfaceContact`.

    Attributes:
        x, anchor, force: Adjoint of the state.
        mass: Adjoint of the masses of the nodes in a substep, shape (world, node).
    """

    def __init__(self, forward: SurfaceContact, wanted: RequestedGrads, adj_end: SurfaceState):
        self.forward, model, t = forward, forward.model, forward.types
        self.kernels, nodes = surface_adj(model.spec, wanted), (model.worlds, model.node_count)
        self.x, self.anchor, self.force = (one.to(model.dtype, copy=True) for one in adj_end)
        self._state = [view(one, t.vec) for one in (self.x, self.anchor, self.force)]
        self.mass, self._load = forward.tensor(*nodes), forward.tensor(*nodes)
        self._mass_array, self._load_array = view(self.mass, t.real), view(self._load, t.real)
        self._free = view(forward.tensor(*nodes, model.dim), t.vec)
        self._shares = view(forward.tensor(*forward.points, 3**model.dim), t.real)

    def respond(
        self, s: int, inputs: Any, adj_inputs: Any, node: wp.array, velocity: wp.array, adj_velocity: wp.array
    ) -> None:
        """Turn the adjoint of the velocity of the nodes after contact into that before; adds into the other adjoints."""
        one, constants = self.forward, self.forward.model.constants
        x, anchor, about = one.places[one.index(s)], one.anchors[one.index(s)], (one.base, one.shares)
        adj_x, adj_anchor, adj_force = self._state
        clear(self._load)
        clear(self.mass)
        arguments = (node, velocity, *about, adj_x, self._shares, adj_velocity, self._mass_array)
        one.launch(self.kernels.advance_adj, one.points, constants, *arguments)
        wp.copy(self._free, adj_velocity, stream=one.stream)
        parameters = (inputs, one.outline, one.width, one.model.node_count, one.rate, one.chunk.anew(s))
        arrays = (x, anchor, node, one.free, *about, one.load_array, adj_velocity)
        state = (adj_force, adj_anchor, adj_x, self._shares)
        out = (self._free, self._load_array, self._mass_array, adj_inputs)
        one.launch(self.kernels.press_adj, one.points, constants, *parameters, *arrays, *state, *out)
        arguments = (x, node, one.shares, self._shares, self._load_array, adj_x, self._mass_array)
        one.launch(self.kernels.share_adj, one.points, constants, one.outline, *arguments)
        wp.copy(adj_velocity, self._free, stream=one.stream)

    def start(self) -> SurfaceState:
        """Adjoint of the initial state."""
        force = torch.zeros_like(self.force) if self.forward.chunk.begins else self.force
        return SurfaceState(self.x.double(), self.anchor, force)
