"""Clamps and planes of symmetry in a chunk of the reference formulation: buffers and launches."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.lagrangian.mirror import mirror, mirror_adj, mirror_type
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import clear, view
from softmpm.schemes.lagrangian.bricks import NODE_PART
from softmpm.schemes.lagrangian.surface import SurfaceContact
from softmpm.state import Nodal


class Reflection:
    """Reflection of the nodes, once their velocity is known, and once more after surface contact.

    Args:
        mass: Masses of the nodes, shape (world, node).

    Attributes:
        reaction: Mean forces on the groups in the control step so far [N], shape (world, group, dim).
        rate: 1/T in the unit of force, T being the duration of a control step, shape (1,).
    """

    def __init__(self, model: Model, mass: Tensor):
        assert model.mirror is not None
        t, groups = types(model.spec.dim, model.spec.dtype), model.mirror
        self.model, self.mass = model, view(mass, t.real)
        self.lead = (model.worlds, groups.count)
        self.struct = mirror_type(model.spec.dim, model.spec.dtype)()
        self.struct.members = view(groups.members, wp.int32)
        self._signs = groups.signs.to(model.dtype)
        self.struct.signs = view(self._signs, t.vec)
        self.reaction = torch.empty(*self.lead, model.dim, dtype=model.dtype, device=model.device)
        self.rate = torch.empty(1, dtype=model.dtype, device=model.device)
        self._reaction, self.rate_array = view(self.reaction, t.vec), view(self.rate, t.real)

    def load(self, chunk: Chunk, start: Nodal) -> None:
        """Prepare the mean forces for a chunk that begins with this state."""
        if chunk.begins:
            clear(self.reaction)
        else:
            assert start.reaction is not None
            self.reaction.copy_(start.reaction.detach())
        self.rate.copy_(self.model.mass_unit / (chunk.substeps * self.model.scene.dt))

    def vectors(self) -> wp.array:
        """Scratch memory of a nodal field."""
        model, shape = self.model, (*self.mass.shape, self.model.dim)
        tensor = torch.empty(shape, dtype=model.dtype, device=model.device)
        return view(tensor, types(model.spec.dim, model.spec.dtype).vec)

    def advance(
        self,
        launch: Callable[..., None],
        words: wp.array,
        u: wp.array,
        new_v: wp.array,
        new_u: wp.array,
        anew: int = 0,
    ) -> None:
        """(B1) of ``new_v``, and ``new_u`` that follows from it; ``anew`` is 1 if a control step begins, whose mean force is new."""
        constants, kernel = self.model.constants, mirror(self.model.spec).reflect
        parameters = (constants, self.struct, self.mass, self.rate_array, anew, words)
        launch(kernel, self.lead, *parameters, u, self._reaction, new_v, new_u, part=NODE_PART)


class ReflectionAdj:
    """Adjoint of :class:`Reflection`, before and after that of surface contact.

    Args:
        contact: Surface contact of the chunk, or None.
        words: Status words, all of them of worlds that run.
        adj_mass: Adjoint of the masses of the nodes, added into.
        free, scratch: Buffers of nodal velocities.

    Attributes:
        reaction: Adjoint of the mean forces.
    """

    def __init__(
        self,
        forward: Reflection,
        contact: SurfaceContact | None,
        words: wp.array,
        adj_mass: wp.array,
        free: wp.array,
        scratch: wp.array,
    ):
        self.forward, self.contact = forward, contact
        self._words, self._adj_mass = words, adj_mass
        self._kernels = mirror_adj(forward.model.spec)
        self._free, self._scratch = free, scratch
        self.reaction = torch.empty_like(forward.reaction)
        self._reaction = view(self.reaction, types(forward.model.spec.dim, forward.model.spec.dtype).vec)

    def begin(
        self,
        launch: Callable[..., None],
        inputs: Any,
        rest: Any,
        u: wp.array,
        w: wp.array,
        new_v: wp.array,
        adj_u: wp.array,
        adj_v: wp.array,
    ) -> None:
        """The velocity before the reflection once more; with surface contact also the adjoint of the second reflection."""
        one = self.forward
        arguments = (one.model.constants, inputs, rest, one.mass, u, w)
        launch(self._kernels.free_again, one.mass.shape, *arguments, self._free, part=NODE_PART)
        if self.contact is not None:
            launch(self._kernels.free_again, one.mass.shape, *arguments, self.contact.free, part=NODE_PART)
            # Its mean forces are not read.
            one.advance(launch, self._words, u, self.contact.free, self._scratch)
            self._reflect(launch, one.model.scene.dt, 0, new_v, adj_u, adj_v)

    def finish(self, launch: Callable[..., None], anew: int, adj_u: wp.array, adj_v: wp.array) -> None:
        """Adjoint of the first reflection."""
        moved = self.forward.model.scene.dt if self.contact is None else 0.0
        self._reflect(launch, moved, anew, self._free, adj_u, adj_v)

    def load(self, adj_end: Nodal) -> None:
        """Take the adjoint of the mean forces in the final state of a chunk."""
        assert adj_end.reaction is not None
        self.reaction.copy_(adj_end.reaction)

    def unload(self, chunk: Chunk) -> Tensor:
        """Adjoint of the mean forces in the initial state of a chunk, which it reads unless a control step begins with it."""
        return torch.zeros_like(self.reaction) if chunk.begins else self.reaction.clone()

    def _reflect(
        self,
        launch: Callable[..., None],
        moved: float,
        anew: int,
        v: wp.array,
        adj_u: wp.array,
        adj_v: wp.array,
    ) -> None:
        """(B1.adj) and (B3.adj) at ``v``. After the second reflection v is its result, so that the masses get nothing: (K5.adj) has
        their part."""
        one = self.forward
        parameters = (one.struct, one.mass, moved, one.rate_array, anew)
        arguments = (v, adj_u, self._reaction, adj_v, self._adj_mass)
        launch(self._kernels.reflect_adj, one.lead, *parameters, *arguments, part=NODE_PART)
