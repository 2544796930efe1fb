"""One substep: the order of its launches, forward and adjoint.

Nothing here decides how many substeps there are or what is kept: that is ``rollout.py``. Launches go to PyTorch's current
stream and are never recorded on a ``wp.Tape`` by themselves: :func:`softmpm.step` records the explicit adjoint.
"""

from dataclasses import dataclass, fields

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.boundary import boundary
from softmpm.kernels.grid import grid
from softmpm.kernels.solid import collect_pull
from softmpm.kernels.transfer import transfer, transfer_adj
from softmpm.kernels.types import Wanted, solid_adj_type, solid_types, types
from softmpm.model import Model
from softmpm.state import Low, Params, State
from softmpm.watch import NEVER


def lame(params: Params) -> tuple[Tensor, Tensor]:
    """Lamé's μ = E / 2(1 + ν) and λ = E ν / (1 + ν)(1 − 2ν) [Pa]."""
    young, poisson = params.young, params.poisson
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def view(tensor: Tensor, dtype) -> wp.array:
    """Warp array on a tensor's memory; vectors and matrices take up its last axes."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def stream_of(device: torch.device) -> wp.Stream | None:
    """PyTorch's current stream as Warp sees it; None on the CPU."""
    return wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None


@dataclass
class Motion:
    """State of all particles as the kernels hold it (kernels/types.py); shapes (..., world, particle, dim[, dim])."""

    base: Tensor
    fx: Tensor
    v: Tensor
    C: Tensor
    H: Tensor
    fx_low: Tensor | None = None

    @staticmethod
    def empty(model: Model, *lead: int) -> "Motion":
        def tensor(*tail, dtype=model.dtype):
            return torch.empty(*lead, model.worlds, model.particle_count, *tail, dtype=dtype, device=model.device)

        d = model.dim
        low = tensor(d) if model.dtype == torch.float32 else None
        return Motion(tensor(d, dtype=torch.int32), tensor(d), tensor(d), tensor(d, d), tensor(d, d), low)

    def tensors(self) -> tuple[Tensor, ...]:
        found = (getattr(self, field.name) for field in fields(self))
        return tuple(tensor for tensor in found if tensor is not None)

    def __getitem__(self, slot) -> "Motion":
        return Motion(*(tensor[slot] for tensor in self.tensors()))

    def copy_(self, other: "Motion") -> None:
        for mine, theirs in zip(self.tensors(), other.tensors(), strict=True):
            mine.copy_(theirs)

    def struct(self, model: Model):
        t = types(model.spec.dim, model.spec.dtype)
        struct = t.Motion()
        struct.base = view(self.base, t.ivec)
        names = (("fx", t.vec), ("v", t.vec), ("C", t.mat), ("H", t.mat), ("fx_low", t.vec))
        for name, dtype in names[: len(self.tensors()) - 1]:
            setattr(struct, name, view(getattr(self, name), dtype))
        return struct


@dataclass
class MotionAdj:
    """Adjoint of a :class:`Motion`, one flat tensor so that it is cleared at once."""

    flat: Tensor
    fx: Tensor
    v: Tensor
    C: Tensor
    H: Tensor

    @staticmethod
    def zeros(model: Model) -> "MotionAdj":
        lead, d = (model.worlds, model.particle_count), model.dim
        shapes = [(*lead, d), (*lead, d), (*lead, d, d), (*lead, d, d)]
        sizes = [lead[0] * lead[1] * n for n in (d, d, d * d, d * d)]
        flat = torch.zeros(sum(sizes), dtype=model.dtype, device=model.device)
        parts = (part.view(shape) for part, shape in zip(flat.split(sizes), shapes, strict=True))
        return MotionAdj(flat, *parts)

    def struct(self, model: Model):
        t = types(model.spec.dim, model.spec.dtype)
        struct = t.MotionAdj()
        for name, dtype in (("fx", t.vec), ("v", t.vec), ("C", t.mat), ("H", t.mat)):
            setattr(struct, name, view(getattr(self, name), dtype))
        return struct


@dataclass
class Solid:
    """Material of all particles: tensors (world, particle), and the pull of the muscles (world, muscle) [Pa]."""

    mass: Tensor
    mu: Tensor
    lam: Tensor
    pull: Tensor | None

    def struct(self, model: Model):
        t, solid = types(model.spec.dim, model.spec.dtype), solid_types(model.spec).Solid()
        for name in ("mass", "mu", "lam"):
            setattr(solid, name, view(getattr(self, name), t.real))
        solid.volume = view(model.volume, t.real)
        if len(model.spec.laws) > 1:
            solid.law = view(model.law, wp.int32)
        if model.spec.muscle_slots:
            solid.muscle = view(model.muscle_slots, wp.int32)
            solid.fibre = view(model.fibre, t.vec)
            solid.pull = view(self.pull, t.real)
        return solid


@dataclass
class SolidAdj:
    """Adjoint of a :class:`Solid`; what is not wanted is None. ``slot`` is the pull's, of each particle and slot."""

    wanted: Wanted
    mass: Tensor | None = None
    mu: Tensor | None = None
    lam: Tensor | None = None
    slot: Tensor | None = None

    @staticmethod
    def zeros(model: Model, wanted: Wanted) -> "SolidAdj":
        def tensor(*tail):
            return torch.zeros(model.worlds, model.particle_count, *tail, dtype=model.dtype, device=model.device)

        adj = SolidAdj(wanted)
        if wanted.material:
            adj.mass, adj.mu, adj.lam = tensor(), tensor(), tensor()
        if wanted.activation:
            adj.slot = tensor(model.spec.muscle_slots)
        return adj

    def struct(self, model: Model):
        t, struct = types(model.spec.dim, model.spec.dtype), solid_adj_type(model.spec, self.wanted)()
        if self.wanted.material:
            for name in ("mass", "mu", "lam"):
                setattr(struct, name, view(getattr(self, name), t.real))
        if self.wanted.activation:
            struct.pull = view(self.slot, t.real)
        return struct


