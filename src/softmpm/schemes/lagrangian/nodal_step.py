"""One substep of the reference formulation on states that the user holds, forward and adjoint."""

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import FROZEN, MAX_SUBSTEP, NEVER, SUBSTEP_SHIFT
from softmpm.kernels.lagrangian.cells import cells
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import view
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.device import stream_of
from softmpm.schemes.inputs import InputsAdj, Values, particle_struct
from softmpm.schemes.lagrangian.bricks import brick_launch, rest_struct
from softmpm.schemes.lagrangian.buffers import SharedAdjoint
from softmpm.schemes.lagrangian.scheme import ChunkGraph, ChunkGraphAdj
from softmpm.schemes.launch import KernelLauncher
from softmpm.state import Nodal

ONE = Chunk(0, 1, 1)
"""A control step of one substep."""


class NodalStep:
    """A chunk of one substep, on buffers of its own that are made when first used.

    Inputs are given in new tensors each time: the buffers do not copy a tensor again, whatever Warp has written into its memory.

    Attributes:
        words: Status words of all steps so far, see errors.py; shape (world,).
        adj_words: Of all adjoints so far, in which substeps count backward from the last possible one; shape (world,).
        last: Number of the substep that was launched last.
    """

    def __init__(self, model: Model):
        self.model, self.last = model, 0
        self.stream = stream_of(model.device)
        self.words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        self.adj_words = self.words.clone()
        self._graph: ChunkGraph | None = None
        self._adjoints: dict[RequestedGrads, ChunkGraphAdj] = {}

    @torch.no_grad()
    def advance(self, now: Nodal, then: Nodal, values: Values, substep: int) -> None:
        """Copy the state after ``now`` into ``then``. Worlds that failed in an earlier step stay as they are."""
        self.last, failed = substep, self.words != NEVER
        graph = self._launch(now, values, failed)
        _take(self.words, graph.buffers.words, substep)
        for own, found in zip(then, graph.end(), strict=True):
            assert own is not None and found is not None
            own.copy_(found)

    @torch.no_grad()
    def adjoint(
        self, now: Nodal, adj_then: Nodal, values: Values, wanted: RequestedGrads, substep: int
    ) -> tuple[Nodal, InputsAdj]:
        """Adjoint of the state before a step and of the inputs. The step is recomputed."""
        graph, adj_inputs = self._launch(now, values), InputsAdj(self.model, wanted, 1)
        if wanted not in self._adjoints:
            self._adjoints[wanted] = ChunkGraphAdj(graph, SharedAdjoint(graph.buffers, wanted))
        adjoint = self._adjoints[wanted]
        adjoint.load(now, adj_then)
        adjoint.run(self.stream)
        _take(self.adj_words, graph.buffers.words, MAX_SUBSTEP - substep)
        return adjoint.unload(self.stream, ONE, adj_inputs), adj_inputs

    def checked(self, end: Nodal, values: Values) -> Tensor:
        """Status words after all alarms on particles in the state after the latest step."""
        model, words = self.model, self.words.clone()
        u = view(end.u, types(model.spec.dim, model.spec.dtype).vec)
        inputs = particle_struct(model, model.fixed | values)
        arguments = (
            model.constants,
            inputs,
            rest_struct(model),
            self.last,
            True,
            False,
            u,
            view(words, wp.int64),
        )
        kernel = cells(model.spec, model.rest_grid.bricks).check_state
        brick_launch(model, KernelLauncher(model, self.stream), kernel, *arguments)
        return words

    def _launch(self, now: Nodal, values: Values, failed: Tensor | None = None) -> ChunkGraph:
        """The graph after its run from ``now``, with all intermediate states."""
        if is_capturing(self.model):
            raise RuntimeError(
                "softmpm.step in the reference formulation cannot be captured in a CUDA graph; capture softmpm.simulate with "
                "softmpm.Graph."
            )
        if self._graph is None:
            self._graph = ChunkGraph(self.model, ONE, keep=True)
        self._graph.load(self.stream, ONE, now, values, failed)
        self._graph.run(self.stream)
        return self._graph


def _take(known: Tensor, words: Tensor, substep: int) -> None:
    """Retain the failures of a step, in which substeps count from 0."""
    found = torch.where(words < FROZEN, words + (substep << SUBSTEP_SHIFT), words)
    torch.minimum(known, found.where(words < FROZEN, known), out=known)
