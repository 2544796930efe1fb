"""Errors for what PyTorch offers besides the gradient and the kernels do not: batches, forward mode and second derivatives.

Base classes of functions with an explicit adjoint, and the checks for tensors that are batches or were saved as another kind.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

UNAVAILABLE = (
    "softmpm: torch.vmap and batched gradients (is_grads_batched, vectorize=True, jacrev) are not available; build the model with "
    "worlds=N instead, which runs a batch of N in one launch, each world with its own start, activation, material and gradient."
)
FORWARD = (
    "softmpm: forward-mode and second derivatives (jvp, jacfwd, hessian) are not available; use reverse mode (backward, "
    "grad, vjp), and for the rows of a Jacobian build the model with worlds=N, one row in each world."
)

SECOND = (
    "softmpm: second derivatives are not available (the adjoint is explicit and first order); "
    "call backward without create_graph=True."
)
HOOK = (
    "softmpm: a hook of torch.autograd.graph.saved_tensors_hooks gave back {got} for {want}; its unpack function must restore "
    "shape, dtype and device."
)


class FirstOrder(torch.autograd.Function):
    """Base of functions with an explicit adjoint: refuses the transforms that PyTorch offers besides the gradient."""

    @staticmethod
    def vmap(*_):
        raise RuntimeError(UNAVAILABLE)

    @staticmethod
    def jvp(*_):
        raise RuntimeError(FORWARD)


class Adjoint(torch.autograd.Function):
    """Base of the adjoint of a function: a second derivative raises instead of silently losing this term."""

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def backward(ctx, *adj):
        raise RuntimeError(SECOND)


class FirstOrderAdjoint(FirstOrder, Adjoint):
    """Base of the adjoint of a :class:`FirstOrder` function."""


def keeps_graph() -> bool:
    """True if the backward pass that is running is to keep its graph for another one."""
    core: Any = torch._C
    return core._autograd._get_current_graph_task_keep_graph()


def refuse_batches(tensors: Iterable[Tensor | None]) -> None:
    """Raise RuntimeError if one of these is a batch under ``torch.vmap`` or batched gradients."""
    if any(isinstance(tensor, Tensor) and _batched(tensor) for tensor in tensors):
        raise RuntimeError(UNAVAILABLE)


def _batched(tensor: Tensor) -> bool:
    core: Any = torch._C
    inner = core._functorch
    while inner.is_gradtrackingtensor(tensor):
        tensor = inner.get_unwrapped(tensor)
    return inner.is_batchedtensor(tensor) or inner.is_legacy_batchedtensor(tensor)


def kinds(tensors: Iterable[Tensor | None]) -> list[tuple | None]:
    """Shape, dtype and device of each tensor."""
    return [one if one is None else (one.shape, one.dtype, one.device) for one in tensors]


def refuse_other_kinds(saved: Iterable[Tensor | None], given: list[tuple | None]) -> None:
    """Raise RuntimeError unless saved tensors are of the kinds that were given: kernels would read beyond their memory."""
    for got, want in zip(kinds(saved), given, strict=True):
        if got != want:
            raise RuntimeError(HOOK.format(got=got, want=want))
