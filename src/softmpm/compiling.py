"""torch.compile: what it calls instead of tracing it. What only records PyTorch's operations is refused."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
T = TypeVar("T")

_modes = torch._C._TorchDispatchModeKey
RECORDING = _modes.PROXY, _modes.FAKE, _modes.FUNCTIONAL
"""Modes in which PyTorch records operations: of make_fx, of fake and of functional tensors; torch.export has all three."""

_outside: dict[Callable, Callable] = {}


def opaque(work: Callable[P, T]) -> Callable[P, T]:
    """A function that torch.compile does not trace. For inner ones: it would hide the signature of a public one.

    As ``torch.compiler.disable``, which as a decorator loads all of the compiler, in most of the time that ``import softmpm`` took.
    """

    @functools.wraps(work)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.compiler.is_compiling():
            if work not in _outside:
                _outside[work] = torch.compiler.disable(checked)
            return _outside[work](*args, **kwargs)
        return checked(*args, **kwargs)

    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        _refuse_recording()
        return work(*args, **kwargs)

    return called


def _refuse_recording() -> None:
    """Raise RuntimeError where PyTorch's operations are recorded, in which the kernels have no part."""
    core = torch._C
    if core._is_tracing() or any(core._get_dispatch_mode(kind) is not None for kind in RECORDING):
        raise RuntimeError(
            "softmpm cannot be traced by torch.jit.trace, torch.export or make_fx, which would record memory that nothing writes to; "
            "trace the policy alone, or use torch.compile, which calls softmpm as it is."
        )
