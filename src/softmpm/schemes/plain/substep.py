"""One substep: the order of its launches, forward and adjoint.

Nothing here decides how many substeps there are or what is kept: that is ``rollout.py``. Launches go to PyTorch's current
stream and are never recorded on a ``wp.Tape`` by themselves: :func:`softmpm.step` records the explicit adjoint.
"""

import functools
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import NEVER
from softmpm.kernels.compile import launch
from softmpm.kernels.convert import conversion
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.physics.grid_adj import grid_adj
from softmpm.kernels.plain.transfer import transfer, transfer_adj
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.schemes.buffers import clear, view
from softmpm.schemes.carried import Nodes, SurfaceContact
from softmpm.schemes.carried_adj import SurfaceContactAdj
from softmpm.schemes.device import stream_of
from softmpm.state import Low, State


class Substep:
    """The launches of one substep, on grid buffers of its own that are made when first used.

    Attributes:
        particle_inputs, grid_inputs: Structs of the inputs, set before a substep; none are needed for :meth:`enter` and :meth:`leave`.
        words, words_array: Status words of the worlds, see errors.py.
    """

    particle_inputs: Any
    grid_inputs: Any

    def __init__(self, model: Model):
        self.model, self.stream = model, stream_of(model.device)
        self.types = types(model.spec.dim, model.spec.dtype)
        self.ordered = model.deterministic and model.device.type == "cuda"  # the CPU adds in one order anyway
        self.transfer = transfer(model.spec, self.ordered)
        self.particles = (model.worlds, model.particle_count)
        self.nodes = (model.worlds, model.node_count)
        self.words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        self.words_array = self.adj_words_array = view(self.words, wp.int64)
        self._arrays = {}
        self.last = 0  # number of the substep that was launched last

    def _grid(self, dtype) -> Tensor:
        return torch.empty(*self.nodes, dtype._length_, dtype=self.model.dtype, device=self.model.device)

    def _array(self, name: str) -> wp.array:
        """Warp's view of one of the grid buffers below, made once."""
        if name not in self._arrays:
            t = self.types
            kinds = dict.fromkeys(("node", "adj_node", "gained"), t.node)
            kinds |= {"load": t.real, "adj_load": t.real}
            self._arrays[name] = view(getattr(self, name), kinds.get(name, t.vec))
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

    @functools.cached_property
    def load(self) -> Tensor:
        """Areas of the surface points on each node, (world, node)."""
        return torch.empty(self.nodes, dtype=self.model.dtype, device=self.model.device)

    @functools.cached_property
    def adj_load(self) -> Tensor:
        return torch.empty_like(self.load)

    @functools.cached_property
    def free(self) -> Tensor:
        """Velocity before contact at surface points, (world, node, dim)."""
        return torch.empty_like(self.velocity)

    @functools.cached_property
    def gained(self) -> Tensor:
        """Contributions of contact at surface points to the adjoints of velocity and mass, (world, node, dim + 1)."""
        return torch.empty_like(self.node)

    @property
    def _contact_nodes(self) -> Nodes:
        """The nodes as contact at surface points takes them."""
        return Nodes(*(self._array(name) for name in ("node", "free", "velocity", "load")))

    def launch(self, kernel, dim, *inputs, **settings) -> None:
        launch(kernel, dim, inputs, device=self.model.wp_device, stream=self.stream, **settings)

    def to_grid(self, now) -> None:
        """P2G and the grid stage: velocity of the nodes."""
        constants, spec = self.model.constants, self.model.spec
        node, velocity = self._array("node"), self._array("velocity")
        clear(self.node)
        self.launch(self.transfer.p2g, self.particles, constants, self.particle_inputs, now, node)
        self.launch(grid(spec).grid_velocity, self.nodes, constants, self.grid_inputs, node, velocity)

    def advance(self, now, then, substep: int, contact: SurfaceContact | None = None) -> None:
        """One whole substep."""
        self.last = substep
        self.to_grid(now)
        if contact is not None:
            self._add_loads(contact, now)
            contact.press(substep, self.grid_inputs, now, self._contact_nodes, self.words_array, self.launch)
        arguments = (self.model.constants, self.particle_inputs, substep, self._array("velocity"), now)
        self.launch(self.transfer.g2p, self.particles, *arguments, self.words_array, then)

    def adjoint(
        self,
        wanted: RequestedGrads,
        now,
        then,
        adj_then,
        adj_now,
        adj_inputs: tuple,
        substep: int,
        contact: tuple[SurfaceContact, SurfaceContactAdj, int] | None = None,
    ) -> None:
        """Adjoint of :meth:`advance`. The grid is recomputed.

        Args:
            adj_now, adj_inputs: Added into; the latter are the structs of the inputs of particles and of nodes.
            substep: Number of the substep, counted backward.
            contact: Contact of the chunk, its adjoint, which is updated, and the number of the substep in the chunk.
        """
        adj_particle_inputs, adj_grid_inputs = adj_inputs
        self.to_grid(now)
        clear(self.adj_velocity)
        if contact is not None:
            self._contact_again(*contact, now)
        self.g2p_adj(wanted, now, then, adj_then, adj_now, adj_particle_inputs)
        if contact is not None:
            self._contact_adj(*contact, now, adj_now, adj_grid_inputs)
        self.grid_adj(wanted, adj_grid_inputs)
        if contact is not None:
            self.adj_node[..., -1] += self.gained[..., -1]
        self.p2g_adj(wanted, now, adj_now, adj_particle_inputs, substep)

    def _add_loads(self, contact: SurfaceContact, now) -> None:
        """Initial data of contact at surface points: the areas on the nodes, and a copy of their velocity."""
        clear(self.load)
        contact.add_loads(now, self._array("load"), self.launch)
        self.free.copy_(self.velocity)

    def _contact_again(self, contact: SurfaceContact, back: SurfaceContactAdj, s: int, now) -> None:
        """Contact at surface points once more."""
        self._add_loads(contact, now)
        arguments = (self.grid_inputs, now, self._contact_nodes, self.words_array, self.launch)
        back.press_again(contact, s, *arguments)

    def _contact_adj(
        self, contact: SurfaceContact, back: SurfaceContactAdj, s: int, now, adj_now, adj_inputs
    ) -> None:
        """Adjoint of contact at surface points."""
        clear(self.adj_load)
        clear(self.gained)
        adj_load = self._array("adj_load")
        adj_nodes = (self._array("adj_velocity"), adj_load, self._array("gained"))
        inputs = (self.grid_inputs, adj_inputs, now)
        back.press_adj(contact, s, *inputs, self._contact_nodes, *adj_nodes, adj_now, self.launch)
        back.add_loads_adj(contact, now, adj_load, adj_now, self.launch)
        self.adj_velocity += self.gained[..., :-1]

    def g2p_adj(self, wanted: RequestedGrads, now, then, adj_then, adj_now, adj_inputs) -> None:
        arrays = (self._array("velocity"), now, then, adj_then, adj_inputs, self._array("adj_velocity"))
        arguments = (self.model.constants, self.particle_inputs, *arrays, adj_now)
        kernel = transfer_adj(self.model.spec, wanted, self.ordered).g2p_adj
        self.launch(kernel, self.particles, *arguments)

    def grid_adj(self, wanted: RequestedGrads, adj_inputs) -> None:
        arrays = (self._array(name) for name in ("node", "adj_velocity", "adj_node"))
        arguments = (self.model.constants, self.grid_inputs, *arrays, adj_inputs)
        self.launch(grid_adj(self.model.spec, wanted).grid_velocity_adj, self.nodes, *arguments)

    def p2g_adj(self, wanted: RequestedGrads, now, adj_now, adj_inputs, substep: int) -> None:
        parameters = (self.model.constants, self.particle_inputs, substep, now, self._array("adj_node"))
        arguments = (*parameters, self.adj_words_array, adj_inputs, adj_now)
        kernel = transfer_adj(self.model.spec, wanted, self.ordered).p2g_adj
        self.launch(kernel, self.particles, *arguments)

    def enter(self, start: State, motion) -> None:
        """From what users hold to what the kernels hold."""
        t, low = self.types, start.low
        if low is None:
            low = Low(torch.zeros_like(start.x), torch.zeros_like(start.F))
        arrays = [
            view(tensor.contiguous(), t.vec if tensor.ndim == 3 else t.mat) for tensor in (*start[:4], *low)
        ]
        kernel = conversion(self.model.dim, self.model.spec.dtype).enter
        self.launch(kernel, self.particles, self.model.constants, *arrays, self.words_array, motion)

    def leave(self, motion) -> State:
        """Inverse of :meth:`enter`, into new tensors."""
        t, lead, d = self.types, self.particles, self.model.dim
        vectors = [(*lead, d), (*lead, d), (*lead, d, d), (*lead, d, d)]
        if self.model.dtype == torch.float32:
            vectors += [(*lead, d), (*lead, d, d)]
        out = [torch.empty(shape, dtype=self.model.dtype, device=self.model.device) for shape in vectors]
        low = out[4:] or [out[0].new_empty(0, 0, d), out[0].new_empty(0, 0, d, d)]
        arrays = [view(tensor, t.vec if tensor.ndim == 3 else t.mat) for tensor in (*out[:4], *low)]
        self.launch(
            conversion(self.model.dim, self.model.spec.dtype).leave,
            lead,
            self.model.constants,
            motion,
            *arrays,
        )
        return State(*out[:4], low=Low(*out[4:]) if out[4:] else None)
