"""Kernels of a call and its gradient besides those of the chunks, compiled together before the first of them is launched."""

import warp as wp

from softmpm.kernels.carried.surface import start_depth
from softmpm.kernels.compile import THREADS
from softmpm.kernels.fast.alarms import packed_alarms
from softmpm.kernels.fast.packing import packing
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.plain.alarms import state_alarms
from softmpm.model import Model
from softmpm.schemes.carried import POINT_BLOCK


def first_kernels(model: Model) -> list[tuple[wp.Kernel, int]]:
    """The kernels, with the threads of a block."""
    dim, dtype = model.spec.dim, model.spec.dtype
    of_order = sorting(dim, dtype)
    kernels = [of_order.locate, of_order.centre_window, of_order.invert, of_order.move, of_order.move_adj]
    kernels += [*vars(packing(dim, dtype)).values(), state_alarms(model.spec)]
    if model.neighbours.shape[1] > 0:
        kernels.append(packed_alarms(model.spec).permute_neighbours)
    found = [(kernel, THREADS) for kernel in kernels]
    if model.surface is not None:
        found.append((start_depth(model.spec), POINT_BLOCK))
    return found
