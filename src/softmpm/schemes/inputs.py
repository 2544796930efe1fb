"""Inputs of the kernels on a device, and their adjoints: structs, accumulators and sums, all derived from the table in inputs.py."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.inputs import INPUTS, Input, differentiable, present
from softmpm.kernels.physics.slot_sum import PARTS, collect_slots, collect_slots_in_order, collectors
from softmpm.kernels.structs import RequestedGrads, element_type, input_adj_types, input_types, types
from softmpm.model import Model
from softmpm.schemes.buffers import clear, view

Values = dict[str, Tensor]
"""Inputs by name. Those with ``rows`` have a first axis of control steps; then (world, particle), (world, particle, slot),
(world, muscle), (world, driven), (world, driven node), (world,) or (world, wall), then the axis of a vector."""


def particle_struct(
    model: Model, values: Mapping[str, Tensor], p2g: int = 0, g2p: int = 0, struct: Any = None
):
    """Struct of the inputs of particles, in row ``p2g`` for the stress and ``g2p`` for the motion; others are unset, or remain as they
    are in ``struct``."""
    struct = input_types(model.spec).ParticleInputs() if struct is None else struct
    for one in present(model.spec):
        if one.stage != "grid" and one.name in values:
            tensor = values[one.name]
            tensor = tensor[{"p2g": p2g, "g2p": g2p}[one.stage]] if one.rows else tensor
            setattr(struct, one.name, view(tensor, element_type(model.spec, one)))
    return struct


class ReusedParticleStruct:
    """Struct of the inputs of particles in the first row, of which only those fields are set again whose tensor is another one."""

    def __init__(self, model: Model):
        self._model, self._struct = model, input_types(model.spec).ParticleInputs()
        self._set: dict[str, tuple[Tensor, int]] = {}

    def of(self, values: Mapping[str, Tensor]):
        new = {}
        for name, tensor in values.items():
            before, address = self._set.get(name, (None, 0))
            if before is not tensor or address != tensor.data_ptr():
                new[name] = tensor
                self._set[name] = tensor, tensor.data_ptr()
        return particle_struct(self._model, new, struct=self._struct)


def of_surface_walls(model: Model, normals: Tensor) -> Tensor:
    """Normals of the walls that surface points meet, selected from those of all walls, shape (world, wall, dim).

    Indexing with a list would copy it to the GPU, which is not allowed during a capture.
    """
    return torch.stack([normals[:, wall] for wall in model.spec.surface_walls], dim=1)


def grid_struct(model: Model, values: Mapping[str, Tensor], row: int = 0, substep: int = 0):
    """Struct of the inputs of nodes, in a row and a substep of ``values``; walls at rest are stored by value in the struct."""
    struct, spec = input_types(model.spec).GridInputs(), model.spec
    for one in present(spec):
        if one.constant(spec):
            setattr(struct, one.name, model.wall_constants[one.name])
        elif one.stage == "grid" and one.name in values:
            tensor = values[one.name][row] if one.rows else values[one.name]
            tensor = tensor[substep : substep + 1] if one.per == "substep" else tensor
            setattr(struct, one.name, view(tensor, element_type(spec, one)))
    return struct


def elapsed(model: Model, first: int, length: int, substeps: int) -> Tensor:
    """Time of each substep from ``first`` on since the beginning of its control step [s]."""
    number = torch.arange(first, first + length, device=model.device) % substeps
    return number.double() * model.scene.dt


DRIVEN = ("driven", "driven_node")
_ROWS = {one.name for one in INPUTS if one.rows}


def in_rows(values: Values, rows: slice) -> Values:
    """The inputs of these control steps."""
    found = values.copy()
    for name, value in values.items():
        if name in _ROWS and value.shape[0] != rows.stop - rows.start:
            found[name] = value[rows]
    return found


def stiffest(model: Model, values: Values) -> Values:
    """The inputs of the first control step, with the active stress of each actuator that is stiffest among all control steps."""
    found, active = in_rows(values, slice(0, 1)), values.get("active_stress")
    if active is not None and active.shape[0] > 1:
        found["active_stress"] = (active * model.stiffening).amax(0, keepdim=True) * model.stiffening
    return found


class InputsAdj:
    """Adjoints of a whole call, of all inputs for which gradients are requested, in the user's order.

    Attributes:
        scalars: Adjoints of the scalar inputs of particles, shape (input, world, particle), one tensor so that they are added at once.
        tensors: All adjoints by name, of the shape of their values; those of scalar inputs are views of ``scalars``.
    """

    def __init__(self, model: Model, wanted: RequestedGrads, control_steps: int):
        self.model, self.wanted = model, wanted
        self.inputs = tuple(one for one in differentiable(model.spec) if one.group in wanted)
        names = [one.name for one in self.inputs if is_particle_scalar(one)]
        lead = (model.worlds, model.particle_count)
        self.scalars = torch.zeros(len(names), *lead, dtype=model.dtype, device=model.device)
        self.tensors: Values = dict(zip(names, self.scalars, strict=True))
        for one in self.inputs:
            if one.name not in self.tensors:
                shape = shape_of(model, one, control_steps)
                self.tensors[one.name] = torch.zeros(shape, dtype=model.dtype, device=model.device)

    def add(self, found: "Accumulators", rows: slice) -> None:
        """Add the adjoints of a chunk, except for inputs of particles; ``rows`` are its control steps."""
        for one in self.inputs:
            if one.per != "particle":
                total = self.tensors[one.name]
                target = total[rows] if one.rows else total[None]
                target += found.sums(one)

    def add_particles(self, found: "Accumulators", rows: slice) -> None:
        """Add the adjoints of the inputs of particles, from accumulators in the user's order."""
        self.scalars += found.scalars
        for one in self.inputs:
            if one.per == "particle" and one.rows:
                self.tensors[one.name][rows] += found.tensors[one.name]

    def clear(self, worlds: Tensor) -> None:
        """Set the adjoints of some worlds to zero; ``worlds`` is True for these, shape (world,)."""
        for one in self.inputs:
            tensor = self.tensors[one.name]
            tensor.masked_fill_(worlds.view(-1, *(1,) * (tensor.dim() - 1 - one.rows)), 0.0)


