"""One substep: the order of its launches, forward and adjoint.

Nothing here decides how many substeps there are or what is kept: that is ``rollout.py``. Launches go to PyTorch's current
stream and are never recorded on a ``wp.Tape`` by themselves: :func:`softmpm.step` records the explicit adjoint.
"""

import functools

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import NEVER
from softmpm.kernels.compile import launch
from softmpm.kernels.convert import boundary
from softmpm.kernels.physics.actuation_sum import collect_pull, collectors
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.plain.transfer import transfer, transfer_adj
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.schemes.buffers import SolidAdj, clear, view
from softmpm.schemes.device import stream_of
from softmpm.state import Low, State


class Substep:
    """The launches of one substep, on grid buffers of its own that are made when first used.

    Args:
        solid: Struct of a :class:`Solid`; None if only :meth:`enter` and :meth:`leave` are wanted.
    """

    def __init__(self, model: Model, solid):
        self.model, self.solid, self.stream = model, solid, stream_of(model.device)
        self.types = types(model.spec.dim, model.spec.dtype)
        for define in (transfer, grid):  # all of a module before it is first loaded: it is compiled once
            define(model.spec)
        self.particles = (model.worlds, model.particle_count)
        self.nodes = (model.worlds, model.node_count)
        self.words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        self.words_array = view(self.words, wp.int64)
        self._arrays = {}
        self.last = 0  # number of the substep that was launched last

    def _grid(self, dtype) -> Tensor:
        return torch.empty(*self.nodes, dtype._length_, dtype=self.model.dtype, device=self.model.device)

    def _array(self, name: str) -> wp.array:
        """Warp's view of one of the grid buffers below, made once."""
        if name not in self._arrays:
            self._arrays[name] = view(
                getattr(self, name), self.types.node if name.endswith("node") else self.types.vec
            )
        return self._arrays[name]

    @functools.cached_property
    def node(self) -> Tensor:
        """Momentum and mass, (world, node, dim + 1)."""
        return self._grid(self.types.node)

    @functools.cached_property
    def velocity(self) -> Tensor:
        """(world, node, dim)."""
        return self._grid(self.types.vec)

    @functools.cached_property
    def adj_node(self) -> Tensor:
        return self._grid(self.types.node)

    @functools.cached_property
    def adj_velocity(self) -> Tensor:
        return self._grid(self.types.vec)

    def launch(self, kernel, dim, *inputs) -> None:
        launch(kernel, dim, inputs, device=self.model.wp_device, stream=self.stream)

    def to_grid(self, now) -> None:
        """P2G and the grid stage: velocity of the nodes."""
        constants, spec = self.model.constants, self.model.spec
        node, velocity = self._array("node"), self._array("velocity")
        clear(self.node)
        self.launch(transfer(spec).p2g, self.particles, constants, self.solid, now, node)
        self.launch(grid(spec).grid_velocity, self.nodes, constants, self.model.walls, node, velocity)

    def advance(self, now, then, substep: int) -> None:
        """One whole substep."""
        self.last = substep
        self.to_grid(now)
        arguments = (self.model.constants, substep, self._array("velocity"), now, self.words_array, then)
        self.launch(transfer(self.model.spec).g2p, self.particles, *arguments)

    def adjoint(self, wanted: RequestedGrads, now, then, adj_then, adj_now, adj_solid, substep: int) -> None:
        """Adjoint of :meth:`advance`: adds into ``adj_now`` and ``adj_solid``. The grid is computed again."""
        self.to_grid(now)
        clear(self.adj_velocity)
        self.g2p_adj(wanted, now, then, adj_then, adj_now)
        self.grid_adj()
        self.p2g_adj(wanted, now, adj_now, adj_solid, substep)

    def g2p_adj(self, wanted: RequestedGrads, now, then, adj_then, adj_now) -> None:
        velocity, adj_velocity = self._array("velocity"), self._array("adj_velocity")
        arguments = (self.model.constants, velocity, now, then, adj_then, adj_velocity, adj_now)
        self.launch(transfer_adj(self.model.spec, wanted).g2p_adj, self.particles, *arguments)

    def grid_adj(self) -> None:
        model, arrays = self.model, (self._array(name) for name in ("node", "adj_velocity", "adj_node"))
        arguments = (model.constants, model.walls, *arrays)
        self.launch(grid(model.spec).grid_velocity_adj, self.nodes, *arguments)

    def p2g_adj(self, wanted: RequestedGrads, now, adj_now, adj_solid, substep: int) -> None:
        adj_node = self._array("adj_node")
        arguments = (
            self.model.constants,
            self.solid,
            substep,
            now,
            adj_node,
            self.words_array,
            adj_solid,
            adj_now,
        )
        self.launch(transfer_adj(self.model.spec, wanted).p2g_adj, self.particles, *arguments)

    def collect_pull(self, adj_solid: SolidAdj, adj_pull: Tensor) -> None:
        """Add what the particles found for the muscles' pull into ``adj_pull`` (world, muscle) and start afresh."""
        if adj_solid.slot is None:
            raise ValueError("the adjoint of the pull was not asked for.")
        slots = self.model.muscle_slots.expand(*adj_solid.slot.shape)
        real, muscles = self.types.real, view(slots, wp.int32)
        arrays = (muscles, view(adj_solid.slot, real), view(adj_pull, real))
        self.launch(collect_pull(self.model.spec), collectors(adj_solid.slot.shape), *arrays)

    def enter(self, start: State, motion) -> None:
        """From what users hold to what the kernels hold."""
        t, low = self.types, start.low
        if low is None:
            low = Low(torch.zeros_like(start.x), torch.zeros_like(start.F))
        arrays = [
            view(tensor.contiguous(), t.vec if tensor.ndim == 3 else t.mat) for tensor in (*start[:4], *low)
        ]
        kernel = boundary(self.model.dim, self.model.spec.dtype).enter
        self.launch(kernel, self.particles, self.model.constants, *arrays, self.words_array, motion)

    def leave(self, motion) -> State:
        """The way back, into fresh tensors."""
        t, lead, d = self.types, self.particles, self.model.dim
        vectors = [(*lead, d), (*lead, d), (*lead, d, d), (*lead, d, d)]
        if self.model.dtype == torch.float32:
            vectors += [(*lead, d), (*lead, d, d)]
        out = [torch.empty(shape, dtype=self.model.dtype, device=self.model.device) for shape in vectors]
        low = out[4:] or [out[0].new_empty(0, 0, d), out[0].new_empty(0, 0, d, d)]
        arrays = [view(tensor, t.vec if tensor.ndim == 3 else t.mat) for tensor in (*out[:4], *low)]
        self.launch(
            boundary(self.model.dim, self.model.spec.dtype).leave, lead, self.model.constants, motion, *arrays
        )
        return State(*out[:4], low=Low(*out[4:]) if out[4:] else None)
