"""The fast scheme: chunks run as programs, on particles sorted by cell and on the part of the grid around them."""

import threading
import weakref
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from softmpm.kernels.structs import Wanted
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import LONGEST, Footprint
from softmpm.schemes.alarm_check import StartCheck
from softmpm.schemes.buffers import Solid, SolidAdj
from softmpm.schemes.capture import hold, recording
from softmpm.schemes.failure_report import outgrown
from softmpm.schemes.fast.chunk_graph import Program
from softmpm.schemes.fast.chunk_graph_adj import ProgramAdj, Scratch
from softmpm.schemes.fast.footprint import FastFootprint
from softmpm.schemes.fast.particle_order import Arrangement
from softmpm.schemes.fast.sorted_state import SortedAdj, SortedState, Unpacking
from softmpm.state import State


class Pair(NamedTuple):
    """A program and its adjoints, which hold it."""

    program: Program
    adjoints: dict[Wanted, ProgramAdj]


STAY = {False: 4, True: 2}
"""Shapes of chunks whose programs always stay, by whether these keep what is inside: a call has two shapes at most, and programs that
keep nothing serve calls with and without gradient in turn."""


class _Shelf(list[Pair]):
    """Programs of one shape that wait for use. Unlike a plain list it can be referred to weakly: see :func:`_put_back`."""


def _put_back(shelf: weakref.ref[_Shelf], pair: Pair) -> None:
    """A program that was on loan. It did not hold the shelf meanwhile, so that what waits goes with its pool."""
    if (there := shelf()) is not None:
        there.append(pair)


class Pool:
    """Programs that were made on one arrangement and are not in use.

    Those for the shapes of chunks that came last stay. Others, since each length of a call may bring shapes of its own, stay only
    while all together fit into a call's part of the budget.
    """

    def __init__(self, model: Model, arrangement: Arrangement, unpacking: Unpacking):
        self.model, self.arrangement, self.unpacking = model, arrangement, unpacking
        # By whether they keep what is inside, and by shape, the one that came last at the end:
        self._free: dict[bool, dict[tuple, _Shelf]] = {False: {}, True: {}}
        self._scratch: dict[Wanted, Scratch] = {}
        # For the scratch, since other threads may go back through what this one's calls kept:
        self.turn = threading.Lock()

    def take(self, chunk: Chunk, keep: bool) -> tuple[Pair, _Shelf]:
        """A program, and the shelf that it comes back to: whoever gives it back, only this thread changes the pool."""
        shapes = self._free[keep]
        free = shapes[chunk.shape] = shapes.pop(chunk.shape, _Shelf())
        if free:
            pair = free.pop()
            if recording(self.model):
                # With its adjoints: their graphs must not be destroyed while another one is recorded.
                hold(pair)
            return pair, free
        if not recording(self.model):  # else no graph may be destroyed
            self._forget(keep)
        return Pair(Program(self.model, self.arrangement, chunk, keep), {}), free

    def _forget(self, keep: bool) -> None:
        """Make room for another program."""
        shapes, part = self._free[keep], self.model.budget // self.model.calls
        for shape in list(shapes)[: -STAY[keep]]:
            if sum(pair.program.bytes for free in shapes.values() for pair in free) <= part:
                break
            del shapes[shape]

    def adjoint(self, pair: Pair, wanted: Wanted) -> ProgramAdj:
        program, adjoints = pair
        if recording(self.model):
            return ProgramAdj(program, wanted, Scratch(program, wanted))
        if wanted not in self._scratch:
            self._scratch[wanted] = Scratch(program, wanted)
        if wanted not in adjoints:
            adjoints[wanted] = ProgramAdj(program, wanted, self._scratch[wanted])
        return adjoints[wanted]


class _Lease:
    """A program out on loan: it goes back to the pool when nothing refers to what is in it any more."""

    def __init__(self, pool: Pool, chunk: Chunk, keep: bool):
        self.pair, free = pool.take(chunk, keep)
        if not recording(pool.model):  # else it belongs to the graph that is being recorded
            weakref.finalize(self, _put_back, weakref.ref(free), self.pair)


