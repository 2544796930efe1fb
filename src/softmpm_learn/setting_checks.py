"""Checks that settings share: a wrong value fails where the settings are made, in a sentence."""

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np


def _is(kind: type, value: Any) -> bool:
    """True for a number of a kind; True and False are none, although Python counts them as whole numbers."""
    return isinstance(value, kind) and not isinstance(value, bool)


TYPES: dict[Any, tuple[str, Callable[[Any], bool]]] = {
    bool: ("True or False", lambda value: isinstance(value, bool)),
    int: ("a whole number", lambda value: _is(Integral, value)),
    float: ("a number", lambda value: _is(Real, value)),
    list[int]: (
        "a list of whole numbers",
        lambda value: isinstance(value, Sequence) and all(_is(Integral, one) for one in value),
    ),
}
"""Rule of the values of a field by its type."""


def replaces_nothing(kind: type) -> None:
    """Raise ValueError for the first setting of a class, an annotated name in its body, that replaces an attribute of a base class that
    is no setting itself."""
    for name in inspect.get_annotations(kind):
        owner = next((base for base in kind.__mro__[1:] if name in vars(base)), None)
        if owner and name not in getattr(owner, "__dataclass_fields__", ()):
            raise ValueError(
                f"a setting must not replace an attribute of a base class: {name!r} of {kind.__name__} would take the place of "
                f"{owner.__name__}.{name}; give the setting another name."
            )


def typed(group: str, settings) -> None:
    """Raise ValueError for the first of all settings that is not of the type of its field, such as a fraction for a whole number."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        for kind, (rule, fits) in TYPES.items():
            needed = field.type == kind or (field.type == kind | None and value is not None)
            if needed and not fits(value):
                raise ValueError(f"{group}.{field.name} must be {rule}, got {value!r}.")


def one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    """Raise ValueError unless a setting has a known value."""
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}; got {value!r}.")


def positive(group: str, settings, *names: str) -> None:
    """Raise ValueError for the first of some settings that is not finite and positive; None passes."""
    for name in names:
        value = getattr(settings, name)
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{group}.{name} must be > 0, got {value}.")


def not_negative(group: str, settings, *names: str) -> None:
    """Raise ValueError for the first of some settings that is negative or not finite; None passes."""
    for name in names:
        value = getattr(settings, name)
        if value is not None and not (math.isfinite(value) and value >= 0):
            raise ValueError(f"{group}.{name} must be ≥ 0, got {value}.")


def share(group: str, settings, *names: str) -> None:
    """Raise ValueError for the first of some settings outside (0, 1]."""
    for name in names:
        value = getattr(settings, name)
        if not 0.0 < value <= 1.0:
            raise ValueError(f"{group}.{name} must lie in (0, 1], got {value}.")


def lengths(name: str, values) -> None:
    """Raise ValueError unless a setting is a list of lengths."""
    is_list = isinstance(values, Iterable) and not isinstance(values, str)
    if not (is_list and all(isinstance(one, Real) and 0.0 <= float(one) < math.inf for one in values)):
        shown = list(values) if is_list else values
        raise ValueError(
            f"{name} must be a list of lengths ≥ 0 [m], one for each axis, such as [0.05, 0.05], got {shown!r}."
        )


def particles(name: str, values: Any) -> None:
    """Raise ValueError unless values are indices of particles, at least one, none twice."""
    found = np.asarray(values)
    if not (found.ndim == 1 and found.size and np.issubdtype(found.dtype, np.integer)):
        raise ValueError(
            f"{name} must be a list of particle indices, not empty, got an array of {found.dtype}, shape {found.shape}; "
            "np.flatnonzero(mask) makes one."
        )
    if len(np.unique(found)) < found.size:
        raise ValueError(f"{name} names a particle twice; give each index once.")
