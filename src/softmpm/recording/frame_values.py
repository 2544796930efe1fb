"""Values of a frame: what a recorder writes of the tensors that it is given."""

import numpy as np
import torch
from torch import Tensor

from softmpm.state import State


def strain(F: Tensor) -> Tensor:
    """Size of the Green strain, ‖(FᵀF − I)/2‖ [-], zero for every rigid motion; F is (..., dim, dim)."""
    eye = torch.eye(F.shape[-1], dtype=F.dtype, device=F.device)
    return torch.linalg.matrix_norm(F.mT @ F - eye) / 2


def as_numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", torch.float32).numpy()


def of_one_world(name: str, tensor: Tensor, state: State, world: int, shape: tuple[int, ...]) -> np.ndarray:
    every = (len(state.x), *shape)
    if tuple(tensor.shape) not in (shape, every):
        raise ValueError(
            f"{name} must have shape {shape}, or {every} with a first axis world, got {tuple(tensor.shape)}; a frame is one instant, "
            "so of many control steps it takes one."
        )
    return as_numpy(tensor[world] if tensor.ndim > len(shape) else tensor)
