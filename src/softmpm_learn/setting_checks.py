"""Checks that settings share: a wrong value fails where the settings are made, in a sentence."""

import math


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
