"""The scheme of the reference formulation: two kernels for each substep, launched one by one, any precision, any device."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import FROZEN, NEVER
from softmpm.kernels.compile import launch
from softmpm.kernels.lagrangian.cells import cells, cells_adj
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.nodal import nodes_of, particles_of
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import Footprint
from softmpm.schemes.buffers import view
from softmpm.schemes.device import stream_of
from softmpm.schemes.inputs import Accumulators, InputsAdj, Values, elapsed, grid_struct, particle_struct
from softmpm.schemes.lagrangian.footprint import LagrangianFootprint
from softmpm.schemes.lagrangian.surface import SurfaceContact, SurfaceContactAdj, check_start
from softmpm.state import Nodal, State


def rest_struct(model: Model):
    """Struct on the nodes and cells at rest."""
    t, grid = types(model.spec.dim, model.spec.dtype), model.rest_grid
    struct = rest(model.spec.dim, model.spec.dtype).Rest()
    struct.nodes, struct.fraction = view(grid.nodes, t.ivec), view(grid.fraction.to(model.dtype), t.vec)
    for name in ("particles", "first", "cell_nodes", "node_cells"):
        setattr(struct, name, view(getattr(grid, name), wp.int32))
    return struct


class LagrangianRun:
    """One chunk that ran.

    Attributes:
        start, end: Nodal state before and after it; the end is passed on once the run is kept.
        words: Status words, see errors.py; shape (world,).
        outgrow: None, since nodes do not leave the grid at rest.
    """

    def __init__(
        self,
        model: Model,
        chunk: Chunk,
        start: Nodal,
        values: Values,
        keep: bool,
        frozen: Sequence[int] = (),
    ):
        self.model, self.chunk, self.start = model, chunk, start
        self.types, self.stream = types(model.spec.dim, model.spec.dtype), stream_of(model.device)
        self._values = model.fixed | values  # the structs only see their tensors
        if model.spec.moving:
            self._values["elapsed"] = elapsed(model, chunk.first, chunk.length, chunk.substeps)
        self._rest = rest_struct(model)
        self.words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        self.words_array = view(self.words, wp.int64)
        self.outgrow: Callable[[], None] | None = None
        if frozen:
            self.words[list(frozen)] = FROZEN
        self._mass = self._tensor(model.worlds, model.rest_grid.count)
        self._use_inputs(0, -1)
        arguments = (self._particle_inputs, self._rest, self._array(self._mass))
        self._launch(nodes(model.spec).masses, self._mass.shape, *arguments)
        stored = chunk.length if keep else 1
        self._u, self._v, self._p = self._nodal(stored + 1), self._nodal(stored + 1), self._nodal(stored)
        self._anchor = self._tensor(stored + 1, *model.anchor_shape)
        for own, given in zip((self._u, self._v, self._anchor), start[:3], strict=True):
            own[0].copy_(given.detach())
        force = start.force.detach().clone()
        self._partial = self._cells()
        self._contact = None
        if model.surface is not None:
            about = (chunk, self._mass, self._anchor, force, self._launch)
            self._contact = SurfaceContact(model, *about)
        for s in range(chunk.length):
            self._use_inputs(s, s - 1)
            self._advance(s, keep)
        last = chunk.length if keep else chunk.length % 2
        # A result must not keep all states alive:
        u, v, anchor = (tensor[last].clone() for tensor in (self._u, self._v, self._anchor))
        self.end = Nodal(u, v, anchor, force)
        if self._contact is not None:
            self._contact.check_end(self._grid_inputs, self._array(self.end.u), self.words_array)
        arguments = (model.constants, self._rest, chunk.length - 1, self._array(self.end.u))
        kernel, lead = cells(model.spec).check_end, self._partial.shape[:2]
        self._launch(kernel, lead, *arguments, self.words_array)

    def _tensor(self, *shape: int) -> Tensor:
        return torch.empty(shape, dtype=self.model.dtype, device=self.model.device)

    def _nodal(self, *lead: int) -> Tensor:
        return self._tensor(*lead, self.model.worlds, self.model.rest_grid.count, self.model.dim)

    def _cells(self) -> Tensor:
        """Sums of each cell for its nodes."""
        model = self.model
        return self._tensor(model.worlds, model.rest_grid.cell_count, 3**model.dim, model.dim)

    def _array(self, tensor: Tensor) -> wp.array:
        return view(tensor, self.types.real if tensor is self._mass else self.types.vec)

    def _launch(self, kernel, dim: Sequence[int], *inputs) -> None:
        launch(kernel, tuple(dim), inputs, device=self.model.wp_device, stream=self.stream)

    def _use_inputs(self, s: int, before: int) -> None:
        """Set the structs of substep ``s``, unless those of the substep that ran before it serve."""
        row = self.chunk.row(s)
        same = 0 <= before < self.chunk.length and row == self.chunk.row(before)
        if not same:
            self._particle_inputs = particle_struct(self.model, self._values, row, row)
        if not same or self.model.spec.moving:
            self._grid_inputs = grid_struct(self.model, self._values, row, s)

    def _advance(self, s: int, keep: bool) -> None:
        """One substep."""
        model, partial = self.model, self._array(self._partial)
        now, then = (s, s + 1) if keep else (s % 2, (s + 1) % 2)
        u, v = self._array(self._u[now]), self._array(self._v[now])
        parameters = (model.constants, self._particle_inputs, self._rest, s)
        kernel = cells(model.spec).forces
        self._launch(kernel, self._partial.shape[:2], *parameters, u, v, self.words_array, partial)
        state = (u, v, self._array(self._p[s if keep else 0]))
        new = self._array(self._u[then]), self._array(self._v[then])
        parameters = (model.constants, self._grid_inputs, self._rest, self._array(self._mass), partial)
        kernel = nodes(model.spec).advance
        velocity = new[1] if self._contact is None else self._contact.free
        self._launch(kernel, self._mass.shape, *parameters, self.words_array, *state, new[0], velocity)
        if self._contact is not None:
            self._contact.advance(s, self._grid_inputs, self.words_array, now, then, u, v, *new)

    def vjp(self, adj_end: Nodal, adj_inputs: InputsAdj, wanted: RequestedGrads) -> Nodal:
        """Adjoint of the start; adds those of the inputs into ``adj_inputs``."""
        model, chunk = self.model, self.chunk
        self.words.fill_(NEVER)
        rows = chunk.row(chunk.length - 1) + 1
        found = Accumulators(model, wanted, rows, self._held)
        adj = Nodal(*(tensor.clone() for tensor in adj_end))
        adj_mass = torch.zeros_like(self._mass)
        adj_f, partial_v = self._nodal(), self._partial
        if model.spec.viscosity:
            partial_v = self._cells()
        arrays = [self._array(tensor) for tensor in (*adj[:2], adj_f, self._partial, partial_v)]
        adj_mass_array, contact = view(adj_mass, self.types.real), None
        if self._contact is not None:
            given = (wanted, self._held, adj.anchor, adj.force, adj_mass_array)
            contact = SurfaceContactAdj(self._contact, *given)
        for s in reversed(range(chunk.length)):
            self._use_inputs(s, s + 1)
            if contact is not None:
                structs = (self._grid_inputs, found.grid_struct(chunk.row(s)), self._rest)
                stored = [self._array(t) for t in (self._u[s], self._p[s], self._v[s + 1])]
                contact.advance(s, *structs, *stored, *arrays[:2])
            self._advance_adj(s, wanted, found, arrays, adj_mass_array)
            if s == 0 or chunk.row(s) != chunk.row(s - 1):
                found.collect(chunk.row(s), model.fixed, self._launch)
        if contact is not None:
            contact.finish()
        arguments = (self._rest, adj_mass_array, found.particle_struct())
        self._launch(nodes_adj(model.spec, wanted).masses_adj, self._partial.shape[:2], *arguments)
        adj_inputs.add(found, chunk.rows)
        adj_inputs.add_particles(found, chunk.rows)
        return adj

    @property
    def _held(self) -> int:
        """Accumulators of each world for what acts on nodes or surface points."""
        return max(self.model.rest_grid.count, self._anchor.shape[3])

    def _advance_adj(
        self, s: int, wanted: RequestedGrads, found: Accumulators, arrays: list[wp.array], adj_mass: wp.array
    ) -> None:
        """Adjoint of substep ``s``; ``arrays`` are those of the adjoints and of scratch memory."""
        model, spec, row = self.model, self.model.spec, self.chunk.row(s)
        adj_u, adj_v, adj_f, partial_u, partial_v = arrays
        parameters = (model.constants, self._grid_inputs, self._rest, self._array(self._mass), self._held)
        u, v, p = (self._array(tensor[s]) for tensor in (self._u, self._v, self._p))
        out = (adj_u, adj_v, adj_f, adj_mass, found.grid_struct(row))
        kernel, lead = nodes_adj(spec, wanted), self._mass.shape
        self._launch(kernel.advance_adj, lead, *parameters, u, v, p, *out)
        parameters = (model.constants, self._particle_inputs, self._rest, self.chunk.length - 1 - s)
        out = (self.words_array, found.particle_struct(row, row), partial_u, partial_v)
        forces_adj = cells_adj(spec, wanted).forces_adj
        self._launch(forces_adj, self._partial.shape[:2], *parameters, u, v, adj_f, *out)
        self._launch(kernel.gather_adj, lead, self._rest, partial_u, partial_v, adj_u, adj_v)


class Lagrangian:
    """See :class:`softmpm.schemes.scheme.Scheme`. Its states are nodal; it keeps nothing between runs."""

    footprint: ClassVar[Footprint] = LagrangianFootprint()

    @classmethod
    def of(cls, model: Model) -> "Lagrangian":
        return cls(model)

    def __init__(self, model: Model):
        self.model = model

    def run(
        self, chunk: Chunk, start: Nodal, values: Values, keep: bool, frozen: Sequence[int] = ()
    ) -> LagrangianRun:
        return LagrangianRun(self.model, chunk, start, values, keep, frozen)

    def check_start(self, start: Nodal, values: Values) -> Tensor:
        model = self.model
        words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        u = view(start.u.detach().contiguous(), types(model.spec.dim, model.spec.dtype).vec)
        arguments = (model.constants, rest_struct(model), 0, u, view(words, wp.int64))
        self._launch(cells(model.spec).check_end, (model.worlds, model.rest_grid.cell_count), *arguments)
        if model.surface is not None:
            known = model.fixed | values
            if model.spec.moving:
                known["elapsed"] = elapsed(model, 0, 1, 1)
            check_start(model, grid_struct(model, known), u, view(words, wp.int64), self._launch)
        return words

    def _launch(self, kernel, dim: Sequence[int], *inputs) -> None:
        model = self.model
        launch(kernel, tuple(dim), inputs, device=model.wp_device, stream=stream_of(model.device))

    def accept(self, run: LagrangianRun, words: list[int]) -> bool:
        return True

    def checkpoint(self, state: Nodal) -> Nodal:
        return state

    def rest(self) -> Nodal:
        model = self.model
        return nodes_of(model, model.rest(), model.mass.expand(model.worlds, -1))

    def to_user(self, state: Nodal) -> Nodal:
        return state

    def particles(self, state: Any) -> State:
        return particles_of(self.model, state)
