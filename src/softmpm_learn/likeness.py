"""Likeness of two objects, part by part: a run may then use what belongs to another run in place of its own.

In doubt two objects are not alike, which only costs time.
"""

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn


def alike(one: Any, other: Any, *, weights: bool = True) -> bool:
    """True if two objects are of one type and of equal parts, down to the numbers in their tensors and arrays.

    An object without an ``==`` of its own has the parts that pickle would store. So a function is alike to itself alone.

    Args:
        weights: False leaves out the values of parameters and buffers, of modules at any depth; one that is reached in another way, as
            in a list, makes them different.
    """
    try:
        return _alike(one, other, weights)
    except Exception:  # what cannot be compared or pickled, or refers to itself
        return False


def _alike(one: Any, other: Any, weights: bool) -> bool:
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, nn.Parameter) and not weights:
        return False
    if isinstance(one, Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(_alike(a, b, weights) for a, b in zip(one, other, strict=True))
    if isinstance(one, dict):
        return list(one) == list(other) and all(_alike(one[key], other[key], weights) for key in one)
    if isinstance(one, nn.Module):
        return _alike(_attributes(one, weights), _attributes(other, weights), weights)
    if dataclasses.is_dataclass(type(one)) or type(one).__eq__ is object.__eq__:
        return _alike(one.__reduce_ex__(4), other.__reduce_ex__(4), weights)
    return bool(one == other)


def _attributes(module: nn.Module, weights: bool) -> dict[str, Any]:
    """Everything that a module has, its submodules included; of weights perhaps only shape and precision."""
    if weights:
        return vars(module)
    return vars(module) | {name: _shapes(vars(module)[name]) for name in ("_parameters", "_buffers")}


def _shapes(tensors: dict[str, Tensor | None]) -> dict[str, Any]:
    return {
        name: None if tensor is None else (tensor.shape, tensor.dtype) for name, tensor in tensors.items()
    }
