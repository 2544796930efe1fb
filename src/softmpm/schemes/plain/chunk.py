"""The plain scheme: three kernels for each substep, launched one by one, any precision, any device."""

from collections.abc import Callable
from typing import ClassVar

from torch import Tensor

from softmpm.errors import FROZEN, NEVER
from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import Footprint
from softmpm.schemes.alarm_check import StartCheck, armed, check_end
from softmpm.schemes.buffers import Motion, MotionAdj, clear
from softmpm.schemes.carried import check_start, contact_on_grid
from softmpm.schemes.carried_adj import SurfaceContactAdj
from softmpm.schemes.inputs import Accumulators, InputsAdj, Values, elapsed, grid_struct, particle_struct
from softmpm.schemes.plain.footprint import PlainFootprint
from softmpm.schemes.plain.substep import Substep
from softmpm.schemes.surface_start import with_surface
from softmpm.state import State


class PlainRun:
    """One chunk that ran.

    Attributes:
        start, end: State before and after it; the end is passed on once the run is kept.
        words: Status words, see errors.py; shape (world,).
        outgrow: None, since the whole grid is in memory.
    """

    def __init__(
        self,
        model: Model,
        chunk: Chunk,
        start: State,
        values: Values,
        keep: bool,
        frozen: Tensor | None = None,
    ):
        self.model, self.chunk, self.start = model, chunk, start
        self._values = model.fixed | values  # the structs only see their tensors
        if model.spec.moving:
            self._values["elapsed"] = elapsed(model, chunk.first, chunk.length, chunk.substeps)
        self.step = Substep(model)
        self.states = Motion.empty(model, chunk.length + 1 if keep else 2)
        self.structs = [self.states[i].struct(model) for i in range(len(self.states.base))]
        self.contact = None
        if start.surface is not None:
            self.contact = contact_on_grid(model, chunk, keep)
            self.contact.load(chunk, start.surface)
        if frozen is not None:
            self.step.words.masked_fill_(frozen, FROZEN)
        self.step.enter(start, self.structs[0])
        for s in range(chunk.length):
            now, then = (s, s + 1) if keep else (s % 2, (s + 1) % 2)
            self._use_inputs(s, s - 1)
            self.step.advance(self.structs[now], self.structs[then], s, self.contact)
        self.end = self.step.leave(self.structs[chunk.length if keep else chunk.length % 2])
        if armed(model):
            check_end(model, self.step.particle_inputs, self.end, self.step.words_array, chunk.length - 1)
        if self.contact is not None:
            now = self.structs[chunk.length if keep else chunk.length % 2]
            self.contact.check_end(self.step.grid_inputs, now, self.step.words_array, self.step.launch)
            self.end = self.end._replace(surface=self.contact.end.clone())
        self.words = self.step.words
        self.outgrow: Callable[[], None] | None = None

    def _use_inputs(self, s: int, before: int) -> None:
        """Set the structs of substep ``s``, unless those of the substep that ran before it serve."""
        row = self.chunk.row(s)
        same = 0 <= before < self.chunk.length and row == self.chunk.row(before)
        if not same:
            self.step.particle_inputs = particle_struct(self.model, self._values, row, row)
        if not same or self.model.spec.moving:
            self.step.grid_inputs = grid_struct(self.model, self._values, row, s)

    def release(self) -> None:
        del self.end

    def vjp(self, adj_end: State, adj_inputs: InputsAdj, wanted: RequestedGrads) -> State:
        """Adjoint of the start; adds those of the inputs into ``adj_inputs``."""
        model, chunk, step = self.model, self.chunk, self.step
        step.words.fill_(NEVER)
        rows = chunk.row_count
        found = Accumulators(model, wanted, rows, model.node_count)
        adjoints = MotionAdj.zeros(model), MotionAdj.zeros(model)
        structs = [adj.struct(model) for adj in adjoints]
        then = adjoints[chunk.length % 2]
        then.fx.copy_(adj_end.x).mul_(model.scene.grid.spacing)
        then.v.copy_(adj_end.v)
        then.C.copy_(adj_end.C)
        then.H.copy_(adj_end.F)
        contact = None
        if self.contact is not None and adj_end.surface is not None:
            contact = self.contact, SurfaceContactAdj(model, wanted, packed=False)
            contact[1].load(adj_end.surface)
        for s in reversed(range(chunk.length)):
            row = chunk.row(s)
            self._use_inputs(s, s + 1)
            clear(adjoints[s % 2].flat)
            states = self.structs[s], self.structs[s + 1], structs[(s + 1) % 2], structs[s % 2]
            inputs = found.particle_struct(row, row), found.grid_struct(row)
            at = None if contact is None else (*contact, s)
            step.adjoint(wanted, *states, inputs, chunk.length - 1 - s, at)
            if s == 0 or row != chunk.row(s - 1):
                found.collect(row, model.fixed, step.launch)
        adj_inputs.add(found, chunk.rows)
        adj_inputs.add_particles(found, chunk.rows)
        start = adjoints[0]
        adj = State(start.fx / model.scene.grid.spacing, start.v, start.C, start.H)
        return adj if contact is None else adj._replace(surface=contact[1].start(chunk))


class Plain:
    """See :class:`softmpm.schemes.scheme.Scheme`. Keeps nothing between runs, and its states are the user's."""

    footprint: ClassVar[Footprint] = PlainFootprint()

    @classmethod
    def of(cls, model: Model) -> "Plain":
        return cls(model)

    def __init__(self, model: Model):
        self.model = model

    def run(
        self,
        chunk: Chunk,
        start: State,
        values: Values,
        keep: bool,
        frozen: Tensor | None = None,
    ) -> PlainRun:
        return PlainRun(self.model, chunk, start, values, keep, frozen)

    def check_start(self, start: State, values: Values) -> Tensor:
        words = StartCheck(self.model)(start, values)
        if start.surface is not None:
            check_start(self.model, start, values, words)
        return words

    def accept(self, run: PlainRun, words: list[int]) -> bool:
        return True

    def checkpoint(self, state: State) -> State:
        return state

    def to_user(self, state: State) -> State:
        return state

    particles = to_user

    def rest(self) -> State:
        state = self.model.rest()
        return state if self.model.surface is None else with_surface(self.model, state, {})
