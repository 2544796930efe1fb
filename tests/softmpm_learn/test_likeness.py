"""Objects that are alike, and pairs that differ in one part."""

import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from softmpm_learn.likeness import alike


class Plain:
    """An object without ``==``."""

    def __init__(self, part: Any):
        self.part = part


class Slotted:
    __slots__ = ("part",)

    def __init__(self, part: Any):
        self.part = part


@dataclass
class Tensors:
    """Its ``==`` raises."""

    one: torch.Tensor
    many: list = field(default_factory=list)

    def __post_init__(self):
        self.sum = self.one.sum().item()


class Module(nn.Module):
    def __init__(self, part: Any, weight: float = 0.0):
        super().__init__()
        self.inner, self.part = nn.Linear(1, 1), Plain(part)
        self.register_buffer("buffer", torch.tensor(weight))
        nn.init.constant_(self.inner.weight, weight)
        nn.init.zeros_(self.inner.bias)


def listed(weight: float) -> nn.Module:
    """With a parameter that stands in a list as well."""
    module = Module(None)
    module.all = [module.inner.weight]
    nn.init.constant_(module.inner.weight, weight)
    return module


def circle(part: Any) -> Plain:
    found = Plain(part)
    found.self = found
    return found


PAIRS = {
    "number": (lambda x: x, 1.0, 2.0),
    "type of number": (lambda x: x, 1, True),
    "text": (str, "a", "b"),
    "path": (Path, "a", "b"),
    "tensor": (torch.tensor, [1.0, 2.0], [1.0, 3.0]),
    "shape of tensor": (torch.zeros, (2, 1), (1, 2)),
    "precision of tensor": (lambda dtype: torch.zeros(2, dtype=dtype), torch.float32, torch.float64),
    "array": (np.array, [1, 2], [1, 3]),
    "precision of array": (lambda dtype: np.zeros(2, dtype), np.float32, np.float64),
    "tuple": (lambda x: (0, torch.tensor(x)), 1.0, 2.0),
    "length of list": (lambda n: [0] * n, 2, 3),
    "dictionary": (lambda x: {"a": np.array(x)}, 1.0, 2.0),
    "keys": (lambda key: {key: 0}, "a", "b"),
    "dataclass": (lambda x: Tensors(torch.tensor(x)), [1.0, 2.0], [2.0, 1.0]),
    "object": (Plain, 1.0, 2.0),
    "object in object": (lambda x: Plain([Slotted(torch.tensor(x))]), 1.0, 2.0),
    "arguments of a function": (lambda x: functools.partial(max, x), 1.0, 2.0),
    "module": (Module, 1.0, 2.0),
    "weights of a module": (functools.partial(Module, None), 1.0, 2.0),
    "mode": (lambda on: nn.Dropout(0.5).train(on), True, False),
    "generator": (lambda seed: torch.Generator().manual_seed(seed), 1, 2),
}  # fmt: skip


@pytest.mark.parametrize("case", PAIRS)
def test_two_are_alike_if_all_of_their_parts_are(case):
    """Made twice alike, made of another part not."""
    make, one, other = PAIRS[case]
    assert alike(make(one), make(one))
    assert not alike(make(one), make(other)) and not alike(make(other), make(one))


@pytest.mark.parametrize(
    "make", [circle, lambda x: lambda: x, lambda x: Plain(lambda: x), lambda x: (x for _ in ())]
)
def test_in_doubt_they_are_not_alike(make):
    """Objects that refer to themselves, functions, what cannot be pickled: each is alike to itself alone."""
    one = make(1.0)
    assert alike(one, one) and not alike(one, make(1.0)) and not alike(one, make(2.0))


def test_the_values_of_weights_may_be_left_out():
    """Those of parameters and buffers that are a module's own; everything else is compared, and so are their shapes."""
    assert alike(Module(1.0, 2.0), Module(1.0, 3.0), weights=False)
    assert not alike(Module(1.0, 2.0), Module(2.0, 2.0), weights=False)
    assert not alike(nn.Linear(1, 1), nn.Linear(1, 1, bias=False), weights=False)
    assert not alike(nn.ParameterList([torch.ones(1)]), nn.ParameterList([torch.ones(2)]), weights=False)
    assert not alike(nn.Sequential(nn.ELU()), nn.Sequential(nn.SiLU()), weights=False)


def test_a_weight_in_a_list_is_no_modules_own():
    """Whoever evaluates the module with other weights does not reach it there."""
    assert alike(listed(0.0), listed(0.0)) and not alike(listed(0.0), listed(0.0), weights=False)
