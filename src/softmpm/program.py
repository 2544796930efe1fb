"""The fast scheme's substeps of one chunk as a fixed list of launches on buffers of its own, replayed as a graph.

A graph holds addresses, so everything that changes between calls is copied to fixed places first: the start, the material, the
pull of the muscles. A program that kept its states is lent to one call until its backward pass is done.
"""

import functools

import torch
import warp as wp
from torch import Tensor

from softmpm.arrangement import Arrangement
from softmpm.buffers import Solid, passing, view
from softmpm.exact import Exact
from softmpm.horizon import Chunk
from softmpm.kernels.fused import fused
from softmpm.kernels.native import BLOCK, FEW, WARP
from softmpm.kernels.packing import packing
from softmpm.kernels.solid import sorted_solid
from softmpm.kernels.types import solid_types, types
from softmpm.model import Model
from softmpm.replay import Launcher, Replay, recording
from softmpm.state import Low, State
from softmpm.step import stream_of
from softmpm.watch import NEVER


class Program:
    """One chunk on one arrangement."""

    def __init__(self, model: Model, arrangement: Arrangement, chunk: Chunk, keep: bool):
        self.model, self.arrangement, self.chunk, self.keep = model, arrangement, chunk, keep
        self.adjoints = {}
        self.types = t = types(model.spec.dim, model.spec.dtype)
        self.lead = (model.worlds, model.particle_count)
        self.total = model.worlds * model.particle_count
        padded = -(-self.total // WARP) * WARP

        def tensor(*size, dtype=model.dtype):
            return torch.empty(*size, dtype=dtype, device=model.device)

        self._tensor = tensor
        self.order = tensor(*self.lead, dtype=torch.int32)
        self.origin = tensor(model.worlds, model.dim, dtype=torch.int32)
        self.words = tensor(model.worlds + 2, dtype=torch.int64)
        self._calm = torch.full_like(self.words, NEVER)
        self._calm[-2:].zero_()
        self._version = -1  # of the arrangement that order and origin were taken from
        # What the sorted material was taken from, if it needs no gradient:
        self._given: tuple[Tensor, ...] = ()
        slots, grids = (chunk.length + 1, chunk.length) if keep else (1, 2)
        self.base = tensor(slots, padded, dtype=torch.int32)
        self.rows = tensor(slots, padded * t.rows)
        self.nodes = tensor(grids, model.worlds * arrangement.node_count, 4)
        self.velocity = tensor(model.worlds * arrangement.node_count, 4)
        rows = chunk.row(chunk.length - 1) + 1
        self.pull = tensor(rows, model.worlds, model.muscle_count) if model.muscle_count else None
        self._structs()
        self.exact = None
        if model.spec.deterministic:
            self.exact = Exact(model, view(tensor(padded * t.rows), t.real), self.node_arrays)
        self._forward = Replay(model, self._launch_all)

    def _structs(self) -> None:
        """What the kernels see of the buffers."""
        model, t = self.model, self.types
        self.window = self.arrangement.window(self.origin)
        self.packed = []
        for base, rows in zip(self.base, self.rows, strict=True):
            packed = t.Packed()
            packed.base, packed.rows = view(base, wp.int32), view(rows, t.real)
            self.packed.append(packed)
        self.node_arrays = [view(nodes, t.aligned) for nodes in self.nodes]
        self.nothing = view(self._tensor(0, 4), t.aligned)
        self.velocity_array = view(self.velocity, t.aligned)
        self.order_array = view(self.order, wp.int32)
        self.order_flat = view(self.order.view(-1), wp.int32)
        self.watch = view(self.words, wp.int64)
        material = [self._tensor(*self.lead) for _ in range(4)]
        solid = solid_types(model.spec).Solid()
        for name, tensor in zip(("mass", "mu", "lam", "volume"), material, strict=True):
            setattr(solid, name, view(tensor, t.real))
        if len(model.spec.laws) > 1:
            solid.law = view(self._tensor(*self.lead, dtype=torch.int32), wp.int32)
        if model.spec.muscle_slots:
            slots = self._tensor(*self.lead, model.spec.muscle_slots, dtype=torch.int32)
            self.muscle_array = view(slots, wp.int32)
            solid.muscle, solid.fibre = self.muscle_array, view(model.fibre, t.vec)
        self._solid = solid
        self.solids = []
        for row in self.pull if self.pull is not None else [None]:
            solid = solid_types(model.spec).Solid()
            for name in solid_types(model.spec).Solid.vars:
                if name != "pull":
                    setattr(solid, name, getattr(self._solid, name))
            if row is not None:
                solid.pull = view(row, t.real)
            self.solids.append(solid)

    def calm(self) -> None:
        """Forget what the kernels reported."""
        self.words.copy_(self._calm)

    def solid(self, s: int):
        """Material and pull of substep ``s``."""
        return self.solids[self.chunk.row(s) if self.pull is not None else 0]

    @functools.cached_property
    def block(self) -> int:
        """Threads of a block over particles; a single warp if the GPU has more room than warps."""
        return BLOCK if self.total > FEW else WARP

    @functools.cached_property
    def crew(self) -> int:
        """Particles of a warp: fewer than its threads while the GPU has more room than warps, so that each walks a shorter way."""
        if self.model.device.type != "cuda" or self.exact is not None:
            return WARP
        return WARP if self.total > FEW else WARP // 2

    @property
    def crews(self) -> int:
        """Threads of a launch in which each warp has a crew of particles."""
        warps = -(-self.total // self.crew)
        return -(-warps * WARP // self.block) * self.block if self.model.device.type == "cuda" else self.total

    @functools.cached_property
    def threads(self) -> int:
        """Threads of a launch over particles: whole blocks on a GPU, since warps work together."""
        return -(-self.total // self.block) * self.block if self.model.device.type == "cuda" else self.total

    def run(self, start: State, pull: Tensor | None, solid: Solid) -> State:
        """All substeps from ``start``; the end in new tensors. Failures are in :attr:`words`."""
        model, stream, pack = self.model, stream_of(self.model.device), self.packing
        launch = Launcher(model, stream)
        moved = recording(model) or self._version != self.arrangement.version
        if moved:
            self.order.copy_(self.arrangement.order)
            self.origin.copy_(self.arrangement.origin)
            self._version = self.arrangement.version
        self.calm()
        if self.pull is not None and pull is not None:
            self.pull.copy_(pull)
        low = start.low or Low(torch.zeros_like(start.x), torch.zeros_like(start.F))
        arrays = self.state_arrays(*start, *low)
        if not self._has(solid) or moved:
            given = Solid(solid.mass, solid.mu, solid.lam, None).struct(model)
            launch(sorted_solid(model.spec), self.lead, self.order_array, given, self._solid)
        enter = (model.scale, self.window, self.order_array, *arrays, self.watch, self.packed[0])
        launch(pack.enter, self.lead, *enter)
        if self.exact is not None:
            self.exact.begin(solid.mass)
        self._forward.run(stream)
        return self._leave(launch)

    def _has(self, solid: Solid) -> bool:
        """Whether the material is the one of the run before: the very tensors, which nothing else writes to. Takes note of it."""
        given = (solid.mass, solid.mu, solid.lam)
        same = bool(self._given) and all(a is b for a, b in zip(given, self._given, strict=True))
        self._given = () if any(tensor.requires_grad for tensor in given) else given
        return same

    @property
    def packing(self):
        return packing(self.model.spec.dim, self.model.spec.dtype)

    def state_arrays(self, *tensors: Tensor) -> list:
        t = self.types
        return [passing(tensor.contiguous(), t.vec if tensor.ndim == 3 else t.mat) for tensor in tensors]

    def _leave(self, launch: Launcher) -> State:
        model, d, rounds = self.model, self.model.dim, self.model.dtype == torch.float32
        tails = 2 * [(d,)] + 2 * [(d, d)]
        out = [self._tensor(*self.lead, *tail) for tail in tails]
        low = [self._tensor(*(self.lead if rounds else (0, 0)), *tail) for tail in ((d,), (d, d))]
        report = passing(self.words[-2:], wp.int64)
        leave = (self.window, self.order_array, self.packed[-1], *self.state_arrays(*out, *low), report)
        launch(self.packing.leave, self.lead, model.scale, *leave)
        state = State(*out)
        return state.with_low(Low(*low)) if rounds else state

    def _launch_all(self, launch: Launcher) -> None:
        nodes, length, kernels = self.node_arrays, self.chunk.length, fused(self.model.spec)
        held = len(self.velocity)
        if self.exact is None:
            launch(kernels.clear, held, nodes[0], block_dim=BLOCK)
        self._advance(-1, launch)
        for s in range(length):
            now, then = nodes[s % len(nodes)], nodes[(s + 1) % len(nodes)] if s + 1 < length else self.nothing
            if self.exact is not None:
                now, then = self.exact.sums(s), self.nothing
            arguments = (self.model.scale, self.model.walls, self.window, now, self.velocity_array, then)
            launch(kernels.grid_velocity, held, *arguments, block_dim=BLOCK)
            self._advance(s, launch)

    def _advance(self, s: int, launch: Launcher) -> None:
        """G2P of substep ``s`` and P2G of the next; the P2G of the first if ``s`` is -1."""
        model, packed, nodes, length = self.model, self.packed, self.node_arrays, self.chunk.length
        now, then = (max(s, 0), s + 1) if self.keep else (0, 0)
        solid = self.solid(min(s + 1, length - 1))
        parameters = (model.scale, solid, self.window, s, s + 1 == length, self.crew)
        sizes = (model.particle_count, self.total, self.order_flat)
        states = (packed[now], self.watch, packed[then])
        sink = nodes[(s + 1) % len(nodes)] if self.exact is None else self.exact.shares(s + 1)
        arguments = (*parameters, *sizes, self.velocity_array, *states, sink)
        launch(fused(model.spec).advance, self.crews, *arguments, block_dim=self.block)
        if self.exact is not None and s + 1 < length:
            self.exact.push(self, s + 1, packed[then], self._solid.mass, launch)
