"""Buffers of the state: tensors that PyTorch owns, and the Warp structs that refer to them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.structs import types
from softmpm.model import Model


def view(tensor: Tensor, dtype) -> wp.array:
    """Warp array on a tensor's memory, or on that of a copy if it is lazily negated; vectors and matrices take up its last axes."""
    _check_reach(tensor)
    return wp.from_torch(tensor.detach().resolve_neg(), dtype=dtype, requires_grad=False)


def _check_reach(tensor: Tensor) -> None:
    """Raise ValueError if a stride exceeds 32 bits, in which Warp stores it [B]; Warp would silently access other memory."""
    if tensor.nbytes < 2**31:
        return
    for size, stride in zip(tensor.shape, tensor.stride(), strict=True):
        if size > 1 and stride * tensor.itemsize >= 2**31:
            raise ValueError(
                f"entries along an axis of {tuple(tensor.shape)} lie {stride * tensor.itemsize:,} bytes apart, Warp reaches less than "
                "2,147,483,648: take fewer nodes, particles or worlds."
            )


def passing(tensor: Tensor, dtype):
    """As :func:`view`, for one launch: cheaper to create, but not usable as a field of a struct."""
    _check_reach(tensor)
    memory = tensor.detach().resolve_neg()
    found: Any = wp.from_torch(memory, dtype=dtype, requires_grad=False, return_ctype=True)
    found.memory = memory  # a copy lives as long
    return found


def placeholder(model: Model, dtype, *size: int):
    """Placeholder for contiguous tensors that are bound later, see :class:`softmpm.schemes.launch.RebindableLaunch`.

    Args:
        size: Shape of the tensors without the last axes of vectors and matrices; by default (world, particle).
    """
    shape = (*(size or (model.worlds, model.particle_count)), *getattr(dtype, "_shape_", ()))
    kind = torch.int32 if dtype is wp.int32 else model.dtype
    return passing(torch.empty(shape, dtype=kind, device="meta"), dtype)


def placeholders_in(struct, names: Sequence[str], model: Model, dtype, *size: int) -> list:
    """Set fields of a struct to placeholders, as made by :func:`placeholder`, and return these."""
    held = struct.__ctype__()
    for name in names:
        setattr(held, name, placeholder(model, dtype, *size))
    return [getattr(held, name) for name in names]  # they lie in the struct's own memory


def clear(tensor: Tensor) -> None:
    """Set a tensor to zero; on the CPU through Warp, since PyTorch would wake its thread pool for each small buffer."""
    if tensor.device.type == "cpu":
        wp.from_torch(tensor, requires_grad=False).zero_()
    else:
        tensor.zero_()


def cleared(like: Tensor) -> Tensor:
    """A tensor of zeros of the same shape, see :func:`clear`."""
    made = torch.empty_like(like)
    clear(made)
    return made


@dataclass
class Motion:
    """State of all particles in the kernels' representation (kernels/structs.py); shapes (..., world, particle, dim[, dim])."""

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
    """Adjoint of a :class:`Motion`: views of one flat tensor, so that it is cleared at once."""

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
