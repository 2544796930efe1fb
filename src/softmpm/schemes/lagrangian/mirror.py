"""Clamps and planes of symmetry in a chunk of the reference formulation: buffers and launches."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.lagrangian.mirror import mirror, mirror_adj, mirror_type
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.schemes.buffers import view
from softmpm.schemes.lagrangian.bricks import NODE_PART
from softmpm.schemes.lagrangian.surface import SurfaceContact


class Reflection:
    """Reflection of the nodes, once their velocity is known, and once more after surface contact.

    Args:
        mass: Masses of the nodes, shape (world, node).
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

    def vectors(self) -> wp.array:
        """Scratch memory of a nodal field."""
        model, shape = self.model, (*self.mass.shape, self.model.dim)
        tensor = torch.empty(shape, dtype=model.dtype, device=model.device)
        return view(tensor, types(model.spec.dim, model.spec.dtype).vec)

    def advance(
        self, launch: Callable[..., None], words: wp.array, u: wp.array, new_v: wp.array, new_u: wp.array
    ) -> None:
        """(B1) of ``new_v``, and ``new_u`` that follows from it."""
        constants, kernel = self.model.constants, mirror(self.model.spec).reflect
        arguments = (constants, self.struct, self.mass, words, u, new_v, new_u)
        launch(kernel, self.lead, *arguments, part=NODE_PART)


class ReflectionAdj:
    """Adjoint of :class:`Reflection`, before and after that of surface contact.

    Args:
        contact: Surface contact of the chunk, or None.
        words: Status words, all of them of worlds that run.
        adj_mass: Adjoint of the masses of the nodes, added into.
    """

    def __init__(
        self,
        forward: Reflection,
        contact: SurfaceContact | None,
        wanted: RequestedGrads,
        words: wp.array,
        adj_mass: wp.array,
    ):
        self.forward, self.contact = forward, contact
        self._words, self._adj_mass = words, adj_mass
        self._kernels = mirror_adj(forward.model.spec, wanted)
        self._free, self._scratch = forward.vectors(), forward.vectors()

    def begin(
        self,
        launch: Callable[..., None],
        inputs: Any,
        rest: Any,
        u: wp.array,
        p: wp.array,
        new_v: wp.array,
        adj_u: wp.array,
        adj_v: wp.array,
    ) -> None:
        """The velocity before the reflection once more; with surface contact also the adjoint of the second reflection."""
        one = self.forward
        arguments = (one.model.constants, inputs, rest, one.mass, u, p)
        launch(self._kernels.free_again, one.mass.shape, *arguments, self._free, part=NODE_PART)
        if self.contact is not None:
            launch(self._kernels.free_again, one.mass.shape, *arguments, self.contact.free, part=NODE_PART)
            one.advance(launch, self._words, u, self.contact.free, self._scratch)
            self._reflect(launch, one.model.scene.dt, new_v, adj_u, adj_v)

    def finish(self, launch: Callable[..., None], adj_u: wp.array, adj_v: wp.array) -> None:
        """Adjoint of the first reflection."""
        moved = self.forward.model.scene.dt if self.contact is None else 0.0
        self._reflect(launch, moved, self._free, adj_u, adj_v)

    def _reflect(
        self, launch: Callable[..., None], moved: float, v: wp.array, adj_u: wp.array, adj_v: wp.array
    ) -> None:
        """(B1.adj) at ``v``. After the second reflection v is its result, so that the masses get nothing: (K5.adj) has their part."""
        one = self.forward
        arguments = (one.struct, one.mass, moved, v, adj_u, adj_v, self._adj_mass)
        launch(self._kernels.reflect_adj, one.lead, *arguments, part=NODE_PART)
