"""Checks that settings share: a wrong value fails where the settings are made, in a sentence."""

import math
from collections.abc import Iterable
from numbers import Real


def one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    """Raise ValueError unless a setting has a known value."""
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}; got {value!r}.")


def positive(group: str, settings, *names: str) -> None:
    """Raise ValueError for the first of some settings that is not finite and positive."""
    for name in names:
        value = getattr(settings, name)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{group}.{name} must be > 0, got {value}.")


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
