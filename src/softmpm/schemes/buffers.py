"""Buffers of the kernels: tensors that PyTorch owns, and the Warp structs that refer to them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.structs import RequestedGrads, solid_adj_type, solid_types, types
from softmpm.model import Model
from softmpm.state import Params


def view(tensor: Tensor, dtype) -> wp.array:
    """Warp array on a tensor's memory; vectors and matrices take up its last axes."""
    _check_reach(tensor)
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def _check_reach(tensor: Tensor) -> None:
    """Warp counts the bytes from one entry of an axis to the next in 32 bits, and would go elsewhere without a word."""
    if tensor.nbytes < 2**31:
        return
    for size, stride in zip(tensor.shape, tensor.stride(), strict=True):
        if size > 1 and stride * tensor.itemsize >= 2**31:
            raise ValueError(
                f"entries along an axis of {tuple(tensor.shape)} lie {stride * tensor.itemsize:,} bytes apart, Warp reaches less than "
                "2,147,483,648: take fewer nodes, particles or worlds."
            )


def passing(tensor: Tensor, dtype):
    """As :func:`view`, for one launch: cheaper to make, and cannot be a field of a struct."""
    _check_reach(tensor)
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=True)


def slot(model: Model, dtype, *size: int):
    """As :func:`passing`, for contiguous tensors that come later, see :class:`softmpm.schemes.launch.RebindableLaunch`.

    Args:
        size: Of the tensors, without the last axes of vectors and matrices; (world, particle) if nothing is said.
    """
    shape = (*(size or (model.worlds, model.particle_count)), *getattr(dtype, "_shape_", ()))
    kind = torch.int32 if dtype is wp.int32 else model.dtype
    return passing(torch.empty(shape, dtype=kind, device="meta"), dtype)


def slots_in(struct, names: Sequence[str], model: Model, dtype, *size: int) -> list:
    """Make fields of a struct slots, of the size that :func:`slot` takes."""
    held = struct.__ctype__()
    for name in names:
        setattr(held, name, slot(model, dtype, *size))
    return [getattr(held, name) for name in names]  # they lie in the struct's own memory


def clear(tensor: Tensor) -> None:
    """Set to zero; on the CPU through Warp, since PyTorch would wake its thread pool for each of many small buffers."""
    if tensor.device.type == "cpu":
        wp.from_torch(tensor, requires_grad=False).zero_()
    else:
        tensor.zero_()


def lame(params: Params) -> tuple[Tensor, Tensor]:
    """Lamé's μ = E / 2(1 + ν) and λ = E ν / (1 + ν)(1 − 2ν) [Pa]."""
    young, poisson = params.young, params.poisson
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def masses(model: Model, params: Params) -> Tensor:
    """Mass of the particles in units of ``model.mass_unit``: exactly one in a uniform body, so that sums of it are not biased."""
    mass = params.density * model.volume
    return mass / model.mass_unit  # a tensor: by a number a GPU would multiply with the reciprocal


@dataclass
class Motion:
    """State of all particles as the kernels hold it (kernels/structs.py); shapes (..., world, particle, dim[, dim])."""

    base: Tensor
    fx: Tensor
    v: Tensor
    C: Tensor
    H: Tensor
    fx_low: Tensor | None = None

    @staticmethod
    def empty(model: Model, *lead: int) -> "Motion":
        def tensor(*tail, dtype=model.dtype):
            return torch.empty(
                *lead, model.worlds, model.particle_count, *tail, dtype=dtype, device=model.device
            )

        d = model.dim
        low = tensor(d) if model.dtype == torch.float32 else None
        return Motion(tensor(d, dtype=torch.int32), tensor(d), tensor(d), tensor(d, d), tensor(d, d), low)

    def tensors(self) -> tuple[Tensor, ...]:
        found = (getattr(self, field.name) for field in fields(self))
        return tuple(tensor for tensor in found if tensor is not None)

    def __getitem__(self, slot) -> "Motion":
        return Motion(*(tensor[slot] for tensor in self.tensors()))

    def copy_(self, other: "Motion") -> None:
        for mine, theirs in zip(self.tensors(), other.tensors(), strict=True):
            mine.copy_(theirs)

    def struct(self, model: Model):
        t = types(model.spec.dim, model.spec.dtype)
        struct = t.Motion()
        struct.base = view(self.base, t.ivec)
        names = (("fx", t.vec), ("v", t.vec), ("C", t.mat), ("H", t.mat), ("fx_low", t.vec))
        for name, dtype in names[: len(self.tensors()) - 1]:
            setattr(struct, name, view(getattr(self, name), dtype))
        return struct


