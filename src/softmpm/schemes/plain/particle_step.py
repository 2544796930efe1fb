"""One substep of the moving formulation on states that the user holds, with contact at surface points if the model has it."""

from typing import Any

import torch
import warp as wp

from softmpm.errors import MAX_SUBSTEP
from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import view
from softmpm.schemes.carried import SurfaceContact, contact_on_grid
from softmpm.schemes.carried_adj import SurfaceContactAdj
from softmpm.schemes.plain.substep import Substep
from softmpm.state import SurfaceState

ONE = Chunk(0, 1, 1)
"""A control step of one substep."""


class ParticleStep(Substep):
    """A substep between states whose surface points, if there are any, are tensors of the user's memory.

    Attributes:
        contact: Contact at surface points, or None.
        adj_words: Status words of all adjoints so far, in which substeps count backward from the last possible one; shape (world,).
            Apart from ``words``, by which worlds stop: a gradient that is not finite stops none.
    """

    def __init__(self, model: Model):
        super().__init__(model)
        self.adj_words = self.words.clone()
        self.adj_words_array = view(self.adj_words, wp.int64)
        self.contact: SurfaceContact | None = None
        if model.surface is not None:
            self.contact = contact_on_grid(model, ONE, keep=False)
        self._back: dict[RequestedGrads, SurfaceContactAdj] = {}

    @torch.no_grad()
    def step(
        self, now: Any, then: Any, surface: SurfaceState | None, end: SurfaceState | None, substep: int
    ) -> None:
        """Advance from one pair of particles and surface points to another."""
        self._load(surface)
        self.advance(now, then, substep, self.contact)
        if self.contact is not None and end is not None:
            for own, found in zip(end, self.contact.end, strict=True):
                own.copy_(found)

    @torch.no_grad()
    def step_adj(
        self,
        wanted: RequestedGrads,
        particles: tuple[Any, Any, Any, Any],
        adj_inputs: tuple,
        surface: SurfaceState | None,
        adj_end: SurfaceState | None,
        substep: int,
    ) -> SurfaceState | None:
        """Adjoint of :meth:`step`.

        Args:
            particles: Those before and after, and their adjoints, after and before; the latter is added into.

        Returns:
            Adjoint of the surface points before.
        """
        contact = None
        if self.contact is not None and adj_end is not None:
            if wanted not in self._back:
                self._back[wanted] = SurfaceContactAdj(self.model, wanted, packed=False)
            self._load(surface)
            self._back[wanted].load(adj_end)
            contact = self.contact, self._back[wanted], 0
        self.adjoint(wanted, *particles, adj_inputs, MAX_SUBSTEP - substep, contact)
        return None if contact is None else contact[1].start(ONE)

    def check_depth(self, end: Any) -> None:
        """Check the depth of the surface points in the particles after the latest step."""
        if self.contact is not None and self.model.alarms.depth is not None:
            self.contact.check_end(self.grid_inputs, end, self.words_array, self.launch)

    def _load(self, surface: SurfaceState | None) -> None:
        if self.contact is not None and surface is not None:
            self.contact.load(ONE, surface)
