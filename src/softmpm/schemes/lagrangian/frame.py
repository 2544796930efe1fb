"""Translation of a world in the reference formulation, see kernels/lagrangian/frame.py."""

import math
from typing import Any

import torch
from torch import Tensor

from softmpm.kernels.lagrangian.frame import frame
from softmpm.model import Model
from softmpm.state import Nodal


def quantum(model: Model) -> float:
    """Of the shift [m]: the power of two from a cell on, so that u changes without rounding. Infinite with clamps and planes of
    symmetry, where u is held or reflected, and with walls that move, whose anchors turn about a place.
    """
    return (
        math.inf
        if model.mirror is not None or model.spec.moving
        else 2.0 ** math.ceil(math.log2(model.scene.grid.spacing))
    )


def frame_struct(model: Model) -> Any:
    """Struct of the rule by which u is kept small."""
    struct = frame(model.spec.dim, model.spec.dtype).Frame()
    q = quantum(model)
    struct.middle, struct.quantum, struct.per_quantum = model.rest_grid.middle, q, 1.0 / q
    return struct


def shift_of(model: Model, nodes: Nodal) -> Tensor:
    """Shift of a nodal state, zero if it has none."""
    if nodes.shift is not None:
        return nodes.shift
    return torch.zeros(model.worlds, model.dim, dtype=torch.float64, device=model.device)
