"""The plain scheme: three kernels for each substep, launched one by one, any precision, any device."""

from collections.abc import Callable, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from softmpm.errors import FROZEN, NEVER
from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import Footprint
from softmpm.schemes.alarm_check import StartCheck, armed, check_end
from softmpm.schemes.buffers import Motion, MotionAdj, Solid, SolidAdj, clear
from softmpm.schemes.plain.footprint import PlainFootprint
from softmpm.schemes.plain.substep import Substep
from softmpm.state import State


class PlainRun:
    """One chunk that ran.

    Attributes:
        start, end: State before and after it; the end is handed over once the run is kept.
        words: Status words, see errors.py; shape (world,).
        outgrow: None, since the whole grid is in memory.
    """

    def __init__(
        self,
        model: Model,
        chunk: Chunk,
        start: State,
        pull: Tensor | None,
        solid: Solid,
        keep: bool,
        frozen: Sequence[int] = (),
    ):
        self.model, self.chunk, self.start, self.pull = model, chunk, start, pull
        self.row = None if pull is None else torch.empty_like(pull[0])
        self.step = Substep(model, Solid(solid.mass, solid.mu, solid.lam, self.row).struct(model))
        self._solid = solid  # the structs only see its tensors
        self.states = Motion.empty(model, chunk.length + 1 if keep else 2)
        self.slots = [self.states[i].struct(model) for i in range(len(self.states.base))]
        self.step.words[list(frozen)] = FROZEN
        self.step.enter(start, self.slots[0])
        for s in range(chunk.length):
            now, then = (s, s + 1) if keep else (s % 2, (s + 1) % 2)
            if s == 0 or chunk.row(s) != chunk.row(s - 1):
                self._drive(s)
            self.step.advance(self.slots[now], self.slots[then], s)
        self.end = self.step.leave(self.slots[chunk.length if keep else chunk.length % 2])
        if armed(model):
            check_end(model, self.step.solid, self.end, self.step.words_array, chunk.length - 1)
        self.words = self.step.words
        self.outgrow: Callable[[], None] | None = None

    def _drive(self, s: int) -> None:
        if self.row is not None and self.pull is not None:
            self.row.copy_(self.pull[self.chunk.row(s)])

    def vjp(self, adj_end: State, adj_solid: SolidAdj, wanted: RequestedGrads) -> tuple[State, Tensor | None]:
        """Adjoint of the start and of the pull; adds that of the material into ``adj_solid``."""
        model, chunk, step = self.model, self.chunk, self.step
        step.words.fill_(NEVER)
        adj_pull = torch.zeros_like(self.pull) if wanted.activation and self.pull is not None else None
        adjoints = MotionAdj.zeros(model), MotionAdj.zeros(model)
        structs, adj_struct = [adj.struct(model) for adj in adjoints], adj_solid.struct(model)
        then = adjoints[chunk.length % 2]
        then.fx.copy_(adj_end.x).mul_(model.scene.grid.spacing)
        then.v.copy_(adj_end.v)
        then.C.copy_(adj_end.C)
        then.H.copy_(adj_end.F)
        for s in reversed(range(chunk.length)):
            self._drive(s)
            clear(adjoints[s % 2].flat)
            states = self.slots[s], self.slots[s + 1], structs[(s + 1) % 2], structs[s % 2]
            step.adjoint(wanted, *states, adj_struct, chunk.length - 1 - s)
            if adj_pull is not None and (s == 0 or chunk.row(s) != chunk.row(s - 1)):
                step.collect_pull(adj_solid, adj_pull[chunk.row(s)])
        start = adjoints[0]
        return State(start.fx / model.scene.grid.spacing, start.v, start.C, start.H), adj_pull


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
        pull: Tensor | None,
        solid: Solid,
        keep: bool,
        frozen: Sequence[int] = (),
    ) -> PlainRun:
        return PlainRun(self.model, chunk, start, pull, solid, keep, frozen)

    def check_start(self, start: State, pull: Tensor | None, solid: Solid) -> Tensor:
        return StartCheck(self.model)(start, pull, solid)

    def accept(self, run: PlainRun, words: list[int]) -> bool:
        return True

    def checkpoint(self, state: State) -> State:
        return state

    def to_user(self, state: State) -> State:
        return state
