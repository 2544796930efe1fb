"""A chunk graph: the launches of one chunk of the fast scheme on fixed buffers, captured once and replayed.

A captured graph refers to addresses, so everything that changes between calls is first copied into the graph's buffers: the initial
state and the inputs (sorted_inputs.py). A chunk graph is leased to one call: until its backward pass has run if it stores states,
otherwise until no later chunk reads its final state.
"""

import functools
from collections.abc import Sequence

import torch
import warp as wp

from softmpm.errors import FROZEN, NEVER
from softmpm.kernels.fast.alarms import packed_alarms
from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.native import BLOCK, FEW, VERY_FEW, WARP, padded
from softmpm.kernels.fast.packing import packing
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.alarm_check import armed
from softmpm.schemes.buffers import passing, slot, view
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.device import stream_of
from softmpm.schemes.fast.fixed_point import FixedPointAccumulator
from softmpm.schemes.fast.particle_order import ParticleLayout
from softmpm.schemes.fast.sorted_inputs import SortedInputs
from softmpm.schemes.fast.sorted_state import SortedState
from softmpm.schemes.inputs import Values
from softmpm.schemes.launch import KernelLauncher, LaunchReplay, RebindableLaunch
from softmpm.state import State


class ChunkGraph:
    """Captured launches of the chunks of one shape on one particle layout.

    Args:
        keep: Whether to store the intermediate states, which :class:`ChunkGraphAdj` needs.
    """

    def __init__(self, model: Model, layout: ParticleLayout, chunk: Chunk, keep: bool):
        self.model, self.layout, self.chunk, self.keep = model, layout, chunk, keep
        self.types = t = types(model.spec.dim, model.spec.dtype)
        self.lead = (model.worlds, model.particle_count)
        self.total = model.worlds * model.particle_count
        padded_count = padded(self.total)

        def tensor(*size, dtype=model.dtype):
            return torch.empty(*size, dtype=dtype, device=model.device)

        self._tensor = tensor
        self.order = tensor(*self.lead, dtype=torch.int32)
        self.origin = tensor(model.worlds, model.dim, dtype=torch.int32)
        self.words = tensor(model.worlds + 2, dtype=torch.int64)
        self._no_status = torch.full_like(self.words, NEVER)
        self._no_status[-2:].zero_()
        self._version = -1  # of the layout that order and origin were copied from
        self.inputs = SortedInputs(model, chunk, self.order)
        slots, grids = (chunk.length + 1, chunk.length) if keep else (1, 2)
        self.base = tensor(slots, padded_count, dtype=torch.int32)
        self.rows = tensor(slots, padded_count * t.rows)
        self.nodes = tensor(grids, model.worlds * layout.node_count, 4)
        self.velocity = tensor(model.worlds * layout.node_count, 4)
        self._structs()
        self.exact = None
        if model.spec.deterministic:
            self.exact = FixedPointAccumulator(
                model, view(tensor(padded_count * t.rows), t.real), self.node_arrays
            )
        self._forward = LaunchReplay(model)
        self._build_launches()

    def _structs(self) -> None:
        """Build the Warp structs that refer to the buffers."""
        t = self.types
        self.window = self.layout.window(self.origin)
        self.packed = []
        for base, rows in zip(self.base, self.rows, strict=True):
            packed = t.Packed()
            packed.base, packed.rows = view(base, wp.int32), view(rows, t.real)
            self.packed.append(packed)
        self.node_arrays = [view(nodes, t.aligned) for nodes in self.nodes]
        self.nothing = view(self._tensor(0, 4), t.aligned)
        self.velocity_array = view(self.velocity, t.aligned)
        self.order_array = view(self.order, wp.int32)
        self._mass = view(self.inputs.values["mass"], t.real)
        self.order_flat = view(self.order.view(-1), wp.int32)
        self.words_array = view(self.words, wp.int64)

    def _build_launches(self) -> None:
        """Build the launches that fill the buffers from a user's state or from the final state of another chunk."""
        model, t, pack, lead = self.model, self.types, self.packing, self.lead
        at, low = (model.constants, self.window, self.order_array), (t.vec, t.mat)
        state = (t.vec, t.vec, t.mat, t.mat)
        zero = torch.zeros(t.dim, t.dim, dtype=model.dtype, device=model.device)
        none = passing(zero[0].expand(*lead, -1), t.vec), passing(zero.expand(*lead, -1, -1), t.mat)

        def enter(*dtypes, low=()) -> RebindableLaunch:
            slots = [slot(model, dtype) for dtype in dtypes]
            inputs = (*at, *slots, *low, self.words_array, self.packed[0])
            return RebindableLaunch(model, pack.enter, lead, inputs, slots)

        self._enter = {False: enter(*state, low=none), True: enter(*state, *low)}
        padded_count, sort = padded(self.total), sorting(t.dim, model.spec.dtype)
        slots = [
            slot(model, wp.int32),
            slot(model, wp.int32, padded_count),
            slot(model, t.real, padded_count * t.rows),
        ]
        inputs = (self.window, self.order_array, *slots, self.words_array, self.packed[0])
        self._move = RebindableLaunch(model, sort.move, lead, inputs, slots)

    @property
    def bytes(self) -> int:
        """Bytes of its buffers."""
        sums = () if self.exact is None else (self.exact.fixed, self.rows[0])
        return sum(tensor.nbytes for tensor in (self.base, self.rows, self.nodes, self.velocity, *sums))

    def reset_status(self) -> None:
        """Reset all status words."""
        self.words.copy_(self._no_status)

    @property
    def few(self) -> bool:
        """True if the particles are too few to fill a GPU with blocks of full size."""
        return self.model.device.type == "cuda" and self.total <= FEW

    @property
    def block(self) -> int:
        """Threads per block of launches over particles."""
        return WARP if self.few else BLOCK

    @functools.cached_property
    def particles_per_warp(self) -> int:
        """Particles assigned to each warp by the forward kernels."""
        return self.particles_of_warp(may_halve=self.types.dim == 2)

    def particles_of_warp(self, may_halve: bool) -> int:
        """Particles assigned to each warp: one per thread or, if ``may_halve``, one per two threads for few particles.

        Half-populated warps process fewer particles each but send more reductions; bench/step.py and gradient.py measure
        which is faster.
        """
        few = self.model.device.type == "cuda" and self.exact is None and self.total <= VERY_FEW
        return WARP // 2 if may_halve and few else WARP

    def threads(self, per_warp: int) -> int:
        """Threads of a launch over particles; whole blocks on a GPU, since the lanes of a warp cooperate."""
        if self.model.device.type != "cuda":
            return self.total
        warps = -(-self.total // per_warp)
        return -(-warps * WARP // self.block) * self.block

    def run(
        self, chunk: Chunk, start: State | SortedState, values: Values, frozen: Sequence[int] = ()
    ) -> None:
        """Launch all substeps from ``start``. The final state is the last of :attr:`base` and :attr:`rows`.

        Args:
            chunk: Of this graph's shape.
            values: Inputs that the call decides; those with rows have one for each control step of the chunk.
            frozen: Worlds whose particles do not move.
        """
        stream = stream_of(self.model.device)
        moved = is_capturing(self.model) or self._version != self.layout.version
        if moved:
            self._version = -1  # until the inputs are in this order too
            self.order.copy_(self.layout.order)
            self.origin.copy_(self.layout.origin)
            self.layout.place_neighbours()
        self.reset_status()
        if frozen:
            self.words[list(frozen)] = FROZEN
        self.inputs.take(stream, chunk, values, moved)
        self._version = self.layout.version
        self._take(stream, start)
        if self.exact is not None:
            self.exact.begin(values["mass"])
        self._forward.run(stream, self._launch_all)

    def _take(self, stream: wp.Stream | None, start: State | SortedState) -> None:
        """Copy the initial state into the buffers, permuted into the present order."""
        if isinstance(start, SortedState):
            self._move(stream, start.inverse_permutation(), start.base, start.rows)
        else:
            given = [tensor.contiguous() for tensor in (*start[:4], *(start.low or ()))]
            self._enter[start.low is not None](stream, *given)

    @property
    def packing(self):
        return packing(self.model.spec.dim, self.model.spec.dtype)

    def _launch_all(self, launch: KernelLauncher) -> None:
        model, nodes, length = self.model, self.node_arrays, self.chunk.length
        kernels, held = fused(model.spec), len(self.velocity)
        launch(kernels.clear, held, self.velocity_array, block_dim=BLOCK)
        if self.exact is None:
            launch(kernels.clear, held, nodes[0], block_dim=BLOCK)
        self._begin(launch)
        for s in range(length):
            now, then = nodes[s % len(nodes)], nodes[(s + 1) % len(nodes)] if s + 1 < length else self.nothing
            if self.exact is not None:
                now, then = self.exact.sums(s), self.nothing
            inputs = self.inputs.grid_struct(s)
            arguments = (model.constants, inputs, self.window, now, self.velocity_array, then)
            launch(kernels.grid_velocity, held, *arguments, block_dim=BLOCK)
            self._advance(s, launch)
        survey = sorting(self.types.dim, model.spec.dtype).survey
        arguments = (model.constants, self.window, model.particle_count, self.packed[-1].base)
        launch(survey, self.total, *arguments, view(self.words[-2:], wp.int64))
        if armed(model):
            sizes = (length - 1, model.particle_count, self.total, self.order_flat)
            inputs = self.inputs.particle_struct(length - 1, length - 1)
            given = (model.constants, inputs, self.layout.neighbours, *sizes)
            launch(packed_alarms(model.spec).check, self.total, *given, self.packed[-1], self.words_array)

    def _begin(self, launch: KernelLauncher) -> None:
        """P2G of the first substep."""
        model, sink = self.model, self.node_arrays[0] if self.exact is None else self.exact.shares(0)
        sizes = (self.particles_per_warp, model.particle_count, self.total, self.order_flat)
        arguments = (
            model.constants,
            self.inputs.particle_struct(0, 0),
            self.window,
            *sizes,
            self.packed[0],
            self.words_array,
            sink,
        )
        launch(
            fused(model.spec).p2g_first[self.few],
            self.threads(self.particles_per_warp),
            *arguments,
            block_dim=self.block,
        )
        if self.exact is not None:
            self.exact.accumulate(self, 0, self.packed[0], self._mass, launch)

    def _advance(self, s: int, launch: KernelLauncher) -> None:
        """G2P of substep ``s`` and P2G of the next."""
        model, packed, nodes, length = self.model, self.packed, self.node_arrays, self.chunk.length
        now, then = (s, s + 1) if self.keep else (0, 0)
        inputs = self.inputs.particle_struct(s + 1, s)
        parameters = (model.constants, inputs, self.window, s, s + 1 == length, self.particles_per_warp)
        sizes = (model.particle_count, self.total, self.order_flat)
        states = (packed[now], self.words_array, packed[then])
        sink = nodes[(s + 1) % len(nodes)] if self.exact is None else self.exact.shares(s + 1)
        arguments = (*parameters, *sizes, self.velocity_array, *states, sink)
        launch(
            fused(model.spec).g2p2g[self.few],
            self.threads(self.particles_per_warp),
            *arguments,
            block_dim=self.block,
        )
        if self.exact is not None and s + 1 < length:
            self.exact.accumulate(self, s + 1, packed[then], self._mass, launch)
