"""Values that a person gives, as plain numbers and arrays; what would be converted with a loss is refused."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any

import numpy as np


def need(condition: bool, message: str) -> None:
    """Raise ``ValueError(message)`` unless ``condition`` holds. A message states the rule, the value received and the remedy."""
    if not condition:
        raise ValueError(message)


def plain(value: Any) -> float:
    """One real number. NumPy would drop what is imaginary or masked, and Python would read texts."""
    odd = isinstance(value, (str, bytes, bool, np.bool_, np.ma.MaskedArray)) or _has_gradient(value)
    if odd or np.iscomplexobj(value) or np.ndim(value) != 0:
        raise TypeError
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _has_gradient(value: Any) -> bool:
    return bool(getattr(value, "requires_grad", False))


def _remedy(*values: Any) -> str:
    """End of an error for tensors whose gradient a plain number would lose."""
    lost = any(map(_has_gradient, values))
    return "; its gradient would be lost: give it to the call, in its params or inputs" if lost else ""


def numbers(name: str, values: Iterable[float]) -> tuple[float, ...]:
    try:
        if isinstance(values, (str, np.ma.MaskedArray)):
            raise TypeError
        numbers = tuple(plain(value) for value in values)
    except (TypeError, ValueError) as error:
        kind = "made of plain numbers" if isinstance(values, Iterable) else "a sequence of numbers"
        given = values if isinstance(values, Sequence) else (values,)
        raise TypeError(f"{name} must be {kind}, got {values!r}{_remedy(*given)}.") from error
    need(all(map(math.isfinite, numbers)), f"{name} must be finite, at most 1.8e308, got {numbers}.")
    return numbers


def store_numbers(owner: object, what: str, *names: str) -> None:
    """Turn fields into plain floats, so that NumPy scalars compare, hash and print like them."""
    for name in names:
        value = getattr(owner, name)
        try:
            number = plain(value)
        except (TypeError, ValueError) as error:
            raise TypeError(f"{what} {name} must be one number, got {value!r}{_remedy(value)}.") from error
        need(math.isfinite(number), f"{what} {name} must be finite, at most 1.8e308, got {number}.")
        object.__setattr__(owner, name, number)


def array(name: str, values: object, kinds: str = "iuf", of: str = "real numbers") -> np.ndarray:
    """As an array of numbers of these kinds; TypeError for what NumPy would convert with a loss."""
    if isinstance(values, np.ma.MaskedArray):
        raise TypeError(
            f"{name} must not be a masked array, whose mask would be lost; select rows: a.data[chosen]."
        )
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise TypeError(f"{name} must be an array of {of}; its rows differ in length.") from error
    if array.dtype.kind not in kinds:
        raise TypeError(f"{name} must be {of}, got {array.dtype}.")
    return array


def indices(name: str, particles: object, least: int = 1) -> np.ndarray:
    """Indices of particles, shape (k,), int64, read-only; at least so many, none twice."""
    what = f"{name.removeprefix('a ')} particles"
    found = array(what, particles, "biufO", "whole numbers")
    need(
        found.ndim == 1 and found.size >= least,
        f"{name} needs a list of particle indices{', not empty,' * (least > 0)} got an array of shape {found.shape}; "
        "np.flatnonzero(mask) makes one.",
    )
    need(
        np.issubdtype(found.dtype, np.integer),
        f"{what} must be whole numbers, got {found.dtype}; np.flatnonzero(mask) makes them.",
    )
    need(len(np.unique(found)) == found.size, f"{name} names a particle twice; give each index once.")
    return read_only(found.astype(np.int64))


def read_only(array: np.ndarray) -> np.ndarray:
    """A scene is checked once: what could be written to later would escape that."""
    array.flags.writeable = False
    return array


def restore(owner: Any, values: Sequence[Any]) -> None:
    """Fields from pickle or copy, whose arrays could be written to."""
    for field, value in zip(fields(owner), values, strict=True):
        object.__setattr__(owner, field.name, read_only(value) if isinstance(value, np.ndarray) else value)


UNIT = 1e-15
"""Lengths within this of one are one: rounding alone, which a further division would only move."""


def unit(name: str, vector: Sequence[float]) -> tuple[tuple[float, ...], float]:
    """A vector divided by its length, and that length; a unit vector as it is, and 1."""
    given = numbers(name, vector)
    length = math.hypot(*given)
    need(length > 0, f"{name} must not be zero, got {given}.")
    if abs(length - 1.0) <= UNIT:
        return given, 1.0
    return tuple(number / length for number in given), length


def need_kind(name: str, value: object, kind: type) -> None:
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a {kind.__name__}, got {type(value).__name__}.")
