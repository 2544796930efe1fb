"""Interface of a scheme, through which ``runner`` and ``rollout`` run substeps."""

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, Self

from torch import Tensor

from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.planning.memory import Footprint
from softmpm.schemes.inputs import InputsAdj, Values
from softmpm.state import State


class Run(Protocol):
    """A chunk that has been launched. Its buffers are in use as long as it or its final state is referenced.

    Attributes:
        start, end: Initial and final state, as a :class:`State` or in the scheme's own representation.
        words: Status words (errors.py), one for each world, followed by further numbers for :meth:`Scheme.accept`.
        outgrow: To be called when a replay of the captured graph reports that a particle left the window; None without a window.
    """

    chunk: Chunk
    start: Any
    end: Any
    words: Tensor
    outgrow: Callable[[], None] | None

    def release(self) -> None:
        """Release ``end``, and whatever else :meth:`vjp` does not need, once the run is valid."""
        ...

    def vjp(self, adj_end: Any, adj_inputs: InputsAdj, wanted: RequestedGrads) -> Any:
        """Adjoint of the initial state; those of the inputs are added into ``adj_inputs``. The run must have stored its states."""
        ...


class Scheme(Protocol):
    """Runs chunks of substeps of one model, in one thread on one stream."""

    footprint: ClassVar[Footprint]

    @classmethod
    def of(cls, model: Model) -> Self:
        """The scheme of this model for the current thread and stream; it may cache buffers in the model's workspace."""
        ...

    def check_start(self, start: Any, values: Values) -> Tensor:
        """Launch the alarms on a call's initial state. Returns their status words, which the next check overwrites."""
        ...

    def run(
        self,
        chunk: Chunk,
        start: Any,
        values: Values,
        keep: bool,
        frozen: Tensor | None = None,
    ) -> Run:
        """Launch a chunk.

        Args:
            start: A :class:`State`, or the final state of a run of this scheme.
            values: Inputs that the call sets; those with rows have one row for each control step of the chunk.
            keep: Whether to store the intermediate states for :meth:`Run.vjp`.
            frozen: True for worlds whose state does not change, shape (world,); None if all run.
        """
        ...

    def accept(self, run: Any, words: list[int]) -> bool:
        """True if the ``words`` of a run show that it is valid; if not, the scheme is ready to repeat the chunk."""
        ...

    def checkpoint(self, state: Any) -> Any:
        """A copy of an initial or final state in separate memory, so that it does not keep the buffers of a run in use."""
        ...

    def rest(self) -> Any:
        """The state at rest, as calls take it."""
        ...

    def to_user(self, state: Any) -> Any:
        """An initial state, a final state or an adjoint as calls take and return it: a :class:`State` in the user's order, or a
        :class:`softmpm.state.Nodal` in the reference formulation.
        """
        ...

    def particles(self, state: Any) -> State:
        """State of the particles that belongs to such a state."""
        ...
