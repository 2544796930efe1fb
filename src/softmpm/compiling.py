"""torch.compile: what it calls instead of tracing it. torch.jit.trace is refused."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
T = TypeVar("T")

_outside: dict[Callable, Callable] = {}


def opaque(work: Callable[P, T]) -> Callable[P, T]:
    """A function that torch.compile does not trace. For inner ones: it would hide the signature of a public one.

    As ``torch.compiler.disable``, which as a decorator loads all of the compiler, in most of the time that ``import softmpm`` took.
    """

    @functools.wraps(work)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.compiler.is_compiling():
            if work not in _outside:
                _outside[work] = torch.compiler.disable(work)
            return _outside[work](*args, **kwargs)
        if torch._C._is_tracing():
            raise RuntimeError(
                "softmpm cannot be traced by torch.jit.trace, which would record memory that nothing writes to; trace the policy "
                "alone, or use torch.compile, which calls softmpm as it is."
            )
        return work(*args, **kwargs)

    return called