@dataclass
class MotionAdj:
    """Adjoint of a :class:`Motion`, one flat tensor so that it is cleared at once."""

    flat: Tensor
    fx: Tensor
    v: Tensor
    C: Tensor
    H: Tensor

    @staticmethod
    def zeros(model: Model) -> "MotionAdj":
        lead, d = (model.worlds, model.particle_count), model.dim
        shapes = [(*lead, d), (*lead, d), (*lead, d, d), (*lead, d, d)]
        sizes = [lead[0] * lead[1] * n for n in (d, d, d * d, d * d)]
        flat = torch.zeros(sum(sizes), dtype=model.dtype, device=model.device)
        parts = (part.view(shape) for part, shape in zip(flat.split(sizes), shapes, strict=True))
        return MotionAdj(flat, *parts)

    def struct(self, model: Model):
        t = types(model.spec.dim, model.spec.dtype)
        struct = t.MotionAdj()
        for name, dtype in (("fx", t.vec), ("v", t.vec), ("C", t.mat), ("H", t.mat)):
            setattr(struct, name, view(getattr(self, name), dtype))
        return struct


@dataclass
class Solid:
    """Material of all particles: tensors (world, particle), and the pull of the muscles (world, muscle) [Pa].

    Mass is in units of ``model.mass_unit``, volume in [m³] per unit of mass; μ and λ are in [Pa].
    """

    mass: Tensor
    mu: Tensor
    lam: Tensor
    pull: Tensor | None

    def struct(self, model: Model):
        t, solid = types(model.spec.dim, model.spec.dtype), Solid.fixed(model)
        for name in ("mass", "mu", "lam"):
            setattr(solid, name, view(getattr(self, name), t.real))
        if self.pull is not None:
            solid.pull = view(self.pull, t.real)
        return solid

    @staticmethod
    def fixed(model: Model):
        """The struct with what the scene alone decides; μ, λ, mass and pull are open."""
        t, solid = types(model.spec.dim, model.spec.dtype), solid_types(model.spec).Solid()
        lead = (model.worlds, model.particle_count)
        solid.volume = view(model.specific_volume.expand(lead), t.real)
        if len(model.spec.laws) > 1:
            solid.law = view(model.law.expand(lead), wp.int32)
        if model.spec.muscle_slots:
            solid.muscle = view(model.muscle_slots.expand(*lead, -1), wp.int32)
            solid.fibre = view(model.fibre, t.vec)
        return solid


@dataclass
class SolidAdj:
    """Adjoint of a :class:`Solid`; what is not wanted is None. ``slot`` is the pull's, of each particle and slot.

    Those of the material lie in one tensor, ``material``, so that they are cleared at once.
    """

    wanted: RequestedGrads
    material: Tensor | None = None
    mass: Tensor | None = None
    mu: Tensor | None = None
    lam: Tensor | None = None
    slot: Tensor | None = None

    @staticmethod
    def zeros(model: Model, wanted: RequestedGrads) -> "SolidAdj":
        lead, kind = (model.worlds, model.particle_count), {"dtype": model.dtype, "device": model.device}
        adj = SolidAdj(wanted)
        if wanted.material:
            adj.material = torch.zeros(3, *lead, **kind)
            adj.mass, adj.mu, adj.lam = adj.material
        if wanted.activation:
            adj.slot = torch.zeros(*lead, model.spec.muscle_slots, **kind)
        return adj

    def struct(self, model: Model):
        t, struct = types(model.spec.dim, model.spec.dtype), solid_adj_type(model.spec, self.wanted)()
        if self.wanted.material:
            for name in ("mass", "mu", "lam"):
                setattr(struct, name, view(getattr(self, name), t.real))
        if self.slot is not None:
            struct.pull = view(self.slot, t.real)
        return struct
