"""Inputs of a chunk graph in fixed buffers. Inputs of particles are permuted to the particle order, the others are copied unchanged."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.inputs import stored
from softmpm.kernels.fast.permute import permute
from softmpm.model import Model
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import placeholder, view
from softmpm.schemes.inputs import (
    Accumulators,
    InputsAdj,
    Values,
    elapsed,
    grid_struct,
    is_particle_scalar,
    particle_struct,
    shape_of,
)
from softmpm.schemes.launch import RebindableLaunch


class Permutation:
    """Launch that permutes quantities of particles, for arrays of one shape.

    Args:
        order: Particle at each place, shape (world, particle).
        placed: The permuted quantities, shape (quantity, world, place, component).
        back: Instead add ``placed`` to quantities in the user's order, which is the adjoint.
    """

    def __init__(self, model: Model, order: Tensor, placed: Tensor, *, back: bool = False):
        kind = str(placed.dtype).removeprefix("torch.")
        dtype = {"float32": wp.float32, "float64": wp.float64, "int32": wp.int32}[kind]
        given, arrays = placeholder(model, dtype, *placed.shape), (view(order, wp.int32), view(placed, dtype))
        kernels = permute(kind)
        inputs = (*arrays, given) if back else (arrays[0], given, arrays[1])
        kernel = kernels.sort_adj if back else kernels.sort
        self._launch = RebindableLaunch(model, kernel, placed.shape, inputs, [given])

    def __call__(self, stream: wp.Stream | None, tensor: Tensor) -> None:
        self._launch(stream, tensor)


class SortedInputs:
    """Inputs of one chunk graph in the order of its particles.

    Attributes:
        values: Buffers by name of the input; the kernels' structs refer to them.
    """

    def __init__(self, model: Model, chunk: Chunk, order: Tensor):
        self.model, self.chunk = model, chunk
        self._rows = chunk.row_count
        lead, found = (model.worlds, model.particle_count), stored(model.spec)
        self._scalars = [one.name for one in found if is_particle_scalar(one)]
        self._indices = [one.name for one in found if one.sorted and one.kind == "index"]
        self._vectors = [one.name for one in found if one.per == "particle" and one.kind == "vector"]
        self._given: tuple[Tensor, ...] = ()  # source of the sorted scalars, if it needs no gradient
        self._particle_structs: dict[tuple[int, int], Any] = {}
        self._grid_structs: dict[int, Any] = {}

        def tensor(*shape: int, dtype=model.dtype) -> Tensor:
            return torch.empty(shape, dtype=dtype, device=model.device)

        scalars = tensor(len(self._scalars), *lead, 1)
        self.values: Values = dict(zip(self._scalars, scalars[..., 0], strict=True))
        self._sort_scalars = Permutation(model, order, scalars)
        self._integers = self._sort_integers = None
        if self._indices:
            columns = [1 if name != "muscle" else model.spec.muscle_slots for name in self._indices]
            self._integers = tensor(sum(columns), *lead, 1, dtype=torch.int32)
            for name, part in zip(self._indices, self._integers[..., 0].split(columns), strict=True):
                self.values[name] = part.permute(1, 2, 0) if name == "muscle" else part[0]
            self._sort_integers = Permutation(model, order, self._integers)
        self._sort_vectors = {}
        for one in found:
            if one.name in self._vectors:
                self.values[one.name] = tensor(*shape_of(model, one, self._rows))
                self._sort_vectors[one.name] = Permutation(model, order, self.values[one.name])
            elif one.per == "substep":
                self.values[one.name] = tensor(chunk.length, dtype=torch.float64)
            elif not one.sorted and one.name in model.fixed:
                self.values[one.name] = model.fixed[one.name]
            elif not one.sorted:
                dtype = torch.float64 if one.double else model.dtype
                self.values[one.name] = tensor(*shape_of(model, one, self._rows), dtype=dtype)

    @property
    def bytes(self) -> int:
        """Bytes of the buffers; what all chunks share is not among them."""
        shared = {id(tensor) for tensor in self.model.fixed.values()}
        return sum(tensor.nbytes for tensor in self.values.values() if id(tensor) not in shared)

    def take(self, stream: wp.Stream | None, chunk: Chunk, values: Values, moved: bool) -> None:
        """Copy the inputs of a call into the buffers; ``moved`` is True if the particle order has changed since the last copy."""
        model = self.model
        if moved and self._sort_integers is not None:
            integers = [model.fixed[name] for name in self._indices]
            columns = [part if part.ndim == 3 else part[..., None] for part in integers]
            self._sort_integers(stream, torch.cat(columns, 2).permute(2, 0, 1).contiguous()[..., None])
        given = tuple(values[name] for name in self._scalars if name in values)
        same = len(given) == len(self._given) and all(a is b for a, b in zip(given, self._given, strict=True))
        if moved or not same:
            self._given = ()
            each = [values[name] if name in values else model.fixed[name] for name in self._scalars]
            self._sort_scalars(stream, torch.stack(each)[..., None])
            self._given = () if any(tensor.requires_grad for tensor in given) else given
        for name, sort in self._sort_vectors.items():
            sort(stream, values[name].contiguous())
        for name, value in values.items():
            if name not in self._scalars and name not in self._sort_vectors:
                self.values[name].copy_(value)
        if model.spec.moving:
            self.values["elapsed"].copy_(elapsed(model, chunk.first, chunk.length, chunk.substeps))

    def particle_struct(self, p2g: int, g2p: int):
        """Struct for P2G of substep ``p2g`` and G2P of substep ``g2p``, both clamped to the chunk."""
        first, second = (self.chunk.row(min(max(s, 0), self.chunk.length - 1)) for s in (p2g, g2p))
        if (first, second) not in self._particle_structs:
            made = particle_struct(self.model, self.values, first, second)
            self._particle_structs[first, second] = made
        return self._particle_structs[first, second]

    def grid_struct(self, s: int):
        """Struct for the grid stage of substep ``s``."""
        row = self.chunk.row(s)
        key = s if self.model.spec.moving else row
        if key not in self._grid_structs:
            self._grid_structs[key] = grid_struct(self.model, self.values, row, s)
        return self._grid_structs[key]


def unsort(
    model: Model, order: Tensor, found: Accumulators
) -> tuple[Permutation | None, dict[str, Permutation]]:
    """Launches that add the sorted adjoints of inputs to those in the user's order: one for all scalars, and one for each vector."""
    scalars = Permutation(model, order, found.scalars[..., None], back=True) if len(found.scalars) else None
    vectors = {
        one.name: Permutation(model, order, found.tensors[one.name], back=True)
        for one in found.inputs
        if one.per == "particle" and one.rows
    }
    return scalars, vectors


def add_unsorted(
    stream: wp.Stream | None, launches: tuple, found: Accumulators, rows: slice, adj_inputs: InputsAdj
) -> None:
    """Add the adjoints that a chunk has accumulated for the inputs of particles into ``adj_inputs``."""
    scalars, vectors = launches
    if scalars is not None:
        scalars(stream, adj_inputs.scalars[..., None])
    for name, back in vectors.items():
        back(stream, adj_inputs.tensors[name][rows])
