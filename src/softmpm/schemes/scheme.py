"""The interface of a scheme: all that ``runner`` and ``rollout`` know of how substeps run."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol, Self

from torch import Tensor

from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import Footprint
from softmpm.schemes.buffers import Solid, SolidAdj
from softmpm.state import State


class Run(Protocol):
    """A chunk that has been launched. Its buffers are in use as long as it or its end lives.

    Attributes:
        start, end: State before and after it, as a :class:`State` or in the scheme's own representation.
        words: Status words (errors.py), one for each world, and behind them what :meth:`Scheme.accept` reads.
        outgrow: To be called when a replay of the captured graph reports that a particle left the window; None without one.
    """

    chunk: Chunk
    start: Any
    end: Any
    words: Tensor
    outgrow: Callable[[], None] | None

    def vjp(self, adj_end: Any, adj_solid: SolidAdj, wanted: RequestedGrads) -> tuple[Any, Tensor | None]:
        """Adjoint of the start and of the pull; adds that of the material into ``adj_solid``. Needs a run that kept its states."""
        ...


class Scheme(Protocol):
    """Runs chunks of substeps of one model in one thread on one stream."""

    footprint: ClassVar[Footprint]

    @classmethod
    def of(cls, model: Model) -> Self:
        """The scheme that runs this model here; it may keep buffers in the model's workspace."""
        ...

    def check_start(self, start: State, pull: Tensor | None, solid: Solid) -> Tensor:
        """Launch the alarms of a call's start. Returns their status words, which the next check overwrites."""
        ...

    def run(
        self,
        chunk: Chunk,
        start: Any,
        pull: Tensor | None,
        solid: Solid,
        keep: bool,
        frozen: Sequence[int] = (),
    ) -> Run:
        """Launch a chunk.

        Args:
            start: A :class:`State`, or the end of a run of this scheme.
            pull: Activation times strength [Pa] in the control steps of the chunk, shape (control_step, world, muscle).
            keep: Whether to keep the states inside for :meth:`Run.vjp`.
            frozen: Worlds that stay as they are.
        """
        ...

    def accept(self, run: Any, words: list[int]) -> bool:
        """True if the run is valid, by its ``words``; if not, the scheme has prepared itself to run the chunk again."""
        ...

    def checkpoint(self, state: Any) -> Any:
        """A start or end in memory of its own, so that no run's buffers stay in use for it."""
        ...

    def to_user(self, state: Any) -> State:
        """A start, an end or an adjoint as a :class:`State` in the user's order."""
        ...