def is_particle_scalar(one: Input) -> bool:
    """True for an input that is one real number per particle."""
    return one.per == "particle" and one.kind == "scalar"


def shape_of(model: Model, one: Input, rows: int) -> tuple[int, ...]:
    """Shape of the values of an input."""
    sizes = {
        "particle": model.particle_count,
        "muscle": model.muscle_count,
        "driven": model.driven_count,
        "driven_node": 0 if model.driven_grid is None else model.driven_grid.count,
        "wall": model.wall_count,
    }
    own = (sizes[one.per],) if one.per in sizes else ()
    vector = (model.dim,) if one.kind == "vector" else ()
    return (*((rows,) if one.rows else ()), model.worlds, *own, *vector)


class Accumulators:
    """Buffers that the adjoint kernels of a chunk accumulate into; no two threads of a launch add to the same number.

    Args:
        rows: Number of control steps of the chunk.
        nodes: Allocated nodes of one world.

    Attributes:
        inputs: Inputs for which gradients are requested.
        tensors: By name: (row, world, particle, dim) for vectors of particles, (world, particle, slot) for actuators,
            (row, world, driven particle or node, dim), ([row, wall,] node of all worlds) for walls and worlds, each with the axis of
            a vector.
        scalars: See :class:`InputsAdj`.
    """

    def __init__(self, model: Model, wanted: RequestedGrads, rows: int, nodes: int):
        self.model, self.wanted, self.row_count, self.nodes = model, wanted, rows, nodes
        self._particle_structs: dict[tuple[int, int], Any] = {}
        self._grid_structs: dict[int, Any] = {}
        whole = InputsAdj(model, wanted, rows)
        self.inputs, self.scalars = whole.inputs, whole.scalars
        self.tensors: Values = {}
        self.collected: Values = {}
        for one in self.inputs:
            if one.per in ("particle", *DRIVEN):
                self.tensors[one.name] = whole.tensors[one.name]
            else:
                self.tensors[one.name] = self._zeros(one)
            if one.per == "muscle":
                vector = (model.dim,) if one.kind == "vector" else ()
                first = rows if one.rows else 1
                self.collected[one.name] = self._tensor(first, model.worlds, model.muscle_count, *vector)
        own = [self.tensors[one.name] for one in self.inputs if not is_particle_scalar(one)]
        self._cleared = [*([self.scalars] if len(self.scalars) else []), *own, *self.collected.values()]
        on_gpu = model.device.type == "cuda"  # a CPU adds in one order anyway
        self._in_order = model.deterministic or (on_gpu and model.formulation == "reference")
        if self._in_order and self.collected:
            self._parts = view(
                self._tensor(model.worlds, model.muscle_count, PARTS), types(model.dim, model.spec.dtype).real
            )

    def _tensor(self, *shape: int) -> Tensor:
        return torch.zeros(shape, dtype=self.model.dtype, device=self.model.device)

    def _zeros(self, one: Input) -> Tensor:
        model, vector = self.model, (self.model.dim,) if one.kind == "vector" else ()
        if one.per == "muscle":
            return self._tensor(model.worlds, model.particle_count, model.spec.muscle_slots, *vector)
        rows = (self.row_count,) if one.rows else ()
        walls = (model.wall_count,) if one.per == "wall" else ()
        return self._tensor(*rows, *walls, model.worlds * self.nodes, *vector)

    @property
    def bytes(self) -> int:
        """Bytes of all accumulators."""
        return sum(tensor.nbytes for tensor in self._cleared)

    def clear(self) -> None:
        """Set all accumulators to zero."""
        for tensor in self._cleared:
            clear(tensor)

    def particle_struct(self, p2g: int = 0, g2p: int = 0):
        """Struct of the accumulators of the inputs of particles, in the rows of :func:`particle_struct`."""
        if (p2g, g2p) not in self._particle_structs:
            struct = input_adj_types(self.model.spec, self.wanted).ParticleInputsAdj()
            for one in self.inputs:
                if one.stage != "grid":
                    self._set(struct, one, {"p2g": p2g, "g2p": g2p}[one.stage])
            self._particle_structs[p2g, g2p] = struct
        return self._particle_structs[p2g, g2p]

    def grid_struct(self, row: int = 0):
        """Struct of the accumulators of the inputs of nodes, in a row."""
        if row not in self._grid_structs:
            struct = input_adj_types(self.model.spec, self.wanted).GridInputsAdj()
            for one in self.inputs:
                if one.stage == "grid":
                    self._set(struct, one, row)
            self._grid_structs[row] = struct
        return self._grid_structs[row]

    def _set(self, struct, one: Input, row: int) -> None:
        t, tensor = types(self.model.spec.dim, self.model.spec.dtype), self.tensors[one.name]
        tensor = tensor[row] if one.rows and one.per != "muscle" else tensor
        setattr(struct, one.name, view(tensor, t.vec if one.kind == "vector" else t.real))

    def collect(self, row: int, values: Mapping[str, Tensor], launch: Callable[..., None]) -> None:
        """Launch the sums over the particles of each actuator in a row. The summed accumulators are cleared.

        Args:
            values: Inputs in the order of the particles; they must contain ``muscle``.
        """
        spec, real = self.model.spec, types(self.model.spec.dim, self.model.spec.dtype).real
        for name, collected in self.collected.items():
            target = collected[row if len(collected) > 1 else 0]
            slots = self.tensors[name]
            pairs = [(slots, target)]
            if slots.ndim == 4:
                pairs = [(slots[..., axis], target[..., axis]) for axis in range(slots.shape[3])]
            for slot, total in pairs:
                given = view(values["muscle"], wp.int32), view(slot, real)
                if self._in_order:
                    in_order = collect_slots_in_order(spec)
                    launch(in_order.parts, self._parts.shape, *given, self._parts)
                    launch(in_order.total, total.shape, self._parts, view(total, real))
                else:
                    launch(collect_slots(spec), collectors(slot.shape), *given, view(total, real))

    def sums(self, one: Input) -> Tensor:
        """Adjoint of an input of actuators, driven particles, worlds or walls, with a first axis of rows or of length 1."""
        if one.per == "muscle":
            return self.collected[one.name]
        tensor = self.tensors[one.name]
        if one.per in DRIVEN:
            return tensor
        tensor = tensor if one.rows else tensor[None]
        axis = 2 if one.per == "wall" else 1  # of the nodes
        by_world = tensor.unflatten(axis, (self.model.worlds, self.nodes)).sum(axis + 1)
        return by_world.transpose(1, 2) if one.per == "wall" else by_world