class FastRun:
    """One chunk that ran; as long as it or its end lives, its program is used for nothing else.

    Attributes:
        renewed: Whether the arrangement was made for its start.
        start, end: State before and after it; the end lies in the program's buffers.
        words: Status words, see errors.py; then cells met along the order of the particles, and whether one is near the
            window's edge; shape (world + 2,).
    """

    def __init__(
        self,
        pool: Pool,
        renewed: bool,
        chunk: Chunk,
        start: State | SortedState,
        pull: Tensor | None,
        solid: Solid,
        keep: bool,
        frozen: Sequence[int] = (),
    ):
        self.pool, self.renewed, self.chunk, self.start = pool, renewed, chunk, start
        self._lease = _Lease(pool, chunk, keep)
        program = self._lease.pair.program
        program.run(start, pull, solid, frozen)
        self.end = SortedState(pool.unpacking, program.base[-1], program.rows[-1], program.order, self._lease)
        self.words = program.words
        self.outgrow: Callable[[], None] | None = pool.arrangement.outgrow

    def vjp(
        self, adj_end: State | SortedAdj, adj_solid: SolidAdj, wanted: Wanted
    ) -> tuple[SortedAdj, Tensor | None]:
        """Adjoint of the start and of the pull; adds that of the material into ``adj_solid``."""
        with self.pool.turn:
            adjoint = self.pool.adjoint(self._lease.pair, wanted)
            adj_pull = adjoint.run(adj_end, adj_solid)
            adj, order = adjoint.scratch.adj, adjoint.program.order  # both serve other runs before long
            return SortedAdj(self.pool.unpacking, adj.clone(), order.clone()), adj_pull


class Fast:
    """See :class:`softmpm.schemes.scheme.Scheme`. One for each thread and stream: its buffers serve one run after the other."""

    footprint: ClassVar[Footprint] = FastFootprint()

    @classmethod
    def of(cls, model: Model) -> "Fast":
        """Kept in the model's workspace, so that it must not hold the model."""
        stream = torch.cuda.current_stream(model.device).cuda_stream if model.device.type == "cuda" else 0
        return model.workspace.get((cls, stream), lambda: cls(weakref.proxy(model)))

    def __init__(self, model: Model):
        self.model = model
        self._pool: Pool | None = None
        self._unpacking = Unpacking(model)
        self._start_check: StartCheck | None = None
        self._widened = False  # the window was just put around the start of the chunk that comes next
        # Substeps of the graph that is being recorded since it last renewed the order:
        self._recorded = LONGEST

    def run(
        self,
        chunk: Chunk,
        start: State | SortedState,
        pull: Tensor | None,
        solid: Solid,
        keep: bool,
        frozen: Sequence[int] = (),
    ) -> FastRun:
        renewed = self._arrange(start, chunk)
        assert self._pool is not None
        return FastRun(self._pool, renewed, chunk, start, pull, solid, keep, frozen)

    def check_start(self, start: State, pull: Tensor | None, solid: Solid) -> Tensor:
        if self._start_check is None or recording(self.model):
            check = StartCheck(self.model)
            if recording(self.model):
                return check(start, pull, solid)
            self._start_check = check
        return self._start_check(start, pull, solid)

    def _arrange(self, start: State | SortedState, chunk: Chunk) -> bool:
        """See to it that there is an arrangement fit for use; whether it was made for this start."""
        if recording(self.model):
            return self._arrange_blindly(start, chunk)
        self._recorded = LONGEST
        if self._pool is None:
            self._use(Arrangement(self.model, start.x))
        elif self._pool.arrangement.outgrown:
            self._use(self._pool.arrangement.grown(start.x))
        elif self._pool.arrangement.stale or self.model.deterministic:  # else it would tell what ran before
            self._pool.arrangement.renew(start.x)  # if they do not fit into the window, the call will say so
        else:
            renewed, self._widened = self._widened, False
            return renewed
        self._widened = False
        return True

    def _arrange_blindly(self, start: State | SortedState, chunk: Chunk) -> bool:
        """Inside a graph nobody can look whether the order is stale: it is renewed every so often."""
        if self._pool is None:
            raise RuntimeError(
                "a CUDA graph is being recorded, and this model has not run before on this stream: run the same work once "
                "first, or let softmpm.Graph do it."
            )
        hold(self._pool.arrangement)
        renew = self._recorded >= LONGEST or self.model.deterministic
        if renew:
            self._pool.arrangement.renew(start.x)
            self._recorded = 0
        self._recorded += chunk.length
        return renew

    def _use(self, arrangement: Arrangement) -> None:
        self._pool = Pool(self.model, arrangement, self._unpacking)

    def accept(self, run: FastRun, words: list[int]) -> bool:
        """False if a particle left the window."""
        *words, cells, near_edge = words
        if outgrown(words):
            self._widen(run)
            return False
        run.pool.arrangement.judge(cells, bool(near_edge))
        return True

    def checkpoint(self, state: State | SortedState) -> State | SortedState:
        return state if isinstance(state, State) else state.copy()

    def to_user(self, state: State | SortedState | SortedAdj) -> State:
        return state if isinstance(state, State) else state.state()

    def _widen(self, run: FastRun) -> None:
        """A particle left the window during ``run``: put it around the start, once; whatever moves so fast needs a larger one."""
        arrangement = run.pool.arrangement
        if run.renewed or arrangement.left:
            self._use(arrangement.grown(run.start.x))
        else:
            arrangement.renew(run.start.x)
            arrangement.left = True
        self._widened = True
