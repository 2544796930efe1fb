"""Material of the particles as the kernels take it: Lamé's constants and masses (E0)."""

import torch
from torch import Tensor

from softmpm.batches import FirstOrder, FirstOrderAdjoint
from softmpm.checks import check_bounds, check_params
from softmpm.kernels.material import material as kernels_of
from softmpm.kernels.structs import DTYPES
from softmpm.model import Model
from softmpm.schemes.buffers import passing
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.launch import launcher
from softmpm.state import Params


def material(model: Model, params: Params) -> tuple[Tensor, Tensor, Tensor]:
    """μ, λ [Pa] and mass [model.mass_unit], each of shape (world, particle). Differentiable.

    Masses are exactly one in a uniform body, so that sums of them are not biased. The values of the previous call are reused if nothing
    changed and no gradient is needed; else ``params`` are checked.
    """
    last, seen = model.workspace.get(_Last, _Last), _seen(model, params)
    if seen and seen == last.seen:
        return last.found
    check_params(model, params)
    if not is_capturing(model):  # else nothing can be read back
        check_bounds(params, params.density * model.volume, model.mass_unit)
    lead = (model.worlds, model.particle_count)
    found = _Constants.apply(model, *(value.expand(lead) for value in params))
    if seen:
        last.params, last.seen, last.found = params, seen, found
    return found


class _Last:
    """Material of this thread's previous call. Other threads use other streams, on which their values may not be complete yet."""

    params: Params | None = None  # referenced, so that no other tensor gets the identities in ``seen``
    seen: tuple = ()
    found: tuple[Tensor, Tensor, Tensor] = ()  # pyright: ignore[reportAssignmentType]


def _seen(model: Model, params: Params) -> tuple:
    """Identity, version and address of the parameters; empty if these could not reveal a change."""
    if is_capturing(model) or torch._C._are_functorch_transforms_active() or not isinstance(params, Params):
        return ()
    if not all(type(p) is Tensor and not p.requires_grad and not p.is_inference() for p in params):
        return ()
    return tuple((id(p), p._version, p.data_ptr()) for p in params)


class _Constants(FirstOrder):
    """(E0) of E, ν and ρ, shape (world, particle) each. In PyTorch's operations it took a fifth of those of a control step."""

    @staticmethod
    def forward(model, young, poisson, density):
        return _constants(model, young, poisson, density)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.model = inputs[0]
        ctx.save_for_backward(*inputs[1:3])

    @staticmethod
    def backward(ctx, *adj):
        return None, *_ConstantsAdj.apply(ctx.model, *ctx.saved_tensors, *adj)


class _ConstantsAdj(FirstOrderAdjoint):
    @staticmethod
    def forward(model, young, poisson, *adj):
        return _constants_adj(model, young, poisson, *adj)


def _arguments(model: Model, *tensors: Tensor) -> list:
    """Volume and unit of mass, then these tensors, as the kernels take them."""
    real = DTYPES[model.spec.dtype]
    return [passing(one, real) for one in (model.volume, model.mass_unit.view(1), *tensors)]


@on_its_gpu
def _constants(model: Model, *params: Tensor) -> tuple[Tensor, ...]:
    found = tuple(torch.empty_like(params[0], memory_format=torch.contiguous_format) for _ in range(3))
    arguments = _arguments(model, *params, *found)
    launcher(model)(kernels_of(model.spec.dtype).constants, found[0].shape, *arguments)
    return found


@on_its_gpu
def _constants_adj(model: Model, young: Tensor, poisson: Tensor, *adj: Tensor) -> tuple[Tensor, ...]:
    """(E0.adj)"""
    found = tuple(torch.empty_like(young, memory_format=torch.contiguous_format) for _ in range(3))
    arguments = _arguments(model, young, poisson, *adj, *found)
    launcher(model)(kernels_of(model.spec.dtype).constants_adj, found[0].shape, *arguments)
    return found
