"""The device that a model runs on, and the memory that it has."""

import logging
import math
import os

import torch
import warp as wp

logger = logging.getLogger("softmpm")


def device_of(device: str | torch.device | None) -> torch.device:
    """The device asked for, in full; None takes CUDA if there is one, and says so in the log."""
    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"
        logger.info("softmpm runs on %s.", device)
    asked = device
    try:
        device = torch.device(device)
    except (RuntimeError, TypeError):
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise ValueError(f"device must be 'cpu', 'cuda' or 'cuda:N', got {str(asked)!r}.")
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise RuntimeError("device 'cuda' was asked for, but PyTorch sees no GPU here; use device='cpu'.")
        device = torch.device("cuda", torch.cuda.current_device() if device.index is None else device.index)
    return (
        torch.device("cpu") if device.type == "cpu" else device
    )  # tensors on "cpu:0" say that they are on "cpu"


def warp_device_of(device: torch.device) -> wp.Device:
    """The same device for Warp.

    Raises:
        OSError: The folder in which Warp keeps compiled kernels cannot be made; names it and the remedy.
    """
    try:
        wp.init()
    except OSError as error:
        if error.filename is None:
            raise
        raise OSError(
            f"Warp keeps compiled kernels in {error.filename}, which cannot be made: {error.strerror}; set the environment variable "
            "WARP_CACHE_PATH to a folder that can be written to."
        ) from error
    return wp.device_from_torch(device)


def memory_of(device: torch.device) -> int | None:
    """Bytes of memory [B], or None where the system does not say."""
    if device.type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory
    names = ("SC_PHYS_PAGES", "SC_PAGE_SIZE")
    return math.prod(map(os.sysconf, names)) if hasattr(os, "sysconf") else None
