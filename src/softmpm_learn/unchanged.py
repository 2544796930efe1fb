"""Checks that what several readers share stays as it is: a change in place would reach the next reader, and the simulation."""

from collections.abc import Iterable, Sequence

from torch import Tensor


def versions(tensors: Iterable[Tensor | None]) -> list[int]:
    """Changes of each in place, a number each; 0 for None and in inference mode, where PyTorch does not count."""
    return [0 if one is None or one.is_inference() else one._version for one in tensors]


def need_unchanged(who: str, what: str, before: Sequence[int], after: Sequence[int]) -> None:
    """Raise ValueError unless :func:`versions` are the same before and after ``who`` read ``what``."""
    if list(before) != list(after):
        raise ValueError(
            f"{who} changed {what} in place, which others read too; write x = x - y in place of x -= y, or work on a clone()."
        )
