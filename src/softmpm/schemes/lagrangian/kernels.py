"""Kernels of a call and its gradient besides those of the chunks, compiled together before the first of them is launched."""

import warp as wp

from softmpm.kernels.compile import compile_together
from softmpm.kernels.lagrangian.cells import cells
from softmpm.kernels.lagrangian.node_sums import node_sums
from softmpm.kernels.lagrangian.projection import masses, projection
from softmpm.model import Model
from softmpm.schemes.lagrangian.bricks import NODE_BLOCK


def compile_first(model: Model) -> None:
    """Compile them, unless this thread has done it for this model."""

    def compiled() -> bool:
        compile_together(first_kernels(model), model.wp_device)
        return True

    model.workspace.get(compile_first, compiled)


def first_kernels(model: Model) -> list[tuple[wp.Kernel, int]]:
    """The kernels, with the threads of a block."""
    spec, bricks = model.spec, model.rest_grid.bricks
    of_bricks = projection(spec.dim, spec.dtype, bricks), masses(spec.dim, spec.dtype, bricks)
    kernels = [(kernel, bricks.threads) for made in of_bricks for kernel in vars(made).values()]
    kernels += [(kernel, NODE_BLOCK) for kernel in vars(node_sums(spec.dim, spec.dtype)).values()]
    kernels.append((cells(spec, bricks).check_state, bricks.threads))
    return kernels
