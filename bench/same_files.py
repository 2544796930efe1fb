"""Files that runs leave in their folders, compared to the last bit.

Of checkpoints the content is compared, of recordings what their reader shows. Left out are files that depend on the clock or contain
random names, and pictures: after a failure they depend on the clock, and matplotlib may shade letters otherwise in another process.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

import softmpm
from softmpm_learn.storage import checkpoint

LEFT_OUT = ("timing.csv", "softmpm_learn.log", "run.rrd", "*.png")


def compared(folder: Path) -> set[str]:
    """Paths of the files that are compared."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)) for path in files if not any(map(path.match, LEFT_OUT))}


def differences(one: Path, other: Path) -> list[str]:
    """Files of two folders that are not the same in both, by their paths."""
    names = compared(one) | compared(other)
    return sorted(name for name in names if not same_file(one / name, other / name))


def same_file(one: Path, other: Path) -> bool:
    if not (one.exists() and other.exists()):
        return False
    if one.suffix == ".pt":
        return same(content(one), content(other))
    if one.name == "run.h5":
        return same(recorded(one), recorded(other))
    return one.read_bytes() == other.read_bytes()


def content(path: Path) -> dict[str, Any]:
    """Content of a checkpoint without the hash of timing.csv."""
    found = checkpoint.read(path)
    del found["seals"]["timing.csv"]
    return found


def recorded(path: Path) -> dict[str, Any]:
    """Scene, numbers, and attributes and frames of each episode of a recording."""
    with softmpm.Recording(path) as recording:
        episodes = {k: [recording.attributes(k), recording.frames(k)] for k in recording.episodes}
        return {"scene": recording.static, "scalars": recording.scalars, "episodes": episodes}


def same(one: Any, other: Any) -> bool:
    """True if both have the same structure and the same bits."""
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return same(one.numpy(), other.numpy())
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return repr(one) == repr(other)