class Substep:
    """The launches of one substep on one set of grid buffers."""

    def __init__(self, model: Model, solid, adjoint: bool = False):
        self.model, self.solid, self.stream = model, solid, stream_of(model.device)
        t, spec = types(model.spec.dim, model.spec.dtype), model.spec
        self.types, self.forward_kernels, self.grid_kernels = t, transfer(spec), grid(spec)
        self.particles = (model.worlds, model.particle_count)
        self.nodes = (model.worlds, model.node_count)
        self.watch = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        self._watch = view(self.watch, wp.int64)
        self._node_tensor, self.node = self._grid(t.node)
        _, self.velocity = self._grid(t.vec)
        if adjoint:
            if spec.muscle_slots:
                collect_pull(spec)  # defined before its module is first loaded, which would be compiled twice otherwise
            _, self.adj_node = self._grid(t.node)
            self._adj_velocity_tensor, self.adj_velocity = self._grid(t.vec)

    def _grid(self, dtype) -> tuple[Tensor, wp.array]:
        tensor = torch.empty(*self.nodes, dtype._length_, dtype=self.model.dtype, device=self.model.device)
        return tensor, view(tensor, dtype)

    def launch(self, kernel, dim, *inputs) -> None:
        wp.launch(
            kernel, dim=dim, inputs=inputs, device=self.model.wp_device, stream=self.stream, record_tape=False
        )

    def to_grid(self, now) -> None:
        """P2G and the grid stage: velocity of the nodes."""
        scale = self.model.scale
        self._node_tensor.zero_()
        self.launch(self.forward_kernels.p2g, self.particles, scale, self.solid, self._watch, now, self.node)
        self.launch(
            self.grid_kernels.grid_velocity, self.nodes, scale, self.model.walls, self.node, self.velocity
        )

    def advance(self, now, then, substep: int) -> None:
        """One whole substep."""
        self.to_grid(now)
        self.launch(
            self.forward_kernels.g2p,
            self.particles,
            *(self.model.scale, self.solid, substep, self.velocity, now, self._watch, then),
        )

    def adjoint(self, wanted: Wanted, now, then, adj_then, adj_now, adj_solid, substep: int) -> None:
        """Adjoint of :meth:`advance`: adds into ``adj_now`` and ``adj_solid``. The grid is computed again."""
        scale, kernels = self.model.scale, transfer_adj(self.model.spec, wanted)
        self.to_grid(now)
        self._adj_velocity_tensor.zero_()
        self.launch(
            kernels.g2p_adj,
            self.particles,
            *(scale, self.velocity, now, then, adj_then, self.adj_velocity, adj_now),
        )
        self.launch(
            self.grid_kernels.grid_velocity_adj,
            self.nodes,
            *(scale, self.model.walls, self.node, self.adj_velocity, self.adj_node),
        )
        self.launch(
            kernels.p2g_adj,
            self.particles,
            *(scale, self.solid, substep, now, self.adj_node, self._watch, adj_solid, adj_now),
        )

    def collect_pull(self, adj_solid: SolidAdj, adj_pull: Tensor) -> None:
        """Add what the particles found for the muscles' pull into ``adj_pull`` (world, muscle) and start afresh."""
        real, slots = self.types.real, self.model.spec.muscle_slots
        self.launch(
            collect_pull(self.model.spec),
            (*self.particles, slots),
            *(view(self.model.muscle_slots, wp.int32), view(adj_solid.slot, real), view(adj_pull, real)),
        )

    def enter(self, start: State, motion) -> None:
        """From what users hold to what the kernels hold."""
        t, state = self.types, start
        low = start.low
        if low is None:
            low = Low(torch.zeros_like(state.x), torch.zeros_like(state.F))
        arrays = [view(tensor.contiguous(), t.vec if tensor.ndim == 3 else t.mat) for tensor in (*state, *low)]
        kernel = boundary(self.model.dim, self.model.spec.dtype).enter
        self.launch(kernel, self.particles, self.model.scale, *arrays, self._watch, motion)

    def leave(self, motion) -> State:
        """The way back, into fresh tensors."""
        t, lead, d = self.types, self.particles, self.model.dim
        vectors = [(*lead, d), (*lead, d), (*lead, d, d), (*lead, d, d)]
        if self.model.dtype == torch.float32:
            vectors += [(*lead, d), (*lead, d, d)]
        out = [torch.empty(shape, dtype=self.model.dtype, device=self.model.device) for shape in vectors]
        low = out[4:] or [torch.empty(0, 0, d, dtype=self.model.dtype), torch.empty(0, 0, d, d, dtype=self.model.dtype)]
        arrays = [view(tensor, t.vec if tensor.ndim == 3 else t.mat) for tensor in (*out[:4], *low)]
        self.launch(boundary(self.model.dim, self.model.spec.dtype).leave, lead, self.model.scale, motion, *arrays)
        state = State(*out[:4])
        return state.with_low(Low(*out[4:])) if out[4:] else state
